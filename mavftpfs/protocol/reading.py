"""Reading an open file by a window of ReadFile requests. Layer: protocol; pure.

ReadTransfer reads wanted ranges of a file whose size is known. ReadToEof reads an `@` file, whose size is a
lie, from its beginning until the server says that it ends."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import READ_MANNER, Operation, Request, Run, nak_of
from mavftpfs.shared.errors import (
    DataUnproven,
    LocalProtocolError,
    MavftpfsError,
    SessionLost,
)
from mavftpfs.shared.extents import ExtentSet

SESSION_CODES = frozenset((NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND))
"""Refusals that mean "no file is open" (servers.md 1)."""

_LOST_CODES = SESSION_CODES | {NakCode.FAIL, NakCode.FILE_EXISTS, NakCode.EOF}
"""Refusals of a read within the file's size that may mean it, too. MAVSDK says 1, or EOF when another client
closed the file; PX4 says 8 for everything after one "file exists" (servers.md 1, 12). Reopening tells."""

_READ = int(Opcode.READ_FILE)
_NAK = int(Opcode.NAK)
_EBADF = 9
_BLOCKS_AHEAD = 3


class DataSink(Protocol):
    """Where the bytes go."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) that are not here yet."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take bytes, which may be more than was wanted. Bytes that are already here must not be
        overwritten."""
        ...


class Wants:
    """What is wanted of a file and has not come, but for what ReadFile requests are out for. It outlives the
    transfers that take from it.

    Attributes:
        demand: what programs wait for; it goes first. ahead: readahead, none of it in demand.
    """

    def __init__(self) -> None:
        self.demand, self.ahead = ExtentSet(), ExtentSet()

    @property
    def empty(self) -> bool:
        """Whether nothing is wanted."""
        return self.demand.empty and self.ahead.empty

    def add(self, ranges: Iterable[tuple[int, int]], *, demand: bool) -> None:
        """Want these ranges, too."""
        for start, stop in ranges:
            if demand:
                self.demand.add(start, stop)
                self.ahead.discard(start, stop)
            else:
                for gap_start, gap_stop in self.demand.missing(start, stop):
                    self.ahead.add(gap_start, gap_stop)

    def discard(self, start: int, stop: int) -> None:
        """Want [start, stop) no more."""
        self.demand.discard(start, stop)
        self.ahead.discard(start, stop)

    def clear(self, *, demand: bool = True) -> None:
        """Want nothing more; demand: False: no readahead."""
        if demand:
            self.demand = ExtentSet()
        self.ahead = ExtentSet()

    def take(self, limit: int, below: int) -> tuple[int, int, bool] | None:
        """Remove and return the first of it below an offset, at most `limit` bytes, and whether it is
        demand."""
        for wanted, demand in ((self.demand, True), (self.ahead, False)):
            for first, end in wanted.intersection(0, below):
                end = min(end, first + limit)
                wanted.discard(first, end)
                return first, end, demand
        return None


class ReadTransfer(Operation):
    """Reads wanted ranges of an open regular file for as long as its owner likes.

    Args:
        session: id of the open file. size: as the first open ACK said (the file may be larger now); nothing
            beyond is ever asked for.
        sink: takes the data. chunks: the size of requests. wants: what is wanted already.

    Attributes:
        received_bytes: delivered to the sink so far.

    Fails with SessionLost (reopen, and start another with `wants`; the file may have become shorter, too),
    FtpNak, or RequestTimeout. Then, and after `give_back`, all that did not come is in `wants`.
    """

    urgent = False
    bulk = _READ

    def __init__(
        self,
        session: int,
        size: int,
        sink: DataSink,
        chunks: ChunkSize | None = None,
        wants: Wants | None = None,
    ) -> None:
        self.chunks = ChunkSize() if chunks is None else chunks
        self.session = session
        self.size = size
        self.received_bytes = 0
        self.wants = Wants() if wants is None else wants
        self._sink = sink
        self._unanswered: dict[Request, bool] = {}  # whether a program waits for it

    # --- what the owner says and sees

    def want(self, start: int, stop: int, demand: bool) -> None:
        """Ask for what the sink lacks of [start, stop), clamped to the size, if it is not on its way."""
        lacking = ExtentSet(self._sink.missing(start, min(stop, self.size)))
        for request in self._unanswered:
            lacking.discard(request.offset, request.offset + request.size)
            if request.offset < stop and start < request.offset + request.size:
                self._unanswered[request] |= demand
        self.wants.add(lacking, demand=demand)

    def drop(self, *, demand: bool = True) -> None:
        """Want nothing more; demand: False: no readahead. What is on its way still arrives."""
        self.wants.clear(demand=demand)
        if demand:
            self._unanswered = dict.fromkeys(self._unanswered, False)

    def give_back(self) -> None:
        """Want again all that was asked for and did not come. Answers that still come are not taken."""
        for request in list(self._unanswered):
            self._want_again(request)

    def _want_again(self, request: Request, got: int = 0) -> None:
        rest = (request.offset + got, request.offset + request.size)
        self.wants.add([rest], demand=self._unanswered.pop(request))

    @property
    def in_flight(self) -> int:
        """How many ReadFile requests are on their way, or lost and to be repeated."""
        return len(self._unanswered)

    @property
    def idle(self) -> bool:
        """Whether nothing is wanted or on its way."""
        return not self._unanswered and self.wants.empty

    @property
    def demanded(self) -> bool:
        """Whether a program waits for some of it."""
        return not self.wants.demand.empty or any(self._unanswered.values())

    # --- requests

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return ReadFile requests for a row of chunks; demand goes first."""
        chunk = self.chunks.next_size(now)
        limit = chunk if self.chunks.trying else most * chunk
        return self._requests_for(self.wants.take(limit, self.size), chunk)

    def _requests_for(self, row: tuple[int, int, bool] | None, chunk: int) -> list[Request]:
        if row is None:
            return []
        session, requests = self.session, []
        start, stop, demand = row
        for offset in range(start, stop, chunk):
            request = Request(self, _READ, READ_MANNER, session, offset, min(chunk, stop - offset))
            requests.append(request)
            self._unanswered[request] = demand
        return requests

    # --- replies to ReadFile

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Place a chunk, or find out what a refusal means."""
        if reply.opcode != _NAK:
            self.on_run([(request, reply.data)], now)
            return
        nak = nak_of(request, reply)
        if nak.code in _LOST_CODES or nak.server_errno == _EBADF:
            # Where each client has a session id of its own, an EOF is that of our file.
            at_end = nak.code == NakCode.EOF and self.port.traits.ack_carries_own_session
            self.fail(SessionLost(str(nak), by_server=not at_end))
        else:
            self.fail(nak)

    def on_run(self, run: Run, now: float) -> None:
        """Place chunks, those in a row together."""
        unanswered, first = self._unanswered, run[0][0]
        self.chunks.on_answered(first.size, len(run) if first.sends == 1 else 0, first.sent_at, now)
        pieces: list[bytes] = []
        start = stop = first.offset
        for request, data in run:
            offset, size = request.offset, request.size
            if offset != stop:
                self._place(start, pieces)
                pieces, start = [], offset
            if len(data) < size:
                self._on_short(request, len(data))
            else:
                del unanswered[request]
                if len(data) > size:
                    data = data[:size]
            pieces.append(data)
            stop = offset + len(data)
            if self.done:
                break
        self._place(start, pieces)

    def _place(self, offset: int, pieces: list[bytes]) -> None:
        data = pieces[0] if len(pieces) == 1 else b"".join(pieces)
        if data:
            self.received_bytes += len(data)
            self._sink.on_data(offset, data)

    def _on_short(self, request: Request, count: int) -> None:
        self._want_again(request, count)
        if count == 0:
            end, size = request.offset, self.size
            self.fail(SessionLost(f"the file has no bytes at {end}, before its size of {size}"))

    def takes_back(self, request: Request, now: float) -> bool:
        """See Operation: the bytes of a chunk that was too long are asked for in shorter ones."""
        if not self.chunks.on_lost(request.size, request.sent_at, now):
            return False
        self._want_again(request)
        return True

    def fail(self, error: MavftpfsError) -> None:
        """End; what was on its way is wanted again."""
        self.give_back()
        super().fail(error)


class ReadToEof(Operation):
    """Reads an `@` file from 0 to its end by one constant block size, never clamped (servers.md 14.13).

    The end is NAK EOF (or an ACK of size 0) on the block behind the last; only the last block may be short.

    Attributes:
        data: the whole content, once done without error.
        shorter: bytes of a short block that is not the last one, because there is more behind it: the server
            sends no longer ones. The file is to be read anew in such blocks.

    Fails with DataUnproven (longer than `limit`, or a short block in the middle), SessionLost, FtpNak.
    """

    urgent = False
    shorter: int | None = None

    def __init__(self, session: int, chunk: int, limit: int) -> None:
        if not 1 <= chunk <= MAX_DATA:
            raise LocalProtocolError(f"a chunk of {chunk} bytes is not within 1..{MAX_DATA}")
        self.data = b""
        self._session = session
        self._chunk = chunk
        self._limit = limit
        self._blocks: dict[int, bytes] = {}
        self._whole = 0  # blocks 0.._whole-1 are there
        self._next = 0
        self._end: int | None = None  # lowest index known to hold nothing
        self._last: int | None = None  # index of a short block

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the request for the next block; at most a few ahead of what is known to exist."""
        if self._next > self._whole + _BLOCKS_AHEAD or not self._plausible(self._next):
            return []
        offset = self._next * self._chunk
        self._next += 1
        return [Request(self, _READ, READ_MANNER, self._session, offset, self._chunk)]

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Keep a block, or learn where the end is."""
        index = request.offset // self._chunk
        if reply.opcode == _NAK:
            nak = nak_of(request, reply)
            ended = nak.code == NakCode.FILE_EXISTS and self._ends_short(index)
            if nak.code == NakCode.EOF or ended:
                self._on_end(index)
            elif nak.code in (NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND, NakCode.FAIL):
                self.fail(SessionLost(str(nak), by_server=True))
            else:
                self.fail(nak)
        elif not reply.data:
            self._on_end(index)
        else:
            self._on_block(index, reply.data[: self._chunk])

    def _plausible(self, index: int) -> bool:
        """Whether a block may still be found there, or its absence is still to be proven."""
        if self._end is not None and index >= self._end:
            return False
        return self._last is None or index <= self._last + 1

    def _ends_short(self, index: int) -> bool:
        # PX4 may say 8 for EOF (sticky EEXIST): believed only behind a short block.
        return 0 < len(self._blocks.get(index - 1, b"")) < self._chunk

    def _on_block(self, index: int, block: bytes) -> None:
        self._blocks[index] = block
        if index * self._chunk + len(block) > self._limit:
            self.fail(DataUnproven(f"longer than the limit of {self._limit} bytes"))
            return
        if len(block) < self._chunk and (self._last is None or index < self._last):
            self._last = index
        while self._whole in self._blocks:
            self._whole += 1
        self._maybe_finish()

    def _on_end(self, index: int) -> None:
        if self._end is None or index < self._end:
            self._end = index
        self._maybe_finish()

    def _maybe_finish(self) -> None:
        end, last = self._end, self._last
        newest = max(self._blocks, default=-1)
        if last is not None and newest > last:
            self.shorter = len(self._blocks[last])
        if self.shorter is not None or (end is not None and newest >= end):
            self.fail(DataUnproven("blocks of different lengths of the file do not fit together"))
        elif end is not None and self._whole == end:
            self.data = b"".join(self._blocks[index] for index in range(end))
            self.finish()
