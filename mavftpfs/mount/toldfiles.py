"""The files of a mount for commands and programs that use its control socket. Layer: mount.

They change the mount's tree without the kernel. So the mount notifies the kernel: of names at once, because
the kernel believes for a while that a name is absent; of pages and attributes, because the kernel keeps those
of the old content. The mount notifies after the change, when no lock is held, and an answer waits for that
TELLING_TIME at most, because the kernel itself waits for look-ups and reads in progress. Programs that watch
by inotify receive nothing.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.localfiles import stays_local
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.mount.invalidator import Invalidator
from mavftpfs.mount.operations import Operations
from mavftpfs.shared.errors import NotSupported
from mavftpfs.shared.readable import name_text

TELLING_TIME = 1.0
"""Seconds for the kernel to drop its caches, before the answer to a change."""


class ToldFiles:
    """Implements client.files.Files."""

    def __init__(self, tree: Tree, operations: Operations, invalidator: Invalidator) -> None:
        self._tree = tree
        self._operations = operations
        self._invalidator = invalidator

    async def stat(self, path: bytes) -> Stat:
        """See Files."""
        return await self._tree.stat(path)

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """See Files."""
        return await self._tree.list(path)

    async def crc32(self, path: bytes) -> int:
        """See Files."""
        return await self._tree.crc32(path)

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, append: bool = False
    ) -> ToldFile:
        """See Files. The kernel drops its pages first, because the tree treats every opener as a reader."""
        if write or truncate:
            _require_on_card(path)
        await _told(self._invalidator.forget_pages, path)
        file = await self._tree.open(path, write=write, truncate=truncate, append=append)
        if truncate:
            self._invalidator.on_changed(path)
        return ToldFile(file, path, self._invalidator)

    async def create(self, path: bytes, *, exclusive: bool) -> ToldFile:
        """See Files."""
        _require_on_card(path)
        file = await self._tree.create(path, exclusive=exclusive)
        await _told(self._invalidator.forget_name, path)
        return ToldFile(file, path, self._invalidator)

    async def mkdir(self, path: bytes) -> None:
        """See Files."""
        await self._tree.mkdir(path)
        await _told(self._invalidator.forget_name, path)

    async def rmdir(self, path: bytes) -> None:
        """See Files."""
        await self._tree.rmdir(path)
        await self._gone(path)

    async def unlink(self, path: bytes) -> None:
        """See Files."""
        await self._tree.unlink(path)
        await self._gone(path)

    async def _gone(self, path: bytes) -> None:
        self._operations.note_gone(path)
        await _told(self._invalidator.forget_name, path)

    async def rename(self, old: bytes, new: bytes) -> None:
        """See Files."""
        if stays_local(old) != stays_local(new):
            _require_on_card(new)
        await self._tree.rename(old, new)
        self._operations.note_renamed(old, new)
        await _told(self._invalidator.forget_name, old, new)

    async def refresh(self) -> None:
        """See Files. The kernel asks again within two seconds."""
        self._tree.forget_caches()
        await trio.lowlevel.checkpoint()


class ToldFile:
    """Implements client.files.File."""

    def __init__(self, file: OpenFile, path: bytes, invalidator: Invalidator) -> None:
        self._file = file
        self._path = path
        self._invalidator = invalidator

    @property
    def size(self) -> int:
        """See File."""
        return self._file.size

    @property
    def verified(self) -> str:
        """See File."""
        return self._file.verified

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """See File."""
        return await self._file.read(offset, size)

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """See File."""
        with self._changing():
            return await self._file.write(offset, data)

    async def truncate(self, size: int) -> None:
        """See File."""
        with self._changing():
            await self._file.truncate(size)

    async def fsync(self) -> None:
        """See File."""
        with self._changing():
            await self._file.fsync()
        await self._tell()

    async def release(self) -> None:
        """See File."""
        with self._changing():
            await self._file.release()
        await self._tell()

    async def take_back(self) -> bool | None:
        """See File."""
        there = await self._file.take_back()
        await self._tell()
        return there

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Have the kernel drop its pages of a file that the body changes."""
        try:
            yield
        finally:
            if self._file.writable:
                self._invalidator.on_changed(self._path)

    async def _tell(self) -> None:
        """Return when programs that open the file, or look at it, see its present state."""
        if self._file.writable:
            await _told(self._invalidator.forget_file, self._path)


async def _told(tell: Callable[..., Awaitable[None]], *paths: bytes) -> None:
    with trio.move_on_after(TELLING_TIME, shield=True):  # what was opened meanwhile is not lost by a cancel
        await tell(*paths)


def _require_on_card(path: bytes) -> None:
    """Check that a name is not one of those that a mount keeps in memory.

    Raises:
        NotSupported.
    """
    if stays_local(path):
        raise NotSupported(
            f"{name_text(path)} would stay in the mount's memory, as editors' swap files do, and never reach "
            "the card; choose another name, or unmount first"
        )
