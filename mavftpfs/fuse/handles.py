"""File and directory handles, and what the operations need of the tree. Layer: fuse; pure.

Without pyfuse3, so that commands that mount nothing work where there is no libfuse3.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from mavftpfs.shared.model import EntryKind

XATTR_CRC32 = b"user.mavftp.crc32"
XATTR_STATUS = b"user.mavftpfs.status"


@dataclass(frozen=True, slots=True)
class Space:
    """The card's size and free space in bytes."""

    total: int
    free: int


class Stat(Protocol):
    """What the tree says of one path. size in bytes, mtime in seconds UTC and mtime_nsec to add to them,
    valid_for in seconds."""

    @property
    def kind(self) -> EntryKind: ...
    @property
    def size(self) -> int: ...
    @property
    def mtime(self) -> int: ...
    @property
    def mtime_nsec(self) -> int: ...
    @property
    def valid_for(self) -> float: ...


class OpenFile(Protocol):
    """A file open for reading; cache.openfile.OpenFile says more. size in bytes."""

    @property
    def size(self) -> int: ...
    @property
    def direct_io(self) -> bool: ...
    @property
    def keep_cache(self) -> bool: ...
    async def read(self, offset: int, size: int) -> bytes | memoryview: ...
    def close(self) -> None: ...


@contextmanager
def closed_on_failure(file: OpenFile) -> Iterator[None]:
    """Close a file whose opening fails after all: the kernel sends no release for it."""
    try:
        yield
    except BaseException:
        file.close()
        raise


class WritableFile(OpenFile, Protocol):
    """A file open for whatever, as a mount that may be changed sees it."""

    @property
    def writable(self) -> bool: ...
    async def write(self, offset: int, data: bytes) -> int: ...
    async def truncate(self, size: int) -> None: ...
    async def flush(self) -> None: ...
    async def fsync(self) -> None: ...
    async def release(self) -> None: ...
    def give_up(self) -> None: ...


class FileTree(Protocol):
    """The vehicle's files behind their caches (cache.tree.Tree); raises only MavftpfsError."""

    async def stat(self, path: bytes) -> Stat: ...
    def negative_valid_for(self, path: bytes) -> float: ...
    async def list(self, path: bytes) -> Sequence[tuple[bytes, Stat]]: ...
    async def open(self, path: bytes) -> OpenFile: ...
    async def crc32(self, path: bytes) -> int: ...


class WritableTree(FileTree, Protocol):
    """The same, with what changes it."""

    async def open(self, path: bytes, *, write: bool = False, truncate: bool = False) -> WritableFile: ...
    async def create(self, path: bytes, *, exclusive: bool) -> WritableFile: ...
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
    file: OpenFile
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
