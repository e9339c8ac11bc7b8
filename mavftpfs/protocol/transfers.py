"""Reading an open file, by a window of ReadFile requests or by bursts. Layer: protocol; pure."""

from __future__ import annotations

from math import inf
from typing import Literal, Protocol

from mavftpfs.protocol.burst import Burst
from mavftpfs.protocol.chunked import Chunked
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import (
    KEEP_ALIVE_MANNER,
    READ_MANNER,
    Priority,
    Request,
    Run,
    manner_of,
    nak_of,
)
from mavftpfs.protocol.toeof import ReadToEof
from mavftpfs.shared.errors import FileChanged, FtpNak, MavftpfsError, SessionLost
from mavftpfs.shared.extents import ExtentSet

__all__ = ["DataSink", "ReadToEof", "ReadTransfer", "Strategy"]

Strategy = Literal["window", "burst"]

KEEP_ALIVE = 3.0
"""Seconds between harmless requests during a burst: PX4 closes a session 10 s after the last *request*."""

_READ = int(Opcode.READ_FILE)
_NAK = int(Opcode.NAK)
_SESSION_CODES = frozenset((NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND))
_DOUBTFUL_CODES = frozenset((NakCode.FAIL, NakCode.FILE_EXISTS))
_EBADF = 9
_ERRORS_TOLERATED = 2
_BARREN_BURSTS = 2
_SHORTS_TO_LEARN = 3
_MEASURE_SECONDS = 0.25


class DataSink(Protocol):
    """Where the bytes go."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) not yet held."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take bytes, which may be more than was wanted; what is already held must not be overwritten."""
        ...


class ReadTransfer(Chunked):
    """Reads wanted ranges of an open regular file for as long as its owner likes.

    Args:
        session: id of the open file. size: as the open ACK said; nothing beyond is ever asked for.
        sink: takes the data. chunk: bytes to ask for at once, 1..239.
        strategy: how to begin; `set_strategy` changes it at the next safe point.

    Attributes:
        received_bytes: delivered to the sink so far.

    Fails with SessionLost (reopen, and start another with `wants`), FileChanged (the file ends before its
    size), FtpNak, or RequestTimeout. `wants` stays valid after a failure.
    """

    bulk = _READ

    def __init__(
        self, session: int, size: int, sink: DataSink, chunk: int = MAX_DATA, strategy: Strategy = "window"
    ) -> None:
        super().__init__(chunk)
        self.session = session
        self.size = size
        self.strategy: Strategy = strategy
        self.received_bytes = 0
        self._sink = sink
        self._demand = ExtentSet()
        self._ahead = ExtentSet()
        self._gaps = ExtentSet()
        self._filling = False
        self._unanswered: dict[Request, None] = {}
        self._burst: Burst | None = None
        self._keep_alive_at = inf
        self._barren_bursts = 0
        self._errors = 0
        self._shorts: dict[int, int] = {}
        self._window_mark = 0.0
        self._window_seconds = 0.0
        self._window_bytes = 0
        self._burst_seconds = 0.0
        self._burst_bytes = 0

    # --- what the owner says and sees

    def want(self, start: int, stop: int, demand: bool) -> None:
        """Ask for what the sink lacks of [start, stop), clamped to the size, if it is not on its way."""
        asked = ExtentSet((request.offset, request.offset + request.size) for request in self._unanswered)
        for gap_start, gap_stop in self._sink.missing(start, min(stop, self.size)):
            for piece_start, piece_stop in asked.missing(gap_start, gap_stop):
                self._want_piece(piece_start, piece_stop, demand)

    def _want_piece(self, start: int, stop: int, demand: bool) -> None:
        if demand:
            self._demand.add(start, stop)
            self._ahead.discard(start, stop)
        else:
            for ahead_start, ahead_stop in self._demand.missing(start, stop):
                self._ahead.add(ahead_start, ahead_stop)

    def drop_readahead(self) -> None:
        """Forget wants that nobody waits for; what is on its way still arrives."""
        self._ahead.clear()
        gaps, self._gaps = self._gaps, ExtentSet()
        for start, stop in gaps:
            for part_start, part_stop in self._demand.intersection(start, stop):
                self._gaps.add(part_start, part_stop)

    def set_strategy(self, strategy: Strategy) -> None:
        """Go on by this strategy from the next safe point, which is the end of a running burst."""
        self.strategy = strategy

    @property
    def in_flight(self) -> int:
        """How many ReadFile requests are on their way, or lost and to be repeated."""
        return len(self._unanswered)

    @property
    def bursting(self) -> bool:
        """Whether a burst is running (ArduPilot answers nothing else until it ends)."""
        return self._burst is not None

    @property
    def wants(self) -> ExtentSet:
        """What is wanted and has not come, requests on their way included."""
        wants = self._demand.copy()
        for start, stop in self._ahead:
            wants.add(start, stop)
        for request in self._unanswered:
            wants.add(request.offset, request.offset + request.size)
        return wants

    @property
    def idle(self) -> bool:
        """Whether nothing is wanted, on its way or streaming."""
        return not self._unanswered and self._burst is None and self._demand.empty and self._ahead.empty

    @property
    def priority(self) -> Priority:
        """DEMAND while somebody waits."""
        return Priority.READAHEAD if self._demand.empty else Priority.DEMAND

    @property
    def window_rate(self) -> float | None:
        """Measured bytes per second of windowed reading, None before a quarter of a second of it."""
        return self._window_bytes / self._window_seconds if self._window_seconds >= _MEASURE_SECONDS else None

    @property
    def burst_rate(self) -> float | None:
        """Measured bytes per second of bursts with their pauses, None before the first one ended."""
        return self._burst_bytes / self._burst_seconds if self._burst_seconds > 0 else None

    # --- requests

    def next_request(self, now: float) -> Request | None:
        """Return the next ReadFile, the BurstReadFile that is due, or a keep-alive during a burst."""
        if self._burst is not None:
            return self._next_keep_alive(now)
        piece = self._next_gap() if self._filling else None
        if piece is None:
            if self.strategy == "burst":
                return self._next_burst()
            piece = self._demand.take_first(self.chunk) or self._ahead.take_first(self.chunk)
            if piece is None:
                return None
        start, stop = piece
        request = Request(self, _READ, READ_MANNER, self.session, start, stop - start)
        if not self._unanswered:
            self._window_mark = now
        self._unanswered[request] = None
        return request

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return ReadFile requests for a row of chunks, or what `next_request` says."""
        if self._burst is not None or self._filling or self.strategy == "burst":
            return super().next_requests(most, now)
        most = self.measure_row(most, now)
        chunk, session = self.chunk, self.session
        row = self._demand.take_first(most * chunk) or self._ahead.take_first(most * chunk)
        if row is None:
            return []
        start, stop = row
        requests = [
            Request(self, _READ, READ_MANNER, session, offset, chunk) for offset in range(start, stop, chunk)
        ]
        requests[-1].size = stop - requests[-1].offset
        if not self._unanswered:
            self._window_mark = now
        self._unanswered.update(dict.fromkeys(requests))
        return requests

    def _next_gap(self) -> tuple[int, int] | None:
        gap = self._gaps.take_first(self.chunk)
        if gap is None:
            self._filling = False
        else:
            self._forget_want(*gap)
        return gap

    def _forget_want(self, start: int, stop: int) -> None:
        self._demand.discard(start, stop)
        self._ahead.discard(start, stop)

    def _next_burst(self) -> Request | None:
        # ReadFile during a burst moves MAVSDK's shared stream position: never both at once.
        first = self._demand.first() or self._ahead.first()
        if self._unanswered or first is None:
            return None
        opcode = Opcode.BURST_READ_FILE
        return Request(self, opcode, manner_of(opcode), self.session, first[0], self.chunk)

    def _next_keep_alive(self, now: float) -> Request | None:
        if now < self._keep_alive_at:
            return None
        self._keep_alive_at = now + KEEP_ALIVE
        self._arm(now)
        return Request(self, Opcode.NONE, KEEP_ALIVE_MANNER, self.session, 0, 0)

    # --- replies to ReadFile

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Place a chunk, or find out what a refusal means."""
        if request.opcode != _READ:
            return
        del self._unanswered[request]
        self._window_seconds += now - self._window_mark
        self._window_mark = now
        if reply.opcode == _NAK:
            self._on_nak(request, nak_of(request, reply))
            return
        self.count_answered(request, 1, now)
        data = reply.data
        count = len(data)
        if count != request.size:
            data = data[: request.size]
            count = len(data)
            if count < request.size:
                self._on_short(request, count)
        if count:
            self.received_bytes += count
            self._window_bytes += count
            self._sink.on_data(request.offset, data)

    def on_run(self, run: Run, now: float) -> None:
        """Place chunks, those in a row together."""
        unanswered = self._unanswered
        self.count_answered(run[0][0], len(run), now)
        self._window_seconds += now - self._window_mark
        self._window_mark = now
        pieces: list[bytes] = []
        start = stop = run[0][0].offset
        for request, data in run:
            offset, size = request.offset, request.size
            del unanswered[request]
            if offset != stop:
                self._place(start, pieces)
                pieces, start = [], offset
            if len(data) != size:
                data = data[:size]
                if len(data) < size:
                    self._on_short(request, len(data))
            pieces.append(data)
            stop = offset + len(data)
            if self.done:
                break
        self._place(start, pieces)

    def _place(self, offset: int, pieces: list[bytes]) -> None:
        data = pieces[0] if len(pieces) == 1 else b"".join(pieces)
        if data:
            self.received_bytes += len(data)
            self._window_bytes += len(data)
            self._sink.on_data(offset, data)

    def _on_short(self, request: Request, count: int) -> None:
        start = request.offset + count
        self._demand.add(start, request.offset + request.size)
        if count == 0:
            self.fail(FileChanged(f"the file ends at {start}, before its size of {self.size}"))
        elif request.size == self.chunk:
            # A server that never sends more than this (servers.md 7) should not be asked for more.
            self._shorts[count] = self._shorts.get(count, 0) + 1
            if self._shorts[count] >= _SHORTS_TO_LEARN:
                self.limit_chunk(count)

    def _on_nak(self, request: Request, nak: FtpNak) -> None:
        self._demand.add(request.offset, request.offset + request.size)
        error = self._meaning(request, nak)
        if error is not nak or self._errors >= _ERRORS_TOLERATED:
            self.fail(error)
        else:
            self._errors += 1

    def _meaning(self, request: Request, nak: FtpNak) -> MavftpfsError:
        """Return what a refused ReadFile within the size means (servers.md 1, 7, 12)."""
        if nak.code == NakCode.EOF:
            if self.port.traits.ack_carries_own_session:
                return FileChanged(f"the file ends at or before {request.offset}, not at {self.size}")
            # MAVSDK says EOF when another client has closed the file; a reopen tells which it is.
            return SessionLost(f"end of file at {request.offset}, before {self.size}", by_server=True)
        if nak.code in _SESSION_CODES or nak.code in _DOUBTFUL_CODES or nak.server_errno == _EBADF:
            return SessionLost(str(nak), by_server=True)
        return nak

    def take_back(self, request: Request) -> None:
        """See Chunked."""
        del self._unanswered[request]
        self._demand.add(request.offset, request.offset + request.size)

    def fail(self, error: MavftpfsError) -> None:
        """End; what was on its way is wanted again."""
        for request in self._unanswered:
            self._demand.add(request.offset, request.offset + request.size)
        self._unanswered.clear()
        self._burst = None
        super().fail(error)

    # --- bursts

    def on_burst_sent(self, request: Request, now: float) -> int:
        """Begin to follow the burst; return how many packets it may bring (MAVSDK: all the rest)."""
        rto = self.port.timeout("data")
        self._burst = Burst(request.seq, request.offset, self.size, self.chunk, now, rto)
        echoes = self.port.traits.ack_carries_own_session
        self._keep_alive_at = now + KEEP_ALIVE if echoes is False else inf
        self._arm(now)
        return (self.size - request.offset) // request.size + 2

    def on_burst(self, reply: Payload, now: float) -> bool:
        """Place a packet of the running burst."""
        burst = self._burst
        if burst is None:
            return False
        data = burst.take(reply, now)
        if data is None:
            return False
        if data:
            self._forget_want(reply.offset, reply.offset + len(data))
            self.received_bytes += len(data)
            self._sink.on_data(reply.offset, data)
        if burst.endless:
            self.fail(SessionLost("the vehicle repeats itself in a burst", by_server=True))
        elif burst.over:
            self._end_burst(burst, now)
        elif burst.complete_seen or burst.packets == 1:  # from here on it is over sooner
            self._arm(now)
        return True

    def on_timer(self, now: float) -> None:
        """End a burst that went quiet."""
        if self._burst is not None and now >= self._burst.quiet_deadline():
            self._end_burst(self._burst, now)
        else:
            self._arm(now)

    def _arm(self, now: float) -> None:
        """Set the timer; packets that come meanwhile only move the deadline, which on_timer looks up.

        A keep-alive that is overdue waits for room in the window, not for the timer.
        """
        burst = self._burst
        self.timer = inf if burst is None else burst.quiet_deadline()
        if now < self._keep_alive_at < self.timer:
            self.timer = self._keep_alive_at

    def _end_burst(self, burst: Burst, now: float) -> None:
        self._burst = None
        self._keep_alive_at = self.timer = inf
        self._gaps = ExtentSet(self.wants.intersection(0, burst.highest))
        self._filling = True
        if burst.packets:
            self._barren_bursts = 0
            self._burst_bytes += burst.received
            self._burst_seconds += max(now - burst.sent_at, 1e-6)
            if burst.packet:
                self.port.traits.burst_size_honoured = burst.packet == burst.asked
        else:
            self._on_barren(burst)

    def _on_barren(self, burst: Burst) -> None:
        """A burst without data: lost, refused, or the session is gone. ReadFile answers more clearly."""
        self._barren_bursts += 1
        if burst.nak in _SESSION_CODES:
            self.fail(SessionLost(f"a burst was refused with NAK {burst.nak}", by_server=True))
        elif burst.nak is not None or self._barren_bursts >= _BARREN_BURSTS:
            self.strategy = "window"
