"""The client engine: matches replies, keeps the window, notices losses. Layer: protocol; pure.

Theory of operation. An operation supplies requests (`next_requests`) and receives believed answers. A reply
belongs to the request whose seq is one less. The engine believes it if it has the request's opcode and, where
servers echo them, its session and offset. Other replies never reach an operation. A request is lost when a
later one was answered and a little more than a round trip passed, or when its timer runs out (see `timers`).
The engine then calls its operation's `on_lost`, and the operation supplies the request again. Its place in
the window is free as soon as the later one is answered. While burst packets arrive, timers stand still,
because ArduPilot answers nothing else then (servers.md 4).

**How many requests may be in flight?** `flow` decides how many, `pathgate` which kind, and an exclusive
operation keeps all others back. **When does an operation end without an answer?** When it made no progress
for its `patience`; lost requests are not counted.

Nothing that comes in can raise: `receive` takes any payload at any time.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.ledger import LAST_SEQ, Ledger
from mavftpfs.protocol.pathgate import PathGate
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload, reply_of, split_run
from mavftpfs.protocol.requests import Operation, Request, RetryPolicy, encode
from mavftpfs.protocol.timers import Timers
from mavftpfs.shared.errors import LocalProtocolError, RemoteProtocolError, RequestTimeout
from mavftpfs.shared.model import SHARED_QUEUE_WINDOW, Traits

OP_DEADLINE = 30.0
_INVALID_SESSION = bytes((NakCode.INVALID_SESSION,))
_FEW = 4
"""Requests: where no more are in flight, no timer waits for the end of a card's pause."""

_EARLY = 0.01
"""Seconds by which a timer may end early, so that a wait may seem shorter than it was."""

_BURST = int(Opcode.BURST_READ_FILE)
_NAK = int(Opcode.NAK)


@dataclass(slots=True)
class EngineStats:
    """Plain counters since the engine was made.

    requests: transmissions. lost: requests that were declared lost while their operation waited for an
    answer. replies: believed ones, burst packets included.
    """

    requests: int = 0
    lost: int = 0
    replies: int = 0


class Engine:
    """Runs operations against one server. Reads no clock: `now` is seconds of any monotonic clock.

    Args:
        rng: for the first seq and the session id to ask for.
        flow: the in-flight window.
        op_deadline: seconds without progress after which an operation fails with RequestTimeout.

    Attributes:
        on_unexplained: called with each reply beyond one for each transmission of its request, and with the
            seconds since the request went out (None if that is not known).
        on_unawaited: called with each ACK to a request whose operation has ended or was cancelled.
        session: the id that session-agnostic requests carry (the open one, else home_session).
        home_session: the id to ask for when opening, 1..255.
    """

    def __init__(self, rng: random.Random, flow: Flow, *, op_deadline: float = OP_DEADLINE) -> None:
        self.home_session = rng.randrange(1, 256)
        self.session = self.home_session
        self.flow = flow
        self.traits = Traits()
        self.stats = EngineStats()
        self.on_unexplained: Callable[[Payload, float | None], None] = lambda reply, lateness: None
        self.on_unawaited: Callable[[Payload, Request], None] = lambda reply, request: None
        self._ledger = Ledger(rng.randrange(LAST_SEQ + 1))
        self._op_deadline = op_deadline
        self._ops: list[Operation] = []
        self._gate = PathGate()
        self._timers = Timers()
        self._due = inf  # no timer of a request runs out before
        self._heard_at = -inf  # the last believed reply
        self._burst_heard_at = -inf  # believed or not: an abandoned burst of ArduPilot goes on

    # --- facts

    @property
    def rtt(self) -> float | None:
        """Smoothed round trip in seconds: of chunks of files, else of any request; None before the first."""
        timers = self._timers
        known = (one.smoothed for one in (timers.bulk, timers.single) if one.known)
        return next(known, None)

    @property
    def in_flight(self) -> int:
        """The number of requests in flight, those of cancelled operations included."""
        return len(self._ledger.outstanding)

    def serves_others(self, op: Operation) -> bool:
        """Return whether requests of other operations are in flight."""
        return any(request.op is not op for request in self._ledger.outstanding.values())

    def _is_owed_nothing(self, op: Operation) -> bool:
        """Return whether the vehicle answered what went out last, and none of it is this operation's."""
        requests = self._ledger.outstanding.values()
        return self._heard_at >= self.flow.sent_at and all(request.op is not op for request in requests)

    def timeout(self, policy: RetryPolicy) -> float:
        """Return how many seconds a first transmission waits for its answer at present."""
        return self._timers.timeout(policy)

    # --- traits

    def learn_session_echo(self, echoed: bool) -> None:
        """Note whether an open ACK had the session id that was asked for (servers.md 14.6). If so, the server
        is ArduPilot's, with one short queue for all clients."""
        self.traits.ack_carries_own_session = echoed
        if echoed:
            self.traits.queue_limit = SHARED_QUEUE_WINDOW
        self.flow.set_queue_limit(self.traits.queue_limit)

    def forget_server(self) -> None:
        """Forget what was learned of the server: it restarted, perhaps as another one."""
        self.traits.forget()
        self.session = self.home_session
        self.flow.set_queue_limit(self.traits.queue_limit)

    # --- operations

    def start(self, op: Operation, now: float) -> None:
        """Start an operation; its first request goes out with the next `outgoing`.

        Raises:
            LocalProtocolError: it was started before.
        """
        if op.started:
            raise LocalProtocolError("an operation runs once")
        op.started, op.port = True, self
        op.update_patience(now)
        if op.patience == inf:
            op.patience = self._op_deadline
        self._ops.append(op)
        self._ops.sort(key=lambda one: not one.urgent)

    def remove(self, op: Operation) -> None:
        """Forget an operation, ended or not; late replies to it are discarded. A second call is harmless."""
        if op not in self._ops:
            return
        self._ops.remove(op)
        self._ledger.release(op)

    # --- what comes in

    def receive(self, reply: Payload, now: float) -> None:
        """Take a reply of the server to this client; anything may be in it."""
        if reply.req_opcode == _BURST and self._on_burst(reply, now):
            return
        request = self._ledger.find(reply.seq)
        if request is None:
            if reply.req_opcode != _BURST:  # otherwise of a burst that was cancelled
                self.on_unexplained(reply, self._ledger.late_by(reply.seq, now))
        elif reply.req_opcode != request.opcode:
            self._on_replay(request, now)
        elif request.fits(reply, self.traits):
            self._on_reply(request, reply, now)

    def _on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take a believed reply."""
        ledger, op, late = self._ledger, request.op, not request.outstanding
        ledger.on_answered(request)
        if op is ledger.ghost:
            if not late:
                self._on_answers(request, 1, now)
            if reply.opcode == Opcode.ACK:
                self.on_unawaited(reply, request)
            return
        if late:
            self.flow.path.on_late()
            self._timers.reordering.on_late(now)
            ledger.on_late(request)
        self._on_answers(request, 1, now)
        if reply.opcode == _NAK and self._session_changed(request, reply):
            request.stale = True
            op.on_lost(request, now)
        else:
            op.on_reply(request, reply, now)
            if op.done:
                self.remove(op)

    def receive_run(self, wires: Sequence[bytes], now: float) -> int:
        """Take replies of 251 bytes that came together as `receive` does; return how many were malformed."""
        replies = split_run(wires)
        at, malformed = 0, 0
        while at < len(replies):
            run = self._ledger.on_run(replies, at, self._burst_heard_at)
            if run:
                op = run[0][0].op
                self._on_answers(run[-1][0], len(run), now)
                op.on_run(run, now)
                if op.done:
                    self.remove(op)
            else:
                try:
                    self.receive(reply_of(replies[at]), now)
                except RemoteProtocolError:
                    malformed += 1
            at += len(run) or 1
        return malformed

    def _on_answers(self, newest: Request, count: int, now: float) -> None:
        """Note answers to requests of one operation that went out together; newest: the last of them."""
        ledger, timers = self._ledger, self._timers
        self.stats.replies += count
        self._heard_at = now
        timed = newest.sent_at == newest.first_sent and newest.sent_at > self._burst_heard_at
        rtt = timers.sample(newest, now) if timed else None
        size = newest.size if newest.policy.bulk else MAX_DATA
        self.flow.on_replies(now, rtt, count, newest.order, ledger.order, size)
        if rtt is None:
            return  # if it is not known which transmission was answered, no earlier request is passed
        ledger.on_passed(newest)
        wait = timers.passed_wait(rtt, now) if ledger.passed else 0.0
        for request in list(ledger.passed.values()):
            request.timer = request.sent_at + wait
            if request.timer <= now:
                self._lose(request, now)
            else:
                self._due = min(self._due, request.timer)

    def _on_replay(self, request: Request, now: float) -> None:
        """Note a reply of another opcode under a request's seq: the server replays an earlier reply, and will
        never answer this seq (servers.md 2), so the request goes out again under a new one. The reply may
        also be a packet of an abandoned burst, and a new seq means one more execution, so the engine first
        waits as long as for an answer."""
        if request.outstanding and not request.stale:
            request.stale = True
            request.timer = min(request.timer, now + self._timers.timeout(request.policy))
            self._due = min(self._due, request.timer)

    def _session_changed(self, request: Request, reply: Payload) -> bool:
        """Return whether a refusal only means that the session changed while the request was in flight."""
        changed = request.follows and request.session != self.session
        return changed and reply.data[:1] == _INVALID_SESSION

    def _lose(self, request: Request, now: float) -> None:
        """Declare a request lost. Its operation asks again, unless that has ended."""
        op = request.op
        self.flow.path.on_loss()
        self._ledger.retire(request)
        if op is not self._ledger.ghost:
            self.stats.lost += 1
            op.on_lost(request, now)

    # --- bursts

    def _on_burst(self, reply: Payload, now: float) -> bool:
        self._burst_heard_at = now
        for op in self._ops:
            if op.on_burst(reply, now):
                self.stats.replies += 1
                self._heard_at = now
                op.progress(now)
                if op.done:
                    self.remove(op)
                return True
        return False

    # --- what goes out

    def outgoing(self, now: float) -> list[bytes]:
        """Return the payloads (251 bytes each) to send now, most urgent first, within the window."""
        wires: list[bytes] = []
        self.flow.begin()
        concerned = self._ops if self.traits.paths_block_writes else ()
        self._gate.look(concerned, self._ledger.outstanding.values(), now, self.rtt)
        has_room = True
        for op in self._ops.copy():
            has_room = has_room and self._serve(op, now, wires)
            if op.done:
                self.remove(op)
        if has_room:
            self.flow.path.on_app_limited()
        return wires

    def hold(self, now: float) -> None:
        """Send nothing now. The patience of operations runs all the same, unless they are idle."""
        for op in self._ops:
            op.update_patience(now)

    def _serve(self, op: Operation, now: float, wires: list[bytes]) -> bool:
        """Send what `op` has; return False when the window is full."""
        if op.done or not op.update_patience(now):
            return True
        if self._gate.keeps(op):
            op.progress(now)  # the vehicle owes no answer
            return True
        if self._waits_for_exclusive(op):
            return True
        # An urgent one may use one slot more than bulk work: a full window must not make it wait.
        urgent = op.urgent
        in_flight = self.in_flight - len(self._ledger.passed) - urgent
        room = self.flow.room(in_flight, now, paced=op.paced, urgent=urgent)
        if room <= 0 and self.flow.limited and self._is_owed_nothing(op):
            op.progress(now)
        left, size = room, 0
        while left > 0:
            requests = op.next_requests(left, now)
            if not requests:
                break
            wires += self._transmit(requests, now)
            left -= len(requests)
            size += sum(MAX_DATA if urgent else request.size for request in requests)
        if sent := room - left:
            self.stats.requests += sent
            self.flow.on_sent(sent, size, now)
        return left > 0

    def _waits_for_exclusive(self, op: Operation) -> bool:
        """Return whether another operation is exclusive. Requests that went out before may still be in
        flight, because the server executes them first."""
        lone = next((one for one in self._ops if one.exclusive and not self._gate.keeps(one)), None)
        return lone is not None and op is not lone

    def _transmit(self, requests: Sequence[Request], now: float) -> list[bytes]:
        """Number requests of one opcode, and return them encoded."""
        first, ledger = requests[0], self._ledger
        op, policy = first.op, first.policy
        op.sent += 1
        quiet = now - op.progress_at
        timer = now + self._timers.wait(policy, quiet)
        if first.follows:
            first.session = self.session
        if first.owed:
            ledger.relaunch(first, now, timer)
        else:
            ledger.launch(requests, now, timer)
        if first.opcode == _BURST:
            ledger.leave(first)  # its packets tell what became of it, and it is never repeated
            # No later request may have the seq of one of its packets (servers.md 2, collision).
            ledger.jump(op.on_burst_sent(first, now))
        else:
            self._due = min(self._due, timer)
        return encode(requests, waits=(quiet + _EARLY) / self._timers.timeout(policy))

    # --- timers

    def next_deadline(self) -> float | None:
        """Return when `on_deadline` is to be called, or None if nothing is pending."""
        deadline = min(self._due if self._ledger.outstanding else inf, self.flow.next_room_at())
        for op in self._ops:
            deadline = min(deadline, op.timer, op.progress_at + op.patience)
        return None if deadline == inf else deadline

    def on_deadline(self, now: float) -> None:
        """Declare overdue requests lost, and fail operations without progress for their patience. Harmless
        when called early or late."""
        if now >= self._due:
            self._lose_overdue(now)
        for op in self._ops.copy():
            if op.timer <= now:
                op.on_timer(now)
            if op.progress_at + op.patience <= now and not op.done:
                op.fail(RequestTimeout(f"no answer within {round(op.patience, 1):g} s"))
            if op.done:
                self.remove(op)

    def _lose_overdue(self, now: float) -> None:
        unheard = 0
        self._due = inf
        for request in list(self._ledger.outstanding.values()):
            if request.timer <= now and not (request.order in self._ledger.passed or request.stale):
                request.timer = self._overdue_at(request, now)
            if request.timer > now:
                self._due = min(self._due, request.timer)
                continue
            unheard += self._heard_at < request.sent_at
            self._lose(request, now)
        if unheard:
            self.flow.on_silence(unheard)

    def _overdue_at(self, request: Request, now: float) -> float:
        """Return when a request's timer runs out, by the round trips known now, because they may have grown
        since it went out. ArduPilot answers nothing else during a burst, so silence proves nothing then
        (servers.md 4)."""
        policy, op, path = request.policy, request.op, self.flow.path
        quiet = max(0.0, request.sent_at - op.progress_at)
        due = max(request.sent_at, self._burst_heard_at) + self._timers.wait(policy, quiet)
        paused = policy.ordered and not path.app_limited and self.in_flight > _FEW
        # A stream of other answers is no pause.
        return max(due, min(due, self._heard_at) + (path.pauses.length if paused else 0.0))
