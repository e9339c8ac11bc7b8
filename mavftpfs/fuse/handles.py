"""File and directory handles, and what the operations need of the tree. Layer: fuse; pure.

Without pyfuse3, so that commands that mount nothing work where there is no libfuse3.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from mavftpfs.cache.attributes import Stat

XATTR_CRC32 = b"user.mavftp.crc32"
XATTR_STATUS = b"user.mavftpfs.status"


@dataclass(frozen=True, slots=True)
class Space:
    """The card's size and free space in bytes."""

    total: int
    free: int


@dataclass(frozen=True, slots=True)
class Presentation:
    """How entries look, and how long requests may take. Modes are permission bits; deadline in seconds."""

    uid: int
    gid: int
    file_mode: int
    directory_mode: int
    op_deadline: float


class File(Protocol):
    """An open file (cache.writefile.OpenFile says more). size in bytes."""

    @property
    def size(self) -> int: ...
    @property
    def direct_io(self) -> bool: ...
    @property
    def keep_cache(self) -> bool: ...
    @property
    def writable(self) -> bool: ...
    async def read(self, offset: int, size: int) -> bytes | memoryview: ...
    async def write(self, offset: int, data: bytes) -> int: ...
    async def truncate(self, size: int) -> None: ...
    async def flush(self) -> None: ...
    async def fsync(self) -> None: ...
    async def release(self) -> None: ...
    def close(self) -> None: ...
    def give_up(self) -> None: ...


@contextmanager
def closed_on_failure(close: Callable[[], None]) -> Iterator[None]:
    """Close a file whose opening fails after all: the kernel sends no release for it."""
    try:
        yield
    except BaseException:
        close()
        raise


def is_mapped_page(start: int, stop: int, told: int) -> bool:
    """Return whether a write brings a page of a mapping instead of what a program appended.

    The kernel brings pages by any handle that may write, also one with O_APPEND. They lie on page borders and
    within the size it knows (`told`, bytes), where nothing can be appended.
    """
    return start < told and start % mmap.PAGESIZE == 0 and (stop == told or stop % mmap.PAGESIZE == 0)


class Tree(Protocol):
    """The vehicle's files behind their caches (cache.tree.Tree); raises only MavftpfsError."""

    async def stat(self, path: bytes) -> Stat: ...
    def negative_valid_for(self, path: bytes) -> float: ...
    async def list(self, path: bytes) -> Sequence[tuple[bytes, Stat]]: ...
    async def crc32(self, path: bytes) -> int: ...
    async def open(self, path: bytes, *, write: bool = False, truncate: bool = False) -> File: ...
    async def create(self, path: bytes, *, exclusive: bool) -> File: ...
    async def truncate(self, path: bytes, size: int) -> None: ...
    async def set_times(self, path: bytes, mtime_ns: int) -> None: ...
    async def mkdir(self, path: bytes) -> None: ...
    async def rmdir(self, path: bytes) -> None: ...
    async def unlink(self, path: bytes) -> None: ...
    async def rename(self, old: bytes, new: bytes, *, noreplace: bool = False) -> None: ...


@dataclass(slots=True)
class FileHandle:
    """One open() of a file. flags: as given to open(2)."""

    ino: int
    file: File
    flags: int = 0


@dataclass(slots=True)
class DirectoryHandle:
    """One opendir(). `entries` is the snapshot that its offsets count in: entry i has offset i + 1.

    cut_short: they are not all that the directory has.
    """

    ino: int
    entries: Sequence[tuple[bytes, Stat]] = field(default_factory=list)
    cut_short: bool = False


HandleT = TypeVar("HandleT")


class HandleTable(Generic[HandleT]):
    """Numbers for open things; a number is never used twice in one mount."""

    def __init__(self) -> None:
        self._next = 1
        self._handles: dict[int, HandleT] = {}

    def __len__(self) -> int:
        """Return how many are open."""
        return len(self._handles)

    def __iter__(self) -> Iterator[HandleT]:
        """Yield what is open."""
        return iter(list(self._handles.values()))

    def add(self, handle: HandleT) -> int:
        """Return a new number for `handle`."""
        number = self._next
        self._next += 1
        self._handles[number] = handle
        return number

    def get(self, number: int) -> HandleT | None:
        """Return what is open under a number, or None."""
        return self._handles.get(number)

    def remove(self, number: int) -> HandleT | None:
        """Forget a number and return what was open under it, or None."""
        return self._handles.pop(number, None)
