"""A vehicle's files in memory: implements cache.remote.RemoteStore for tests of the cache layer.

Delays are in seconds of the trio clock (use an autojump MockClock). What a real server would not forgive
(listing a file, opening a directory) is written down in `crimes`; every request in `calls`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import ReadSink, VehicleStore
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.shared.errors import Armed, DataUnproven, FileChanged, FtpNak, VehicleLost
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, Listing, join, split, wire_path


def make_tree(store: FakeStore, *, nursery: trio.Nursery | None = None, **options: Any) -> Tree:
    """Return the cache facade over a store; what it tells the kernel to drop goes to `store.invalidated`."""
    return Tree(
        cast(VehicleStore, store),
        CacheOptions(read_only=True, **options),
        clock=trio.current_time,
        invalidate=store.invalidated.append,
        nursery=nursery,
    )


async def read_file(tree: Tree, path: bytes, step: int = 128 * 1024) -> bytes:
    """Open, read to the end and close, as cat does."""
    handle = await tree.open(path)
    try:
        parts = [bytes(await handle.read(at, step)) for at in range(0, handle.size + 1, step)]
    finally:
        handle.close()
    return b"".join(parts)


@dataclass(slots=True)
class FakeFile:
    """Content and what a listing says of it; `claims` is the listed size where that is not the true one."""

    data: bytes
    mtime: int | None = None
    claims: int | None = None

    def entry(self, name: bytes) -> DirEntry:
        """Return the listing's line."""
        size = len(self.data) if self.claims is None else self.claims
        return DirEntry(name, EntryKind.FILE, size, self.mtime)


class FakeStore:
    """Files and directories by mount path; directories are made as needed."""

    def __init__(self, nursery: trio.Nursery | None = None) -> None:
        """`nursery` runs the readers' deliveries; without one nothing can be read by blocks."""
        self.nursery = nursery
        self.files: dict[bytes, FakeFile] = {}
        self.directories: set[bytes] = {ROOT}
        self.unlisted: set[bytes] = set()
        self.dot: dict[bytes, FakeFile] | None = None
        self.calls: list[tuple[str, bytes]] = []
        self.crimes: list[str] = []
        self.readers: list[FakeReader] = []
        self.invalidated: list[bytes] = []
        self.list_delay = 0.0
        self.open_delay = 0.0
        self.whole_delay = 0.0
        self.crc_sizes: list[int | None] = []
        self.chunk = 4096
        self.chunk_delay = 0.001
        self.fail: dict[tuple[str, bytes], list[Exception]] = {}
        self.fail_chunks: list[Exception] = []
        self.spoil: Callable[[bytes, int, bytes], bytes] | None = None
        self.suspect_chunks = 0
        self.lost = False
        self.armed = False
        self.during_list: Callable[[bytes], None] | None = None

    # --- setting the scene

    def add(
        self, path: bytes, data: bytes, mtime: int | None = None, *, claims: int | None = None
    ) -> FakeFile:
        """Put a file there, replacing what was."""
        self.add_directory(split(path)[0])
        file = self.files[path] = FakeFile(data, mtime, claims)
        return file

    def add_directory(self, path: bytes) -> None:
        """Make a directory and those above it."""
        while path not in self.directories:
            self.directories.add(path)
            path = split(path)[0]

    def remove(self, path: bytes) -> None:
        """Remove a file or a directory with all below it."""
        below = path + b"/"
        self.files = {p: f for p, f in self.files.items() if p != path and not p.startswith(below)}
        self.directories = {p for p in self.directories if p != path and not p.startswith(below)}

    def count(self, call: str, path: bytes | None = None) -> int:
        """Return how often something was asked."""
        return sum(1 for c, p in self.calls if c == call and path in (None, p))

    # --- RemoteStore

    def is_silent(self) -> bool:
        """See RemoteStore."""
        return self.lost

    async def list_directory(self, path: bytes) -> Listing:
        await self._begin("list", path, Opcode.LIST_DIRECTORY)
        if path in self.files:
            self.crimes.append(f"listed the file {path!r}")
        if path == b".":
            if self.dot is None:
                raise FtpNak(Opcode.LIST_DIRECTORY, NakCode.FILE_NOT_FOUND)
            return Listing(tuple(file.entry(name) for name, file in self.dot.items()), self.list_delay)
        if path not in self.directories:
            await trio.sleep(self.list_delay)
            raise FtpNak(Opcode.LIST_DIRECTORY, NakCode.FILE_NOT_FOUND)
        entries = self._entries(path)
        if self.during_list is not None:
            self.during_list(path)
        await trio.sleep(self.list_delay)
        return Listing(entries, self.list_delay)

    async def stat_size(self, path: bytes) -> int:
        await self._begin("open", path, Opcode.OPEN_FILE_RO)
        if path not in self.files:
            raise FtpNak(Opcode.OPEN_FILE_RO, NakCode.FILE_NOT_FOUND)
        return len(self.files[path].data)

    async def open_reader(
        self, path: bytes, sink: ReadSink, *, expected_size: int | None = None
    ) -> FakeReader:
        reader = FakeReader(self, path, sink)
        self.readers.append(reader)  # from the first moment, as the session has it: renames take it along
        try:
            await self._begin("reader", path, Opcode.OPEN_FILE_RO)
            if expected_size is None:
                await reader.open_on_server()
            else:
                reader.size = expected_size
        except BaseException:
            self.readers.remove(reader)
            raise
        return reader

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        await self._begin("whole", path, Opcode.OPEN_FILE_RO)
        await trio.sleep(self.whole_delay)
        if path not in self.files:
            raise FtpNak(Opcode.OPEN_FILE_RO, NakCode.FILE_NOT_FOUND)
        data = self.files[path].data
        if len(data) > limit:
            raise DataUnproven("too long")
        return data

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        await self._begin("crc", path, Opcode.CALC_FILE_CRC32)
        self.crc_sizes.append(size)
        if self.armed:
            raise Armed("flying")
        return crc32(self.files[path].data)

    # --- inside

    async def _begin(self, call: str, path: bytes, opcode: int) -> None:
        wire_path(path)
        self.calls.append((call, path))
        await trio.lowlevel.checkpoint()
        self.require_link()
        errors = self.fail.get((call, path)) or self.fail.get((call, b"*"))
        if errors:
            raise errors.pop(0)

    def require_link(self) -> None:
        """Raise VehicleLost while `lost` is set."""
        if self.lost:
            raise VehicleLost("no heartbeat")

    def _entries(self, path: bytes) -> tuple[DirEntry, ...]:
        entries = [f.entry(split(p)[1]) for p, f in self.files.items() if split(p)[0] == path]
        subdirectories = [p for p in self.directories if p != ROOT and split(p)[0] == path]
        entries += [DirEntry(split(p)[1], EntryKind.DIRECTORY) for p in sorted(subdirectories)]
        return tuple(entry for entry in entries if join(path, entry.name) not in self.unlisted)


@dataclass(eq=False)
class FakeReader:
    """Delivers what is wanted chunk by chunk, demand first, each chunk as one batch."""

    store: FakeStore
    path: bytes
    sink: ReadSink
    size: int = 0
    closed: bool = False
    opened: bool = False
    serving: bool = False
    drops: int = 0
    demand: ExtentSet = field(default_factory=ExtentSet)
    ahead: ExtentSet = field(default_factory=ExtentSet)

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        assert not self.closed
        assert 0 <= start < stop <= self.size
        (self.demand if demand else self.ahead).add(start, stop)
        if not self.serving:
            self.serving = True
            assert self.store.nursery is not None
            self.store.nursery.start_soon(self._serve)

    def drop_readahead(self) -> None:
        self.drops += 1
        self.ahead = ExtentSet()

    def close(self) -> None:
        self.closed = True

    async def open_on_server(self) -> None:
        """Send the request; the first one tells the size."""
        self.store.calls.append(("open", self.path))
        await trio.sleep(self.store.open_delay)
        if self.path in self.store.directories:
            self.store.crimes.append(f"opened the directory {self.path!r}")
        if self.path not in self.store.files:
            raise FtpNak(Opcode.OPEN_FILE_RO, NakCode.FILE_NOT_FOUND)
        size = len(self.store.files[self.path].data)
        if not self.size:
            self.size = size
        elif size < self.size:
            raise FileChanged("shrank")
        self.opened = True
        self.sink.on_opened(trio.current_time())

    async def _serve(self) -> None:
        try:
            while not self.closed:
                start, stop = self._next()
                if start == stop:
                    break
                await self._deliver(start, stop)
        finally:
            self.serving = False

    def _next(self) -> tuple[int, int]:
        for wanted in (self.demand, self.ahead):
            while not wanted.empty:
                taken = wanted.take_first(self.store.chunk)
                assert taken is not None
                for gap in self.sink.missing(*taken):
                    wanted.add(gap[1], taken[1])
                    return gap
        return 0, 0

    async def _deliver(self, start: int, stop: int) -> None:
        await trio.sleep(self.store.chunk_delay)
        try:
            self.store.require_link()
            if self.store.fail_chunks:
                raise self.store.fail_chunks.pop(0)
            if not self.opened:
                await self.open_on_server()
            data = self.store.files[self.path].data[start:stop]
            if len(data) != stop - start:
                raise FileChanged("early end")
        except Exception as error:
            self.demand = ExtentSet()
            self.ahead = ExtentSet()
            if not self.closed:
                self.sink.on_failed(error)
            return
        if self.closed:
            return
        if self.store.suspect_chunks > 0:
            self.store.suspect_chunks -= 1
            if self.store.spoil is not None:
                data = self.store.spoil(self.path, start, data)
            self.sink.on_data(start, data)
            self.sink.on_suspect("a foreign client was heard")
        else:
            self.sink.on_data(start, data)
        self.sink.on_batch(len(data))
