"""What a simulated server needs of the files it serves. Layer: sim; pure.

Paths are bytes, separated by `/`; a leading slash is optional and `..` never leads above the root.
Every failure is an OSError with a Linux errno number.
"""

from __future__ import annotations

import errno
import os
from enum import Enum
from typing import NamedTuple, Protocol


class Kind(Enum):
    """What readdir says an entry is."""

    FILE = "file"
    DIRECTORY = "directory"
    SYMLINK = "symlink"
    OTHER = "other"


class Stat(NamedTuple):
    """Size in bytes, mtime in whole seconds since 1970 UTC."""

    kind: Kind
    size: int
    mtime: int


class Entry(NamedTuple):
    """One directory entry; the stat does not follow symlinks."""

    name: bytes
    stat: Stat


class TreeFile(Protocol):
    """An open file. All methods raise OSError."""

    def read(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes; fewer at the end of the file, none past it."""
        ...

    def write(self, offset: int, data: bytes) -> int:
        """Write and return the number of bytes that found room, at least 1 unless `data` is empty."""
        ...

    def size(self) -> int:
        """Return the present size."""
        ...

    def resize(self, size: int) -> None:
        """Cut or extend (with zeros) the file."""
        ...

    def close(self) -> None:
        """Make what was written durable. May be called twice."""
        ...


class Tree(Protocol):
    """A directory tree. All methods raise OSError."""

    def entries(self, path: bytes) -> list[Entry]:
        """Return the entries in readdir order, `.` and `..` among them."""
        ...

    def stat(self, path: bytes) -> Stat:
        """Describe `path`, following symlinks."""
        ...

    def open(
        self, path: bytes, *, write: bool = False, create: bool = False, truncate: bool = False
    ) -> TreeFile:
        """Open a file; EISDIR for a directory, ENOENT unless `create`."""
        ...

    def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend (with zeros) a file."""
        ...

    def remove(self, path: bytes) -> None:
        """Unlink a file; EISDIR for a directory."""
        ...

    def rename(self, old: bytes, new: bytes) -> None:
        """Rename as rename(2) does, replacing a file."""
        ...

    def mkdir(self, path: bytes) -> None:
        """Make a directory; EEXIST if there is anything of that name."""
        ...

    def rmdir(self, path: bytes) -> None:
        """Remove an empty directory; ENOTEMPTY, ENOTDIR."""
        ...


def fail(number: int, path: bytes = b"") -> OSError:
    """Return the OSError of an errno number."""
    return OSError(number, os.strerror(number), path)


def split_path(path: bytes) -> list[bytes]:
    """Split into names; empty names and `.` vanish, `..` stays.

    Raises:
        OSError: ENAMETOOLONG for a name over 255 bytes, EINVAL for a NUL.
    """
    if b"\0" in path:
        raise fail(errno.EINVAL, path)
    names = [name for name in path.split(b"/") if name not in (b"", b".")]
    if any(len(name) > 255 for name in names):
        raise fail(errno.ENAMETOOLONG, path)
    return names


def parent_and_name(path: bytes) -> tuple[bytes, bytes]:
    """Split into the parent's path and the last name, ignoring trailing slashes; (b"/", b"") for the root."""
    parent, _, name = path.rstrip(b"/").rpartition(b"/")
    return parent or b"/", name
