"""Reading an open file, by a window of ReadFile requests or by bursts. Layer: protocol; pure."""

from __future__ import annotations

from math import inf
from typing import Literal, Protocol

from mavftpfs.protocol.burst import Burst
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import READ_MANNER, Operation, Priority, Request, manner_of, nak_of
from mavftpfs.protocol.toeof import ReadToEof
from mavftpfs.shared.errors import FileChanged, FtpNak, LocalProtocolError, MavftpfsError, SessionLost
from mavftpfs.shared.extents import ExtentSet

__all__ = ["DataSink", "ReadToEof", "ReadTransfer", "Strategy"]

Strategy = Literal["window", "burst"]

_READ = int(Opcode.READ_FILE)
_LOST_CODES = frozenset((NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND, NakCode.FAIL, NakCode.FILE_EXISTS))
_EBADF = 9
_MAX_ERRORS = 1
_MAX_BARREN_BURSTS = 2


class DataSink(Protocol):
    """Where the bytes go."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) not yet held."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take bytes; what is already held must not be overwritten."""
        ...


class ReadTransfer(Operation):
    """Reads wanted ranges of an open regular file for as long as its owner likes.

    Args:
        session: id of the open file. size: as the open ACK said; nothing beyond is ever asked for.
        sink: takes the data. chunk: bytes to ask for at once, 1..239.
        strategy: how to begin; `set_strategy` changes it at the next safe point.

    Attributes:
        received_bytes: delivered to the sink so far. window_bytes, burst_bytes: by strategy.
        window_seconds, burst_seconds: time during which each had work to do.

    Fails with SessionLost (reopen and start another with `wants`), FileChanged (the file ends before its
    size), FtpNak, or RequestTimeout.
    """

    def __init__(
        self, session: int, size: int, sink: DataSink, chunk: int = MAX_DATA, strategy: Strategy = "window"
    ) -> None:
        super().__init__()
        if not 1 <= chunk <= MAX_DATA:
            raise LocalProtocolError(f"a chunk of {chunk} bytes is not within 1..{MAX_DATA}")
        self.session = session
        self.size = size
        self.chunk = chunk
        self.received_bytes = 0
        self.window_bytes = 0
        self.burst_bytes = 0
        self.window_seconds = 0.0
        self.burst_seconds = 0.0
        self._sink = sink
        self._strategy: Strategy = strategy
        self._demand = ExtentSet()
        self._ahead = ExtentSet()
        self._gaps = ExtentSet()
        self._flying: dict[Request, None] = {}
        self._burst: Burst | None = None
        self._barren_bursts = 0
        self._errors = 0
        self._window_since: float | None = None

    # --- what the owner says and sees

    def want(self, start: int, stop: int, demand: bool) -> None:
        """Ask for what the sink lacks of [start, stop), clamped to the size, if it is not on its way."""
        flying = ExtentSet((request.offset, request.offset + request.size) for request in self._flying)
        for gap_start, gap_stop in self._sink.missing(start, min(stop, self.size)):
            for piece_start, piece_stop in flying.missing(gap_start, gap_stop):
                if demand:
                    self._demand.add(piece_start, piece_stop)
                    self._ahead.discard(piece_start, piece_stop)
                else:
                    for begin, end in self._demand.missing(piece_start, piece_stop):
                        self._ahead.add(begin, end)

    def drop_readahead(self) -> None:
        """Forget wants that nobody waits for; what is on its way still arrives."""
        self._ahead.clear()

    def set_strategy(self, strategy: Strategy) -> None:
        """Go on by this strategy from the next safe point (no burst running)."""
        self._strategy = strategy

    @property
    def strategy(self) -> Strategy:
        """The strategy wished for."""
        return self._strategy

    @property
    def bursting(self) -> bool:
        """Whether a burst is running (on ArduPilot nothing else is answered until it ends)."""
        return self._burst is not None

    @property
    def wants(self) -> ExtentSet:
        """What is wanted and has not come, requests on their way included."""
        wants = self._demand.copy()
        for start, stop in self._ahead:
            wants.add(start, stop)
        for request in self._flying:
            wants.add(request.offset, request.offset + request.size)
        return wants

    @property
    def idle(self) -> bool:
        """Whether nothing is wanted, on its way or streaming."""
        return not self._flying and self._burst is None and self._demand.empty and self._ahead.empty

    @property
    def priority(self) -> Priority:
        """DEMAND while somebody waits."""
        return Priority.READAHEAD if self._demand.empty else Priority.DEMAND

    @property
    def window_rate(self) -> float | None:
        """Measured bytes per second of windowed reading, None before a quarter of a second of it."""
        return self.window_bytes / self.window_seconds if self.window_seconds >= 0.25 else None

    @property
    def burst_rate(self) -> float | None:
        """Measured bytes per second of bursts, None before the first one ended."""
        return self.burst_bytes / self.burst_seconds if self.burst_seconds > 0 else None

    # --- requests

    def next_request(self, now: float) -> Request | None:
        """Return the next ReadFile, or the BurstReadFile that is due."""
        if self._burst is not None:
            return None
        if self._strategy == "burst" and self._gaps.empty:
            return self._next_burst(now)
        return self._next_read(now)

    def _next_read(self, now: float) -> Request | None:
        piece = self._demand.take_first(self.chunk) or self._ahead.take_first(self.chunk)
        if piece is None:
            return None
        if self._window_since is None:
            self._window_since = now
        start, stop = piece
        if not self._gaps.empty:
            self._gaps.discard(0, stop)
        return self._ask(start, stop)

    def _ask(self, start: int, stop: int) -> Request:
        request = Request(self, _READ, READ_MANNER, self.session, start, stop - start)
        self._flying[request] = None
        return request

    def _next_burst(self, now: float) -> Request | None:
        # ReadFile during a burst moves MAVSDK's shared stream position: never both at once.
        first = self._demand.first() or self._ahead.first()
        if self._flying or first is None:
            return None
        opcode = Opcode.BURST_READ_FILE
        return Request(self, opcode, manner_of(opcode), self.session, first[0], self.chunk)

    # --- replies to ReadFile

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Place a chunk, or find out what a refusal means."""
        del self._flying[request]
        if not self._flying and self._window_since is not None:
            self.window_seconds += now - self._window_since
            self._window_since = None
        if reply.opcode == Opcode.NAK:
            self._on_nak(request, nak_of(request, reply))
            return
        data = reply.data
        count = len(data)
        if count < request.size:
            self._on_short(request, count)
        elif count > request.size:
            data = data[: request.size]
            count = request.size
        if count:
            self.received_bytes += count
            self.window_bytes += count
            self._sink.on_data(request.offset, data)

    def _on_short(self, request: Request, count: int) -> None:
        start, stop = request.offset + count, request.offset + request.size
        self._demand.add(start, stop)
        if count == 0:
            self.fail(FileChanged(f"the file ends at {start}, before its size of {self.size}"))

    def _on_nak(self, request: Request, nak: FtpNak) -> None:
        start, stop = request.offset, request.offset + request.size
        self._demand.add(start, stop)
        if nak.code == NakCode.EOF:
            self.fail(FileChanged(f"the file ends at or before {start}, before its size of {self.size}"))
        elif nak.code in _LOST_CODES or nak.server_errno == _EBADF:
            self.fail(SessionLost(str(nak), by_server=True))
        elif self._errors < _MAX_ERRORS:
            self._errors += 1
        else:
            self.fail(nak)

    def fail(self, error: MavftpfsError) -> None:
        """End; what was on its way is wanted again."""
        for request in self._flying:
            self._demand.add(request.offset, request.offset + request.size)
        self._flying.clear()
        self._burst = None
        super().fail(error)

    # --- bursts

    def on_burst_sent(self, request: Request, now: float) -> None:
        """Begin to follow the burst."""
        rto = self.port.round_trip("data")
        self._burst = Burst(request.seq, request.offset, self.size, self.chunk, now, rto)
        self.timer = self._burst.quiet_deadline()

    def on_burst(self, reply: Payload, now: float) -> bool:
        """Place a packet of the running burst."""
        burst = self._burst
        if burst is None:
            return False
        data = burst.take(reply, now)
        if data is None:
            return False
        if data:
            count = len(data)
            self._demand.discard(reply.offset, reply.offset + count)
            self._ahead.discard(reply.offset, reply.offset + count)
            self.received_bytes += count
            self._sink.on_data(reply.offset, data)
        if burst.endless:
            self.fail(SessionLost("the server repeats itself in a burst", by_server=True))
        elif burst.over:
            self._end_burst(now)
        return True

    def on_timer(self, now: float) -> None:
        """End a burst that went quiet."""
        self.timer = inf
        burst = self._burst
        if burst is not None:
            deadline = burst.quiet_deadline()
            if now >= deadline:
                self._end_burst(now)
            else:
                self.timer = deadline

    def _end_burst(self, now: float) -> None:
        burst = self._burst
        assert burst is not None
        self._burst = None
        self.timer = inf
        if burst.packets:
            self._barren_bursts = 0
            self.burst_bytes += burst.received
            self.burst_seconds += max(now - burst.sent_at, 1e-6)
            if burst.packet:
                self.port.traits.burst_size_honoured = burst.packet == burst.asked
        else:
            self._barren_bursts += 1
        self._gaps = ExtentSet(self.wants.intersection(0, burst.highest))
        if self._barren_bursts >= _MAX_BARREN_BURSTS or (burst.nak is not None and not burst.packets):
            self._strategy = "window"
