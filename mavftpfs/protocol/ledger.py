"""The requests in flight, and the seqs under which answers may still come. Layer: protocol; pure.

Every transmission has an *order* number, and every request a seq, by which the ledger finds it when an answer
arrives. A lost request stays known under its seq, so its late answer counts, and is no sign of a duplicate.
The same holds for a request with fewer answers than transmissions. If its operation ends, a request becomes a
ghost. A ghost keeps its place in the window, because the server still has it in its queue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import islice

from mavftpfs.protocol.payload import MAX_DATA, Fields, Opcode
from mavftpfs.protocol.requests import Operation, Request, Run

LAST_SEQ = 65534
"""65535 is never used: it defeats the servers' duplicate test (servers.md 2)."""

BURST_JUMP = 4096
FURTHEST_JUMP = LAST_SEQ + 1 - 2 * BURST_JUMP
"""A longer jump would reach seqs that were just used, and whose late replies may still come."""

MOST_REMEMBERED = 1024
"""Requests that are not outstanding and may be answered, and groups of requests whose time is known."""

_ACK = int(Opcode.ACK)


class Ledger:
    """The requests of one engine. next_seq: the first seq to use.

    Attributes:
        outstanding: the requests in flight by the order of their transmission, oldest first, ghosts included.
        passed: those of them that have no place in the window, and are soon lost: a later request was
            answered, and servers answer in order; or an earlier request for the same bytes was answered late.
        order: number of the next transmission.
        find: returns the request that a reply with a seq may answer, or None.
        ghost: owns the requests of operations that ended, until they are answered or lost. The engine never
            asks it for requests, nor gives it replies.
    """

    def __init__(self, next_seq: int) -> None:
        self._seq = next_seq
        self._table: dict[int, Request] = {}  # by the seq of their answers: outstanding ones and late ones
        self._sent: deque[tuple[int, int, float]] = deque(maxlen=MOST_REMEMBERED)
        self.outstanding: dict[int, Request] = {}
        self.passed: dict[int, Request] = {}
        self.find = self._table.get
        self.ghost = Operation()
        self.order = 0

    # --- going out

    def take_seq(self) -> int:
        """Return the next seq, 0..65534, under which no answer is expected, and advance."""
        table = self._table
        seq = self._seq
        while seq > LAST_SEQ or seq + 1 in table:  # bounded: the table is far smaller than 65535
            seq = 0 if seq > LAST_SEQ else seq + 1
        self._seq = seq + 1
        return seq

    def jump(self, packets: int) -> None:
        """Skip the seqs that a server uses for the packets of a burst, and as many more, because packets may
        arrive long after the burst was abandoned (servers.md 14.3)."""
        distance = min(max(BURST_JUMP, 2 * packets), FURTHEST_JUMP)
        self._seq = (self._seq + distance) % (LAST_SEQ + 1)

    def launch(self, requests: Sequence[Request], now: float, timer: float) -> None:
        """Number requests that go out for the first time, and note that they are outstanding."""
        table, outstanding = self._table, self.outstanding
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
            request.owed = 1
            request.outstanding = True
            table[seq + 1] = outstanding[order] = request
            order += 1
        self.order = order
        self._sent.append((requests[0].seq, requests[-1].seq, now))

    def relaunch(self, request: Request, now: float, timer: float) -> None:
        """Note that a request goes out again, under its seq."""
        request.order, self.order = self.order, self.order + 1
        request.sent_at, request.timer = now, timer
        request.owed += 1
        request.outstanding = True
        self._table[request.seq + 1] = self.outstanding[request.order] = request

    def leave(self, request: Request) -> None:
        """Forget a BurstReadFile that went out, because its operation recognises the packets itself."""
        request.outstanding = False
        del self._table[request.seq + 1], self.outstanding[request.order]

    # --- coming in

    def on_run(self, replies: list[Fields], at: int, after: float) -> Run:
        """Take out the requests that a row of usual replies, from index `at` on, answers; return them with
        their data.

        A usual reply is an ACK to an outstanding request with the opcode `bulk` of its operation, sent later
        than `after`, with its session and offset. That is stricter than `Request.fits`: where a server echoes
        less, its answers go through `Engine.receive`. The row ends where operation or time change.
        """
        table, outstanding, passed = self._table, self.outstanding, self.passed
        request = table.get(replies[at][0])
        run: Run = []
        if request is None or request.sent_at <= after:
            return run
        op, opcode, sent_at = request.op, request.op.bulk, request.sent_at
        for seq, session, ack, size, req_opcode, _, offset, data in islice(replies, at, None):
            request = table.get(seq)
            if request is None or ack != _ACK or not req_opcode == request.opcode == opcode:
                break
            if offset != request.offset or session != request.session or size > MAX_DATA:
                break
            if not request.outstanding or request.sent_at != sent_at or request.op is not op:
                break
            request.outstanding = False
            request.owed = 0
            del table[seq], outstanding[request.order]
            passed.pop(request.order, None)
            run.append((request, data if size == MAX_DATA else data[:size]))
        return run

    def on_answered(self, request: Request) -> None:
        """Note an answer to a request."""
        request.owed -= 1
        if request.outstanding:
            self.retire(request)
        if not request.owed:
            self._table.pop(request.seq + 1, None)

    def on_passed(self, answered: Request) -> None:
        """Note that the requests before an answered one are passed."""
        for order, request in self.outstanding.items():
            if order > answered.order:
                break
            if request.policy.ordered:
                self.passed[order] = request

    def on_late(self, answered: Request) -> None:
        """Note that a lost request was answered after all, so its repetitions are passed."""
        op, opcode, offset = answered.op, answered.opcode, answered.offset
        for order, request in self.outstanding.items():
            if request.op is op and request.opcode == opcode and request.offset == offset:
                self.passed[order] = request

    def retire(self, request: Request) -> None:
        """Note that a request stopped being outstanding; answers may still arrive."""
        request.outstanding = False
        del self.outstanding[request.order]
        self.passed.pop(request.order, None)
        if len(self._table) - len(self.outstanding) > MOST_REMEMBERED:
            del self._table[next(seq for seq, one in self._table.items() if not one.outstanding)]

    def late_by(self, seq: int, now: float) -> float | None:
        """Return the seconds since the request with this answer went out; None: forgotten."""
        for first, last, sent_at in reversed(self._sent):
            if (seq - 1 - first) % (LAST_SEQ + 1) <= (last - first) % (LAST_SEQ + 1):
                return now - sent_at
        return None

    def release(self, op: Operation) -> None:
        """Make ghosts of the requests of an operation."""
        for request in self._table.values():
            if request.op is op:
                request.op = self.ghost
