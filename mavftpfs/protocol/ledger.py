"""Which requests are out, under which seqs, and which of them are lost. Layer: protocol; pure.

Every transmission has a seq, by which its reply is found, and an *order* number, by which losses are found.
Servers answer in order (servers.md 3). So an idempotent request is lost once a request was answered that was
sent `reorder` or more transmissions later. Old seqs stay valid as aliases until the request is answered. A
lost request waits in `again`. A request whose operation was cancelled becomes a ghost: it keeps its place in
the window, because the server still has it in its queue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import islice

from mavftpfs.protocol.payload import MAX_DATA, Fields, Opcode, Payload
from mavftpfs.protocol.requests import Operation, Request, Run, Transmission

LAST_SEQ = 65534
"""65535 is never used: it defeats the servers' duplicate test (servers.md 2)."""

BURST_JUMP = 4096
FURTHEST_JUMP = LAST_SEQ + 1 - 2 * BURST_JUMP
"""A longer jump would reach seqs that were just used, and whose late replies may still come."""

_ACK = int(Opcode.ACK)
_MIN_REORDER = 2
"""A request is lost after so many later answers. Few, because until then it takes a place of a short
queue."""

_MAX_REORDER = 64


_MOST_REMEMBERED = 1024
"""Requests whose late answers are remembered, and groups of requests whose time is; a window holds fewer."""


class DuplicateDetector:
    """Knows which answers are still to come, and when requests went out.

    A request that was sent twice may be answered twice. Any further answer means that the network delivered
    a request, or its answer, more than once. So a request may be carried out once more at any time.

    Answers are known by their seq, which is the request's plus one.
    """

    def __init__(self) -> None:
        self._expected: dict[int, tuple[int, float]] = {}  # how many more, and when it went out first
        self._sent: deque[tuple[int, int, float]] = deque(maxlen=_MOST_REMEMBERED)

    def on_sent(self, first: int, last: int, now: float) -> None:
        """Note when requests with these seqs and those between them go out."""
        self._sent.append((first, last, now))

    def on_over(self, request: Request, answered: int | None) -> None:
        """Note that a request is over. answered: the seq of the answer that came, if one did."""
        seqs = {request.seq + 1, *(request.aliases or ())}
        for seq in seqs:
            # With several seqs it is not known how often each was sent.
            left = request.sends - (len(seqs) - 1) - (seq == answered)
            if left > 0:
                self._expected.pop(seq, None)
                self._expected[seq] = left, request.first_sent
        while len(self._expected) > _MOST_REMEMBERED:
            del self._expected[next(iter(self._expected))]

    def explains(self, seq: int) -> float | None:
        """Return when the request of an answer went out first, if one more answer was to come; it is not
        expected again. None: no repetition of ours explains this answer."""
        left, sent_at = self._expected.pop(seq, (0, 0.0))
        if left > 1:
            self._expected[seq] = left - 1, sent_at
        return sent_at if left else None

    def late_by(self, seq: int, now: float) -> float | None:
        """Return the seconds since the request with this answer went out under this seq; None: unknown."""
        for first, last, sent_at in reversed(self._sent):
            if (seq - 1 - first) % (LAST_SEQ + 1) <= (last - first) % (LAST_SEQ + 1):
                return now - sent_at
        return None


class Ghost(Operation):
    """Owns the requests of cancelled operations until they are answered or given up. It is asked for
    nothing."""

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Nothing to do: the answer is not wanted any more."""


class Ledger:
    """The outstanding requests of one engine. next_seq: the first seq to use.

    Attributes:
        again: lost requests which go out again as soon as there is room.
        newest_answered: order of the last transmission that was answered. looked_at: all transmissions of a
            lower order were looked at for losses.
        flying: the requests on their way by the order of their transmission, oldest first, ghosts included.
        order: number of the next transmission.
        reorder: how many transmissions later an answer must be to prove a loss; grows when that was wrong.
        duplicates: see DuplicateDetector.
    """

    def __init__(self, next_seq: int) -> None:
        self._seq = next_seq
        self.duplicates = DuplicateDetector()
        self._table: dict[int, Request] = {}
        self.flying: dict[int, Request] = {}
        self.find = self._table.get
        """Returns the unanswered request to which a reply with a seq belongs, or None."""
        self.looked_at = 0
        self.newest_answered = -1
        self.again: list[Request] = []
        self.ghost = Ghost()
        self.order = 0
        self.reorder = _MIN_REORDER

    # --- going out

    def take_seq(self) -> int:
        """Return an unused seq, 0..65534, and count on."""
        table = self._table
        seq = self._seq
        while seq > LAST_SEQ or seq + 1 in table:  # bounded: the table is far smaller than 65535
            seq = 0 if seq > LAST_SEQ else seq + 1
        self._seq = seq + 1
        return seq

    def jump(self, packets: int) -> None:
        """Skip the seqs that a server may use by itself in a burst of so many packets, and as many more:
        packets of a burst may come long after it was given up (servers.md 14.3)."""
        distance = min(max(BURST_JUMP, 2 * packets), FURTHEST_JUMP)
        self._seq = (self._seq + distance) % (LAST_SEQ + 1)

    def launch(self, requests: Sequence[Request], now: float, timer: float) -> None:
        """Number requests that go out for the first time, and note that they are on their way."""
        table, flying = self._table, self.flying
        order = self.order
        for request in requests:
            seq = self._seq
            if seq > LAST_SEQ or seq + 1 in table:
                seq = self.take_seq()
            else:
                self._seq = seq + 1
            request.seq = seq
            request.order = order
            request.sent_at = request.first_sent = now
            request.timer = timer
            request.sends = 1
            request.flying = True
            table[seq + 1] = flying[order] = request
            order += 1
        self.order = order
        self.duplicates.on_sent(requests[0].seq, requests[-1].seq, now)

    def relaunch(self, request: Request, now: float) -> None:
        """Number a request that goes out again, and note that it is on its way."""
        same_seq = request.manner.same_seq and not request.fresh_seq
        if not same_seq:
            if request.aliases is None:
                request.aliases = {}
            past = Transmission(request.order, request.sent_at, request.single, request.outrun)
            request.aliases[request.seq + 1] = past
            request.seq = self.take_seq()
            request.fresh_seq = False
        request.single = not same_seq
        request.order = self.order
        request.outrun = False
        request.sent_at = now
        request.sends += 1
        self.order += 1
        if not same_seq:
            self.duplicates.on_sent(request.seq, request.seq, now)
        self._table[request.seq + 1] = self.flying[request.order] = request
        request.flying = True

    def leave(self, request: Request) -> None:
        """It is on its way, but no answer to it is waited for."""
        request.flying = False
        del self._table[request.seq + 1], self.flying[request.order]

    # --- coming in

    def settle_run(self, replies: list[Fields], at: int, after: float) -> Run:
        """Take out the requests that a row of usual replies, from index `at` on, answers; return them with
        their data.

        A usual reply is an ACK that `Engine.receive` would believe, to the only transmission of a request
        with the opcode `bulk` of its operation, sent later than `after`. The row ends where operation or time
        change.
        """
        table, flying = self._table, self.flying
        request = table.get(replies[at][0])
        run: Run = []
        if request is None or request.sent_at <= after:
            return run
        op, opcode, sent_at, newest = request.op, request.op.bulk, request.sent_at, self.newest_answered
        for seq, session, ack, size, req_opcode, _, offset, data in islice(replies, at, None):
            request = table.get(seq)
            if request is None or ack != _ACK or not req_opcode == request.opcode == opcode:
                break
            if offset != request.offset or session != request.session or size > MAX_DATA:
                break
            if request.sends != 1 or not request.flying or request.sent_at != sent_at or request.op is not op:
                break
            request.flying = False
            order = request.order
            del table[seq], flying[order]
            if order > newest:
                newest = order
            run.append((request, data if size == MAX_DATA else data[:size]))
        self.newest_answered = newest
        return run

    def settle(self, request: Request, seq: int) -> bool:
        """Take out a request answered under `seq`; return False if that was an alias.

        Its order, sent_at, single and outrun are those of the answered transmission from then on.
        """
        self.forget(request, seq)
        current = seq == request.seq + 1
        if not current and request.aliases is not None:
            request.order, request.sent_at, request.single, request.outrun = request.aliases[seq]
        if request.outrun:
            # What later answers seemed to prove lost is answered after all: the path reorders.
            self.reorder = min(self.reorder * 2, _MAX_REORDER)
        elif current and request.sends > 1 and self.reorder > _MIN_REORDER:
            self.reorder -= 1
        if request.order > self.newest_answered:
            self.newest_answered = request.order
        return current

    def forget(self, request: Request, answered: int | None = None) -> None:
        """Take a request out of everything. answered: the seq of the answer that came, if one did."""
        if answered is None or request.sends > 1:
            self.duplicates.on_over(request, answered)
        table = self._table
        table.pop(request.seq + 1, None)
        if request.aliases is not None:
            for key in request.aliases:
                table.pop(key, None)
        if request.flying:
            request.flying = False
            del self.flying[request.order]
        else:
            self.again = [other for other in self.again if other is not request]

    def lose_outrun(self) -> list[Request]:
        """Lose the requests that later answers prove to be lost, and return them."""
        lost = []
        proven = self.newest_answered - self.reorder
        for order in range(self.looked_at, proven + 1):  # looks at each transmission once
            request = self.flying.get(order)
            if request is not None and request.manner.ordered:
                request.outrun = True
                self.lose(request)
                lost.append(request)
        self.looked_at = max(self.looked_at, proven + 1)
        return lost

    def lose(self, request: Request) -> None:
        """Give up a transmission. The request goes out again, unless its answer is not wanted any more."""
        request.flying = False
        del self.flying[request.order]
        if request.op is self.ghost:
            self.forget(request)
        else:
            self.again.append(request)

    # --- by operation

    def take_again(self, op: Operation, now: float) -> Request | None:
        """Remove and return the oldest lost request of `op` that is to go out again, or None."""
        index = 0
        while index < len(self.again):
            request = self.again[index]
            if request.op is not op:
                index += 1
            elif op.takes_back(request, now):
                self.forget(request)
            else:
                return self.again.pop(index)
        return None

    def release(self, op: Operation) -> None:
        """Forget what `op` had lost, and make ghosts of what it has on its way."""
        for request in self.again.copy():
            if request.op is op:
                self.forget(request)
        for request in self.flying.values():
            if request.op is op:
                request.op = self.ghost
