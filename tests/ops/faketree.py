"""A tree in memory with the caches' interface, whose answers a test can delay, change or spoil."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.tree import Stat
from mavftpfs.protocol.crc import crc32
from mavftpfs.shared.errors import IsADirectory, NotADirectory, NotFound
from mavftpfs.shared.model import ROOT, EntryKind, split

MTIME = 1_700_000_000


@dataclass
class FakeFile:
    """An open file: serves the bytes it was opened with."""

    tree: FakeTree
    content: bytes
    direct_io: bool = False
    keep_cache: bool = False
    closed: int = 0

    @property
    def size(self) -> int:
        return len(self.content)

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        await self.tree.pause("read")
        data = memoryview(self.content)[offset : offset + size]
        return data[: self.tree.short_read] if self.tree.short_read is not None else data

    def close(self) -> None:
        self.closed += 1


@dataclass
class FakeTree:
    """Files by path; directories are the parents of files, and what `directories` names."""

    files: dict[bytes, bytes] = field(default_factory=dict)
    directories: set[bytes] = field(default_factory=set)
    valid_for: float = 1.0
    calls: list[tuple[str, bytes]] = field(default_factory=list)
    error: BaseException | None = None
    delays: dict[str, float] = field(default_factory=dict)
    short_read: int | None = None
    direct_io: bool = False
    keep_cache: bool = False
    opened: list[FakeFile] = field(default_factory=list)
    on_call: Callable[[str, bytes], None] = lambda name, path: None

    async def pause(self, name: str, path: bytes = b"") -> None:
        self.calls.append((name, path))
        await trio.lowlevel.checkpoint()
        if self.delays.get(name):
            await trio.sleep(self.delays[name])
        self.on_call(name, path)
        if self.error is not None:
            raise self.error

    def kind_of(self, path: bytes) -> EntryKind:
        if path in self.files:
            return EntryKind.FILE
        prefix = path if path.endswith(b"/") else path + b"/"
        known = any(other.startswith(prefix) for other in [*self.files, *self.directories])
        if path == ROOT or path in self.directories or known:
            return EntryKind.DIRECTORY
        if split(path)[0] in self.files:
            raise NotADirectory(f"{path!r} runs through a file")
        raise NotFound(f"{path!r} is not there")

    def stat_now(self, path: bytes) -> Stat:
        kind = self.kind_of(path)
        size = len(self.files[path]) if kind is EntryKind.FILE else 0
        return Stat(kind, size, MTIME, self.valid_for)

    async def stat(self, path: bytes) -> Stat:
        await self.pause("stat", path)
        return self.stat_now(path)

    def negative_valid_for(self, path: bytes) -> float:
        return 2 * self.valid_for

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        await self.pause("list", path)
        if self.kind_of(path) is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{path!r} is a file")
        prefix = path if path.endswith(b"/") else path + b"/"
        below = [other for other in [*self.files, *self.directories] if other.startswith(prefix)]
        names = sorted({other[len(prefix) :].split(b"/")[0] for other in below} - {b""})
        return [(name, self.stat_now(prefix + name)) for name in names]

    async def open(self, path: bytes) -> FakeFile:
        await self.pause("open", path)
        if self.kind_of(path) is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        file = FakeFile(self, self.files[path], self.direct_io, self.keep_cache)
        self.opened.append(file)
        return file

    async def crc32(self, path: bytes) -> int:
        await self.pause("crc32", path)
        return crc32(self.files[path])
