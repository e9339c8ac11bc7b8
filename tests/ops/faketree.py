"""A tree in memory with the caches' interface, whose answers a test can delay, change or spoil."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import trio

from mavftpfs.cache.localfiles import stays_local
from mavftpfs.cache.tree import Stat
from mavftpfs.client.files import Files, Session
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import AlreadyExists, IsADirectory, NotADirectory, NotFound
from mavftpfs.shared.model import ROOT, EntryKind, split

MTIME = 1_700_000_000


def session_of(tree: Any, root: bytes = ROOT) -> Session:
    """Return a session on a tree, of a vehicle that is heard and does nothing else."""
    return Session(cast(Files, tree), quiet, root)


async def quiet() -> dict[str, Any]:
    return {"link": {"state": "fine"}, "transfers": [], "cache": {}}


@dataclass
class FakeFile:
    """An open file: serves the bytes it was opened with."""

    tree: FakeTree
    content: bytes
    closed: bool = False
    writable: bool = False
    path: bytes = b""
    made: bool = False
    direct_io = keep_cache = False
    has_name = True
    verified = ""

    @property
    def size(self) -> int:
        return len(self.content)

    async def write(self, offset: int, data: bytes) -> int:
        await self.tree.pause("write", self.path)
        held = self.content.ljust(offset, b"\0")
        self.content = held[:offset] + data + held[offset + len(data) :]
        return len(data)

    async def truncate(self, size: int) -> None:
        await self.tree.pause("ftruncate", self.path)
        self.content = self.content[:size].ljust(size, b"\0")

    async def flush(self) -> None:
        await self.tree.pause("flush", self.path)
        self.tree.files[self.path] = self.content

    async def fsync(self, *, ends_write: bool = False) -> None:
        await self.tree.pause("fsync", self.path)
        self.tree.files[self.path] = self.content

    async def release(self) -> None:
        try:
            await self.tree.pause("release", self.path)
        finally:
            self.closed = True

    async def take_back(self) -> bool | None:
        self.closed = True
        await self.tree.pause("take_back", self.path)
        self.tree.taken_back.append(self.path)
        if self.made:
            del self.tree.files[self.path]
        return False

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        await self.tree.pause("read")
        data = memoryview(self.content)[offset : offset + size]
        return data[: self.tree.short_read] if self.tree.short_read is not None else data

    def close(self) -> None:
        self.closed = True


@dataclass
class FakeTree:
    """Files by path; directories are the parents of files, and what `directories` names.

    error: fails all calls; failing: those of a name, or of a name and a path. delays: seconds, by name.
    """

    files: dict[bytes, bytes] = field(default_factory=dict)
    directories: set[bytes] = field(default_factory=set)
    valid_for: float = 1.0
    calls: list[tuple[str, bytes]] = field(default_factory=list)
    error: BaseException | None = None
    failing: dict[str | tuple[str, bytes], BaseException] = field(default_factory=dict)
    delays: dict[str, float] = field(default_factory=dict)
    short_read: int | None = None
    opened: list[FakeFile] = field(default_factory=list)
    times: dict[bytes, int] = field(default_factory=dict)
    left: list[bytes] = field(default_factory=list)
    taken_back: list[bytes] = field(default_factory=list)
    on_call: Callable[[str, bytes], None] = lambda name, path: None

    async def pause(self, name: str, path: bytes = b"") -> None:
        self.calls.append((name, path))
        await trio.lowlevel.checkpoint()
        if self.delays.get(name):
            await trio.sleep(self.delays[name])
        self.on_call(name, path)
        error = self.error or self.failing.get(name) or self.failing.get((name, path))
        if error is not None:
            raise error

    def is_only_read(self, path: bytes) -> bool:
        return path.startswith(b"/@")

    def is_local(self, path: bytes) -> bool:
        return stays_local(path) and path in self.files

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
        return Stat(kind, size, self.times.get(path, MTIME * 10**9), self.valid_for)

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

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, **more: object
    ) -> FakeFile:
        await self.pause("open", path)
        if self.kind_of(path) is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        content = b"" if truncate else self.files[path]
        file = FakeFile(self, content, writable=write, path=path)
        self.opened.append(file)
        return file

    async def create(self, path: bytes, *, exclusive: bool, **more: object) -> FakeFile:
        await self.pause("create", path)
        if exclusive and path in self.files:
            raise AlreadyExists(f"{path!r} is there")
        made = path not in self.files
        self.files.setdefault(path, b"")
        file = await self.open(path, write=True)
        file.made = made
        return file

    async def truncate(self, path: bytes, size: int) -> None:
        await self.pause("truncate", path)
        self.files[path] = self.files[path][:size].ljust(size, b"\0")

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        await self.pause("set_times", path)
        self.times[path] = mtime_ns

    async def mkdir(self, path: bytes, *, on_card: bool = False) -> None:
        await self.pause("mkdir", path)
        self.directories.add(path)

    async def rmdir(self, path: bytes) -> None:
        await self.pause("rmdir", path)
        self.directories.discard(path)

    async def unlink(self, path: bytes) -> None:
        await self.pause("unlink", path)
        del self.files[path]

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool = False, on_card: bool = False) -> None:
        await self.pause("rename", old)
        if noreplace and new in self.files:
            raise AlreadyExists(f"{new!r} is there")
        self.files = {
            new + path[len(old) :] if path == old or path.startswith(old + b"/") else path: data
            for path, data in self.files.items()
            if path != new
        }

    def undelivered(self) -> Sequence[bytes]:
        return self.left

    async def break_unfinished(self) -> None:
        pass

    async def drain(self, timeout: float) -> Sequence[bytes]:
        await self.pause("drain")
        return self.left

    def broken(self) -> Sequence[bytes]:
        return []

    def recover_to(self, directory: Path) -> Sequence[Path]:
        self.calls.append(("recover_to", os.fsencode(directory)))
        return [directory / os.fsdecode(path.lstrip(b"/")) for path in self.left]

    async def refresh(self) -> None:
        await self.pause("refresh")

    async def crc32(self, path: bytes) -> int:
        await self.pause("crc32", path)
        return crc32(self.files[path])
