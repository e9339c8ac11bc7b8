"""The client engine: sequence numbers, the table of outstanding requests, timers. Layer: protocol; pure.

Theory of operation. Operations say what to ask (`next_request`) and are told of believed answers. The
engine gives each transmission a seq and an *order* number; a reply is found by its seq (request + 1) and
believed when req_opcode, and where servers echo them session and offset, are the request's. What is not
believed is counted and changes nothing.

Loss: servers answer in order (servers.md 3), so when a request sent `_reorder` or more transmissions
later was answered, an idempotent request is taken to be lost at once; else its timer decides. A lost
request waits in `_again` and goes out before new ones of its priority; old seqs stay valid as aliases
until the request is answered. While burst packets arrive timers stand still, because ArduPilot answers
nothing else then. Requests of cancelled operations keep their place in the window as ghosts: the server
still has them in its queue.
"""

from __future__ import annotations

import random
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import FLOORS, Operation, Priority, Request
from mavftpfs.protocol.rtt import RttEstimator
from mavftpfs.shared.errors import LocalProtocolError, RequestTimeout
from mavftpfs.shared.traits import Traits

OP_DEADLINE = 30.0
BURST_JUMP = 4096
_LAST_SEQ = 65534  # 65535 defeats the servers' duplicate test (servers.md 2)
_MIN_REORDER = 3
_MAX_REORDER = 64
_MAX_REPLAYS = 8
_BURST = int(Opcode.BURST_READ_FILE)
_ACK = int(Opcode.ACK)
_NAK = int(Opcode.NAK)


@dataclass(slots=True)
class EngineStats:
    """Plain counters since the engine was made.

    requests: transmissions. retransmissions: those of them that repeat a request. replies: believed
    ones, burst packets included. unknown: replies that fit nothing outstanding (late, duplicate, not
    ours). stale: right seq, wrong req_opcode. incoherent: right seq, but session, offset or opcode
    cannot be. spurious: retransmissions that turned out to be needless.
    """

    requests: int = 0
    retransmissions: int = 0
    replies: int = 0
    naks: int = 0
    unknown: int = 0
    stale: int = 0
    incoherent: int = 0
    spurious: int = 0
    timeouts: int = 0
    by_opcode: dict[int, int] = field(default_factory=dict)


class Engine:
    """Runs operations against one server. Reads no clock: `now` is seconds of any monotonic clock.

    Args:
        rng: for the first seq and the session id to ask for.
        flow: the in-flight window.
        op_deadline: seconds without progress after which an operation fails with RequestTimeout.
        traits: what is already known of the server.
        note: called with one line for each thing a trace should show.

    Attributes:
        session: the id that session-agnostic requests carry (the open one, else home_session).
        home_session: the id to ask for when opening, 1..255.
    """

    def __init__(
        self,
        rng: random.Random,
        flow: Flow,
        *,
        op_deadline: float = OP_DEADLINE,
        traits: Traits | None = None,
        note: Callable[[str], None] | None = None,
    ) -> None:
        self.home_session = rng.randrange(1, 256)
        self.session = self.home_session
        self.flow = flow
        self.traits = Traits() if traits is None else traits
        self.stats = EngineStats()
        self.burst_heard_at = -inf
        self._seq = rng.randrange(_LAST_SEQ + 1)
        self._op_deadline = op_deadline
        self._note = note
        self._order = 0
        self._newest_answered = -1
        self._reorder = _MIN_REORDER
        self._table: dict[int, Request] = {}
        self._ordered: OrderedDict[int, Request] = OrderedDict()
        self._unordered: dict[int, Request] = {}
        self._again: list[Request] = []
        self._ops: list[Operation] = []
        self._finished: deque[Operation] = deque()
        self._burst_op: Operation | None = None
        self._timers = {family: RttEstimator(floor) for family, floor in FLOORS.items()}
        self._due = inf
        self._heard_at = -inf
        self._ghost_op = _Ghost()

    # --- facts

    @property
    def rtt(self) -> float | None:
        """Smoothed round trip in seconds: of reads, else of any request; None before the first."""
        known = [timer for timer in self._timers.values() if timer.known]
        return known[0].smoothed if known else None

    @property
    def in_flight(self) -> int:
        """Requests on their way, those of cancelled operations included."""
        return len(self._ordered) + len(self._unordered)

    @property
    def loss(self) -> float:
        """Share of request/reply pairs lost lately, 0..1."""
        return self.flow.loss

    def round_trip(self, family: str) -> float:
        """Return the present retransmission timeout of a family of opcodes, in seconds."""
        return self._timers[family].rto

    def note(self, text: str) -> None:
        """Tell the trace something."""
        if self._note is not None:
            self._note(text)

    # --- operations

    def start(self, op: Operation, now: float) -> None:
        """Take an operation on; its first request goes out with the next `outgoing`."""
        op.attach(self, now)
        self._ops.append(op)
        self._ops.sort(key=_priority)

    def cancel(self, op: Operation, now: float) -> None:
        """Forget an operation; its late replies are discarded. Harmless when it is finished."""
        if op in self._ops:
            self._ops.remove(op)
            self._release(op)

    def take_finished(self) -> list[Operation]:
        """Return the operations that ended since the last call."""
        finished = list(self._finished)
        self._finished.clear()
        return finished

    def _release(self, op: Operation) -> None:
        for request in set(self._table.values()):
            if request.op is op:
                self._make_ghost(request)
        self._again = [request for request in self._again if request.op is not op]
        if self._burst_op is op:
            self._burst_op = None

    def _make_ghost(self, request: Request) -> None:
        if request.flying:
            request.op = self._ghost_op
        else:
            self._forget(request)

    def _retire(self) -> None:
        """Move ended operations to the finished ones."""
        if any(op.done for op in self._ops):
            for op in self._ops:
                if op.done:
                    self._release(op)
                    self._finished.append(op)
            self._ops = [op for op in self._ops if not op.done]

    # --- what comes in

    def receive(self, reply: Payload, now: float) -> None:
        """Take a reply of our server to us; anything may be in it. Never raises."""
        req_opcode = reply.req_opcode
        if req_opcode == _BURST and self._on_burst(reply, now):
            return
        request = self._table.get(reply.seq)
        if request is None:
            self.stats.unknown += 1
        elif req_opcode != request.opcode:
            self._on_stale(request)
        elif not self._coherent(request, reply):
            self.stats.incoherent += 1
        elif not self._asks_again(request, reply):
            self._believe(request, reply, now)

    def _coherent(self, request: Request, reply: Payload) -> bool:
        if self.traits.ack_carries_own_session and reply.session != request.session and not request.follows:
            return False
        if reply.opcode == _ACK:
            return reply.offset == request.offset or not request.manner.echoes_offset
        return reply.opcode == _NAK

    def _believe(self, request: Request, reply: Payload, now: float) -> None:
        stats = self.stats
        stats.replies += 1
        self._heard_at = now
        order = request.order
        rtt: float | None = None
        if reply.seq != (request.seq + 1) & 0xFFFF:
            # An earlier transmission was answered after all: the network reorders more than we thought.
            stats.spurious += 1
            self._reorder = min(self._reorder * 2, _MAX_REORDER)
        else:
            if request.single and self.burst_heard_at < request.sent_at:
                rtt = now - request.sent_at
                self._timers[request.manner.family].sample(rtt)
            if order > self._newest_answered:
                self._newest_answered = order
        self._forget(request)
        self.flow.on_reply(now, rtt, order, self._order)
        self._find_losses()
        op = request.op
        op.progress_at = now
        if reply.opcode == _NAK:
            stats.naks += 1
        op.on_reply(request, reply, now)
        if op.done:
            self._retire()

    def _on_stale(self, request: Request) -> None:
        """A replay of some earlier reply under this seq: this seq will never be answered (servers.md 2)."""
        self.stats.stale += 1
        request.replays += 1
        if request.replays <= _MAX_REPLAYS and request.flying:
            self.note(f"stale replay for seq {request.seq}: asking again under a new one")
            request.fresh_seq = True
            self._lose(request)

    def _asks_again(self, request: Request, reply: Payload) -> bool:
        """Whether a refusal only says that the session changed while the request was on its way."""
        if reply.opcode != _NAK or not request.follows or request.session == self.session:
            return False
        if reply.data[:1] != bytes((NakCode.INVALID_SESSION,)) or request.replays >= _MAX_REPLAYS:
            return False
        request.replays += 1
        request.fresh_seq = True
        if request.flying:
            self._lose(request)
        return True

    def _on_burst(self, reply: Payload, now: float) -> bool:
        self.burst_heard_at = now
        op = self._burst_op
        if op is None or not op.on_burst(reply, now):
            return False
        self.stats.replies += 1
        op.progress_at = now
        self._heard_at = now
        if op.done:
            self._retire()
        return True

    def _forget(self, request: Request) -> None:
        """Take an answered (or hopeless) request out of everything."""
        request.answered = True
        table = self._table
        table.pop((request.seq + 1) & 0xFFFF, None)
        if request.aliases is not None:
            for key in request.aliases:
                table.pop(key, None)
        if request.flying:
            self._land(request)
        else:
            self._again = [other for other in self._again if other is not request]

    def _land(self, request: Request) -> None:
        request.flying = False
        if request.manner.ordered:
            del self._ordered[request.order]
        else:
            del self._unordered[request.order]

    def _find_losses(self) -> None:
        ordered = self._ordered
        limit = self._newest_answered - self._reorder
        while ordered:
            order = next(iter(ordered))
            if order > limit:
                break
            self.flow.on_loss()
            self._lose(ordered[order])

    def _lose(self, request: Request) -> None:
        """A transmission will not be answered: ask again, unless nobody wants to know any more."""
        self._land(request)
        if request.op is self._ghost_op:
            self._forget(request)
        else:
            self._again.append(request)

    # --- what goes out

    def outgoing(self, now: float) -> list[bytes]:
        """Return the payloads (251 bytes each) to send now, most urgent first, within the window."""
        wires: list[bytes] = []
        if len(self._ops) > 1:
            self._ops.sort(key=_priority)
        if len(self._again) > 1:
            self._again.sort(key=_urgency)
        starved = False
        for op in self._ops:
            starved = self._serve(op, now, wires)
            if not starved:
                break
        if starved and self._ordered:
            self.flow.on_starved()
        self._retire()
        return wires

    def _room(self, priority: Priority) -> int:
        # Metadata may use one slot more than bulk work: a full window must not make it wait.
        extra = 1 if priority is Priority.METADATA else 0
        return self.flow.window + extra - len(self._ordered) - len(self._unordered)

    def _serve(self, op: Operation, now: float, wires: list[bytes]) -> bool:
        """Send what `op` has; return False when the window is full."""
        if op.idle:
            op.progress_at = inf
            return True
        if op.progress_at == inf:
            op.progress_at = now
        room = self._room(op.priority)
        while room > 0:
            request = self._next_again(op) or op.next_request(now)
            if request is None:
                return True
            wires.append(self._transmit(request, now))
            room -= 1
        return op.done

    def _next_again(self, op: Operation) -> Request | None:
        for index, request in enumerate(self._again):
            if request.op is op:
                return self._again.pop(index)
        return None

    def _transmit(self, request: Request, now: float) -> bytes:
        stats = self.stats
        stats.requests += 1
        by_opcode = stats.by_opcode
        by_opcode[request.opcode] = by_opcode.get(request.opcode, 0) + 1
        if request.follows:
            request.session = self.session
        if request.sends == 0:
            request.first_sent = now
            request.op.sent = True
            request.seq = self._next_seq()
        else:
            stats.retransmissions += 1
            self._rename(request)
        request.sends += 1
        request.sent_at = now
        request.order = self._order
        self._order += 1
        if request.opcode == _BURST:
            self._begin_burst(request, now)
        else:
            self._enter(request, now)
        return request.encode()

    def _enter(self, request: Request, now: float) -> None:
        self._table[(request.seq + 1) & 0xFFFF] = request
        request.flying = True
        if request.manner.ordered:
            self._ordered[request.order] = request
        else:
            self._unordered[request.order] = request
        request.timer = timer = now + self._wait(request)
        if timer < self._due:
            self._due = timer

    def _rename(self, request: Request) -> None:
        """Give a request that goes out again its seq."""
        if request.manner.same_seq and not request.fresh_seq:
            request.single = False
            return
        if request.aliases is None:
            request.aliases = []
        request.aliases.append((request.seq + 1) & 0xFFFF)
        request.seq = self._next_seq()
        request.single = True
        request.fresh_seq = False

    def _next_seq(self) -> int:
        table = self._table
        seq = self._seq
        for _ in range(len(table) + 1):
            if seq > _LAST_SEQ:
                seq = 0
            if (seq + 1) & 0xFFFF not in table:
                break
            seq += 1
        self._seq = seq + 1
        return seq

    def _begin_burst(self, request: Request, now: float) -> None:
        self._burst_op = request.op
        # Whatever the burst's packets use as seq must not be a seq of ours (servers.md 2, collision).
        self._seq = (self._seq + BURST_JUMP) % (_LAST_SEQ + 1)
        request.op.on_burst_sent(request, now)

    # --- timers

    def _wait(self, request: Request) -> float:
        manner = request.manner
        timer = self._timers[manner.family]
        if manner.ordered and manner.patience == 0.0:
            return timer.rto
        wait = timer.rto * (1 << min(request.sends - 1, 6))
        if request.sends >= manner.patient_after:
            return max(wait, manner.patience)
        return min(wait, max(timer.rto, 5.0))

    def next_deadline(self) -> float | None:
        """Return when `on_deadline` wants to be called, or None if nothing is pending."""
        deadline = self._due if self._table else inf
        for op in self._ops:
            if op.timer < deadline:
                deadline = op.timer
            give_up = op.progress_at + self._patience(op)
            if give_up < deadline:
                deadline = give_up
        return None if deadline == inf else deadline

    def _patience(self, op: Operation) -> float:
        return self._op_deadline if op.patience is None else op.patience

    def on_deadline(self, now: float) -> None:
        """Act on what is overdue; harmless when called early or late."""
        for op in self._ops:
            if op.timer <= now:
                op.on_timer(now)
            if op.progress_at + self._patience(op) <= now and not op.done:
                self.stats.timeouts += 1
                op.fail(RequestTimeout(f"no answer within {self._patience(op):g} s"))
        self._retire()
        if now >= self._due:
            self._check_timers(now)

    def _check_timers(self, now: float) -> None:
        due = inf
        silent = False
        for request in [*self._ordered.values(), *self._unordered.values()]:
            if request.timer <= now:
                self._postpone(request)
            if request.timer <= now:
                silent = self._expire(request, now) or silent
            elif request.timer < due:
                due = request.timer
        self._due = due
        if silent:
            self.flow.on_silence()
        self._retire()

    def _postpone(self, request: Request) -> None:
        """During a burst silence proves nothing, unless this server was seen to answer in between."""
        heard = self.burst_heard_at
        if heard > request.sent_at and not self.traits.answers_during_burst:
            request.timer = heard + self._wait(request)

    def _expire(self, request: Request, now: float) -> bool:
        """A timer ran out; return whether nothing at all was heard since the request was sent."""
        op = request.op
        if now - request.first_sent >= self._patience(op) and op is not self._ghost_op:
            self.stats.timeouts += 1
            op.fail(RequestTimeout(f"one request was not answered within {self._patience(op):g} s"))
            return False
        silent = self._heard_at < request.sent_at
        if silent:
            self._timers[request.manner.family].back_off()
        self.flow.on_loss()
        self._lose(request)
        return silent


class _Ghost(Operation):
    """Owns the requests of cancelled operations until they are answered or given up."""

    def next_request(self, now: float) -> Request | None:
        raise LocalProtocolError("a ghost asks for nothing")

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Nobody wants to know."""


def _priority(op: Operation) -> Priority:
    return op.priority


def _urgency(request: Request) -> int:
    return request.order
