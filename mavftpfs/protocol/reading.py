"""Reading an open file by a window of ReadFile requests. Layer: protocol; pure.

ReadTransfer reads wanted ranges of a file whose size is known. ReadToEof reads an `@` file, whose size is a
lie, from its beginning until the server says that it ends."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import NO_FILE_CODES, READ_POLICY, Operation, Request, Run, nak_of
from mavftpfs.shared.errors import (
    DataUnproven,
    LocalProtocolError,
    SessionLost,
)
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.ranges import Ranges

_LOST_CODES = NO_FILE_CODES | {NakCode.FILE_EXISTS, NakCode.EOF}
"""Refusals of a read within the file's size that may mean "no file is open". MAVSDK says EOF when another
client closed the file; PX4 says 8 for everything after one "file exists" (servers.md 1, 12). Reopening
tells."""

_READ = int(Opcode.READ_FILE)
_NAK = int(Opcode.NAK)
_EBADF = 9
_BLOCKS_AHEAD = 3


class DataSink(Protocol):
    """Receives the bytes."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the missing parts of [start, stop)."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take bytes, which may be more than was wanted. Bytes that are already here must not be
        overwritten."""
        ...


class Wants:
    """The pending ranges of a file: those asked for that did not arrive. They outlive each transfer.

    Attributes:
        demand: ranges that programs wait for, requested first. ahead: readahead; no byte is in both.
    """

    def __init__(self) -> None:
        self.demand, self.ahead = Ranges(), Ranges()

    @property
    def idle(self) -> bool:
        """Whether no range is pending."""
        return self.demand.empty and self.ahead.empty

    @property
    def in_flight(self) -> bool:
        """Whether requests are in flight."""
        return not (self.demand.out.empty and self.ahead.out.empty)

    def add(self, ranges: Iterable[tuple[int, int]], *, demand: bool) -> None:
        """Add pending ranges. demand: a program waits for them, also for parts that are readahead so far."""
        demanded, ahead = self.demand, self.ahead
        for start, stop in ranges:
            if demand:
                for part in ahead.out.intersection(start, stop):
                    demanded.out.add(*part)
                ahead.on_done(start, stop)
                for part in demanded.out.missing(start, stop):
                    demanded.todo.add(*part)
                continue
            new = ExtentSet([(start, stop)])
            for present in (demanded.todo, demanded.out, ahead.out):
                for part in present.intersection(start, stop):
                    new.discard(*part)
            for part in new:
                ahead.todo.add(*part)

    def take(self, limit: int, below: int) -> tuple[int, int] | None:
        """Return the first pending range below an offset without a request, at most `limit` bytes, for which
        a request goes out now."""
        for wanted in (self.demand, self.ahead):
            first = wanted.todo.first()
            if first is not None and first[0] < below:
                row = first[0], min(first[1], first[0] + limit, below)
                wanted.take(*row)
                return row
        return None

    def on_done(self, start: int, stop: int) -> None:
        """Note that these bytes arrived."""
        self.demand.on_done(start, stop)
        self.ahead.on_done(start, stop)

    def on_lost(self, start: int, stop: int) -> None:
        """Note that a request for these bytes is lost."""
        self.demand.on_lost(start, stop)
        self.ahead.on_lost(start, stop)

    def give_back(self) -> None:
        """Lose all requests, because nobody accepts their replies."""
        self.demand.give_back()
        self.ahead.give_back()

    def drop(self, *, demand: bool = True) -> None:
        """Drop the ranges without a request; demand: False: only readahead. Bytes in flight still arrive, but
        no program waits for them."""
        self.ahead.todo = ExtentSet()
        if demand:
            self.demand.todo = ExtentSet()
            for part in self.demand.out:
                self.ahead.out.add(*part)
            self.demand.out = ExtentSet()


class ReadTransfer(Operation):
    """Reads wanted ranges of an open regular file for as long as its owner likes.

    Args:
        session: id of the open file. size: as the first open ACK said (the file may be larger now); nothing
            beyond is ever asked for.
        sink: takes the data. chunks: the size of requests. wants: what is wanted already.

    Attributes:
        received_bytes: delivered to the sink since the owner last set this to 0.

    Fails with SessionLost (reopen, and start another with `wants`; the file may have become shorter, too),
    FtpNak, or RequestTimeout. At the end, `finish` included, all bytes that did not arrive are in `wants`.
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

    # --- what the owner says and sees

    def want(self, start: int, stop: int, demand: bool) -> None:
        """Ask for the bytes of [start, stop), clamped to the size, that the sink lacks and that are not in
        flight."""
        self.wants.add(self._sink.missing(start, min(stop, self.size)), demand=demand)

    @property
    def idle(self) -> bool:
        """Whether no range is pending."""
        return self.wants.idle

    @property
    def demanded(self) -> bool:
        """Whether a program waits for some of it."""
        return not self.wants.demand.empty

    # --- requests

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return ReadFile requests for a row of chunks; demand goes first."""
        return self._requests_below(self.size, most, now)

    def _requests_below(self, below: int, most: int, now: float) -> list[Request]:
        """Return such requests for what is wanted below an offset."""
        chunk = self.chunks.next_size(now)
        row = self.wants.take(chunk if self.chunks.trying else most * chunk, below)
        if row is None:
            return []
        session, (start, stop) = self.session, row
        return [
            Request(self, _READ, READ_POLICY, session, offset, min(chunk, stop - offset))
            for offset in range(start, stop, chunk)
        ]

    def on_lost(self, request: Request, now: float) -> None:
        """Request its bytes again, unless they arrived."""
        self.chunks.on_lost(request.size, request.sent_at, now)
        self.wants.on_lost(request.offset, request.stop)

    # --- replies to ReadFile

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Place a chunk, or interpret a refusal."""
        if reply.opcode != _NAK:
            self.on_run([(request, reply.data)], now)
            return
        nak = nak_of(request, reply)
        if nak.code in _LOST_CODES or nak.server_errno == _EBADF:
            # If each client has a session id of its own, an EOF is the end of this file, which shrank.
            at_end = nak.code == NakCode.EOF and self.port.traits.ack_carries_own_session
            self.fail(SessionLost(str(nak), by_server=not at_end))
        else:
            self.fail(nak)

    def on_run(self, run: Run, now: float) -> None:
        """Place chunks, those in a row together."""
        first = run[0][0]
        self.chunks.on_answered(first.size, len(run), first.sent_at, now)
        pieces: list[bytes] = []
        start = stop = first.offset
        for request, data in run:
            offset, size = request.offset, request.size
            if offset != stop:
                self._place(start, pieces, now)
                pieces, start = [], offset
            if len(data) > size:
                data = data[:size]
            pieces.append(data)
            stop = offset + len(data)
            if len(data) < size:
                self.wants.on_lost(stop, request.stop)
            if not data:
                self.fail(SessionLost(f"the file has no bytes at {offset}, before its size of {self.size}"))
                break
        self._place(start, pieces, now)

    def _place(self, offset: int, pieces: list[bytes], now: float) -> None:
        data = pieces[0] if len(pieces) == 1 else b"".join(pieces)
        if data:
            self.progress(now)
            self.received_bytes += len(data)
            self.wants.on_done(offset, offset + len(data))
            self._sink.on_data(offset, data)

    def finish(self) -> None:
        """End; ranges in flight lose their requests and stay pending."""
        if not self.done:
            self.wants.give_back()
        super().finish()


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
        self._out: set[int] = set()  # blocks that requests are out for
        self._end: int | None = None  # lowest index known to hold nothing
        self._last: int | None = None  # index of a short block

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the request for the next block; at most a few ahead of what is known to exist."""
        for index in range(self._whole, self._whole + _BLOCKS_AHEAD + 1):
            if index not in self._blocks and index not in self._out and self._plausible(index):
                self._out.add(index)
                offset = index * self._chunk
                return [Request(self, _READ, READ_POLICY, self._session, offset, self._chunk)]
        return []

    def on_lost(self, request: Request, now: float) -> None:
        """Request the block again."""
        self._out.discard(request.offset // self._chunk)

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Keep a block, or note the end of the file."""
        index = request.offset // self._chunk
        self._out.discard(index)
        self.progress(now)
        if reply.opcode == _NAK:
            nak = nak_of(request, reply)
            ended = nak.code == NakCode.FILE_EXISTS and self._ends_short(index)
            if nak.code == NakCode.EOF or ended:
                self._on_end(index)
            elif nak.code in NO_FILE_CODES:
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
