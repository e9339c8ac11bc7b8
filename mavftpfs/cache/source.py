"""The calls that each kind of path offers: the card's files, local files, snapshots, texts. Layer: cache.

`Tree` finds the source of a path once, and asks it. A source that does not override a call refuses changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import ReadOnly


@dataclass(frozen=True, slots=True)
class Opening:
    """The way to open a file. truncate: empty it. append, program: see Tree.open."""

    write: bool = False
    truncate: bool = False
    append: bool = False
    program: Callable[[], Any] = lambda: None


class Source:
    """Where files of one kind come from. Paths are the vehicle's; see Tree for what each call does."""

    async def stat(self, path: bytes) -> Stat:
        """Return attributes."""
        raise NotImplementedError

    async def open(self, path: bytes, how: Opening) -> OpenFile:
        """Open a file."""
        raise NotImplementedError

    async def crc32(self, path: bytes) -> int:
        """Return the CRC32 (start value 0, no final xor) of what a reader gets."""
        file = await self.open(path, Opening())
        return crc32(await file.read(0, file.size))

    async def create(self, path: bytes, *, exclusive: bool) -> OpenFile:
        """Make a file."""
        self._refuse(path)

    async def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file."""
        self._refuse(path)

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Show an mtime."""
        self._refuse(path)

    async def mkdir(self, path: bytes) -> None:
        """Make a directory."""
        self._refuse(path)

    async def rmdir(self, path: bytes) -> None:
        """Remove an empty directory."""
        self._refuse(path)

    async def unlink(self, path: bytes) -> None:
        """Remove a file."""
        self._refuse(path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """Rename to a path of the same source."""
        self._refuse(old)

    def _refuse(self, path: bytes) -> NoReturn:
        raise ReadOnly(readonly.virtual(path))
