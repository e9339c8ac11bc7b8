"""Files through a session, without caches: what comes of a read, what an upload sends."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.cache.remote import Reader
from mavftpfs.session.connection import Connection
from mavftpfs.session.upload import Upload
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.sending import SendBuffer
from mavftpfs.sim.profiles import PROFILES

ROOTS = {"px4-nuttx": b"/fs/microsd"}
"""Where a profile's files may be written; the root elsewhere."""


def content(size: int, seed: int = 0) -> bytes:
    """Return random bytes; those of a smaller size are the head of those of a larger one."""
    return random.Random(seed).randbytes(size + -size % 4)[:size]


def path(profile: str, name: str) -> bytes:
    """Return the path on the vehicle of a name in /d."""
    return ROOTS.get(profile, b"") + b"/d/" + name.encode()


class MemorySink:
    """A ReadSink that keeps what came first, and can be waited for."""

    def __init__(self, size: int) -> None:
        self.data = bytearray(size)
        self.have = ExtentSet()
        self.repeats = 0
        self.errors: list[Exception] = []
        self._news = trio.Event()

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        return self.have.missing(start, stop)

    def on_opened(self, at: float) -> None:
        """Nobody asks."""

    def on_data(self, offset: int, data: bytes) -> None:
        assert offset + len(data) <= len(self.data), "data beyond the size of the file"
        gaps = self.have.missing(offset, offset + len(data))
        self.repeats += gaps != [(offset, offset + len(data))]
        for start, stop in gaps:
            self.data[start:stop] = data[start - offset : stop - offset]
        self.have.add(offset, offset + len(data))

    def on_batch(self, count: int) -> None:
        self._tell()

    def on_queued(self) -> None:
        """Nobody asks."""

    def on_failed(self, error: Exception) -> None:
        self.errors.append(error)
        self._tell()

    async def wait_for(self, start: int, stop: int) -> bytes:
        """Wait until a range is there, or raise the error that came instead."""
        while not self.have.covers(start, stop):
            if self.errors:
                raise self.errors.pop(0)
            await self._news.wait()
        return bytes(self.data[start:stop])

    def _tell(self) -> None:
        self._news.set()
        self._news = trio.Event()


async def read_file(connection: Connection, path: bytes) -> bytes:
    """Open, read whole, close."""
    reader, sink = await begin_to_read(connection, path, 0)
    try:
        return await sink.wait_for(0, reader.size)
    finally:
        reader.close()


async def begin_to_read(connection: Connection, target: bytes, count: int) -> tuple[Reader, MemorySink]:
    """Want a file whole; return its reader and what comes, once so many bytes did."""
    sink = MemorySink(1 << 22)
    reader = await connection.store.open_reader(target, sink)
    reader.want(0, reader.size, demand=True)
    await sink.wait_for(0, count)
    return reader, sink


class MemorySource(SendBuffer):
    """Content that may grow (`add`)."""

    def __init__(self, content: bytes = b"") -> None:
        self.content = bytearray(content)
        super().__init__(self.read, len(content))
        self.checkpoints = 0
        self.rollbacks = self.beginnings = 0

    def read(self, start: int, stop: int) -> bytes:
        return bytes(self.content[start:stop])

    def add(self, data: bytes) -> None:
        """Append; the upload has to be woken."""
        self.content += data
        self.on_changed(self.size, len(self.content))

    @property
    def all_proven(self) -> bool:
        return self.proven.covers(0, len(self.content))

    @property
    def todo(self) -> ExtentSet:
        return self.ranges.todo

    @property
    def in_flight(self) -> ExtentSet:
        return self.ranges.out

    def on_acked(self, start: int, stop: int) -> None:
        assert 0 <= start < stop <= self.handed_out, "an ACK of what was never sent"
        super().on_acked(start, stop)
        self._require_order()

    def check_point(self) -> None:
        assert self.in_flight.empty, "a checkpoint with bytes in flight"
        self.checkpoints += 1
        super().check_point()

    def roll_back(self) -> None:
        assert self.in_flight.empty, "a rollback with bytes in flight"
        self.rollbacks += not self.acked.empty
        super().roll_back()

    def start_over(self) -> None:
        assert self.in_flight.empty, "begun anew with bytes in flight"
        self.beginnings += 1
        super().start_over()

    def _require_order(self) -> None:
        """Each byte is in one state only."""
        states = (self.ranges.todo, self.ranges.out, self.acked, self.proven)
        whole = ExtentSet([each for state in states for each in state])
        assert sum(state.total for state in states) == whole.total == self.size


def know(connection: Connection, profile: str) -> None:
    """Have it known what OpenFileWO does, as after the first upload that was interrupted."""
    connection.store.traits.wo_truncates = PROFILES[profile].write_only_truncates


async def start(connection: Connection, profile: str, source: MemorySource, name: str = "new") -> Upload:
    return connection.store.open_upload(path(profile, name), source)


async def put(connection: Connection, target: bytes, data: bytes) -> None:
    """Upload a whole file."""
    source = MemorySource(data)
    await connection.store.wait_out(target)
    upload = connection.store.open_upload(target, source)
    await upload.finish()
    assert source.all_proven
    await upload.end()


@asynccontextmanager
async def under_way(
    connection: Connection, profile: str, data: bytes, *, seconds: float = 1.5
) -> AsyncIterator[MemorySource]:
    """Upload `new`, and give its source after so long; leaving waits for the end, without an error."""
    source = MemorySource(data)
    upload = await start(connection, profile, source)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(upload.finish)
        await trio.sleep(seconds)
        yield source
