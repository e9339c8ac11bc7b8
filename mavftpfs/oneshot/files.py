"""What the one-shot verbs need of a vehicle's files. Layer: top.

`cache.tree.Tree` offers it for a connection of our own, `mounted.MountedFiles` for a mount that is up.
Paths are normalised (shared.model.normalise).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from mavftpfs.cache.attributes import Stat
from mavftpfs.shared.errors import NotFound
from mavftpfs.shared.model import EntryKind

READ_SIZE = 128 * 1024


class File(Protocol):
    """An open file; see cache.openfile.OpenFile."""

    @property
    def size(self) -> int: ...

    async def read(self, offset: int, size: int) -> bytes | memoryview: ...

    async def write(self, offset: int, data: bytes | memoryview) -> int: ...

    async def fsync(self) -> None: ...

    def close(self) -> None: ...


class Files(Protocol):
    """A tree of files; all calls raise only MavftpfsError. See cache.tree.Tree."""

    async def stat(self, path: bytes) -> Stat: ...

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]: ...

    async def open(self, path: bytes, *, write: bool = False, truncate: bool = False) -> File: ...

    async def create(self, path: bytes, *, exclusive: bool) -> File: ...

    async def crc32(self, path: bytes) -> int: ...

    async def mkdir(self, path: bytes) -> None: ...

    async def rmdir(self, path: bytes) -> None: ...

    async def unlink(self, path: bytes) -> None: ...

    async def rename(self, old: bytes, new: bytes) -> None: ...

    def expire(self, path: bytes) -> None: ...

    def forget_caches(self) -> None: ...


Transfers = Sequence[dict[str, Any]]
"""Files of which the vehicle lacks bytes: "path", "size", "bytes_left" (see cache.throttle)."""


async def _none() -> Transfers:
    return []


async def _no_return() -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Session:
    """A vehicle's files for the length of one command.

    root: where `/` of `files` lies on the vehicle. transfers: asks what is not on the vehicle yet.
    mountpoint: of the mount whose files these are, None for a connection of our own. silent: whether the
    vehicle is not heard; returned: waits for it, and returns whether it is heard again in time.
    """

    files: Files
    root: bytes = b"/"
    transfers: Callable[[], Awaitable[Transfers]] = _none
    mountpoint: str | None = None
    silent: Callable[[], bool] = lambda: False
    returned: Callable[[], Awaitable[bool]] = _no_return

    def on_vehicle(self, path: bytes) -> bytes:
        """Return the vehicle's own name of a path."""
        return self.root.rstrip(b"/") + path if path != b"/" else self.root


async def is_directory(files: Files, path: bytes) -> bool:
    """Return whether a path is a directory; False also where nothing is."""
    try:
        return (await files.stat(path)).kind is EntryKind.DIRECTORY
    except NotFound:
        return False
