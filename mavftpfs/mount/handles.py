"""The kernel's numbers: inodes and handles. Layer: mount; pure.

Without pyfuse3, so that commands that mount nothing work where there is no libfuse3.

The kernel knows a file by number, and reports with forget how many answers it dropped. A number is a hash of
the path at the time when it was given out. So the number stays the same after the kernel forgot it, and in
the next mount, because git's index and incremental backups compare st_ino, and read the file again over a
radio if that changed. A number in use (by a hash collision, or by a file that was renamed or unlinked while
the kernel knows it) is skipped.

An inode lives while its lookup count is above zero; the root always does.

# INVARIANT: every inode with a path is found under that path, and no two share one.
# INVARIANT: counts are never negative; an inode with count zero exists only between reserve and
#            count/discard, which no await may part (except the root).
"""

from __future__ import annotations

import hashlib
import mmap
import stat as stat_bits
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.shared.model import ROOT, EntryKind, rename_keys


@dataclass(frozen=True, slots=True)
class Presentation:
    """The presentation of entries, and the deadline of requests. Modes are permission bits; deadline in
    seconds."""

    uid: int
    gid: int
    file_mode: int
    directory_mode: int
    op_deadline: float


@contextmanager
def closed_on_failure(close: Callable[[], None]) -> Iterator[None]:
    """Close a file whose opening fails after all: the kernel sends no release for it."""
    try:
        yield
    except BaseException:
        close()
        raise


def is_mapped_page(start: int, stop: int, told: int) -> bool:
    """Return whether a write is a page of a mapping, not bytes that a program appended.

    The kernel brings pages by any handle that may write, also one with O_APPEND. They lie on page borders and
    within the size it knows (`told`, bytes), where nothing can be appended.
    """
    return start < told and start % mmap.PAGESIZE == 0 and (stop == told or stop % mmap.PAGESIZE == 0)


@dataclass(slots=True)
class FileHandle:
    """One open() of a file. flags: as given to open(2).

    ahead: the scopes of the kernel's readahead that is under way. let_go: these reads were ended once.
    """

    ino: int
    file: OpenFile
    flags: int = 0
    ahead: dict[Callable[[], None], None] = field(default_factory=dict)
    let_go: bool = False


@dataclass(slots=True)
class DirectoryHandle:
    """One opendir(). `entries` is the snapshot that its offsets count in: entry i has offset i + 1.

    cut_short: the directory has more.
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
        """Return the number of open things."""
        return len(self._handles)

    def __iter__(self) -> Iterator[HandleT]:
        """Yield the open things."""
        return iter(list(self._handles.values()))

    def add(self, handle: HandleT) -> int:
        """Return a new number for `handle`."""
        number = self._next
        self._next += 1
        self._handles[number] = handle
        return number

    def get(self, number: int) -> HandleT | None:
        """Return the thing that is open under a number, or None."""
        return self._handles.get(number)

    def remove(self, number: int) -> HandleT | None:
        """Forget a number and return the thing that was open under it, or None."""
        return self._handles.pop(number, None)


# -- inodes ---------------------------------------------------------------------------------------

ROOT_INO = 1
_INO_MASK = (1 << 63) - 1
"""Numbers stay positive in a signed 64-bit field, which some programs use."""


@dataclass(slots=True)
class Inode:
    """A number that the kernel may use.

    path: None once the name was removed. told_size: the size in bytes that the kernel last received, if any.
    """

    ino: int
    path: bytes | None
    lookups: int = 0
    told_size: int | None = None


class InodeTable:
    """All inodes of one mount."""

    def __init__(self) -> None:
        root = Inode(ROOT_INO, ROOT)
        self._by_ino: dict[int, Inode] = {ROOT_INO: root}
        self._by_path: dict[bytes, Inode] = {ROOT: root}

    def __len__(self) -> int:
        """Return the number of inodes that exist, the root included."""
        return len(self._by_ino)

    def get(self, ino: int) -> Inode | None:
        """Return the inode behind a number, or None."""
        return self._by_ino.get(ino)

    def known(self, path: bytes) -> int | None:
        """Return the number by which the kernel knows this path, or None."""
        inode = self._by_path.get(path)
        return None if inode is None else inode.ino

    def reserve(self, path: bytes) -> Inode:
        """Return the path's inode, made if necessary, without counting a lookup."""
        inode = self._by_path.get(path)
        if inode is None:
            inode = Inode(self._free_number(path), path)
            self._by_ino[inode.ino] = inode
            self._by_path[path] = inode
        return inode

    def count(self, inode: Inode) -> None:
        """Count one answer that named this inode to the kernel."""
        inode.lookups += 1

    def discard(self, inode: Inode) -> None:
        """Drop an inode if the kernel does not have it."""
        if inode.lookups == 0 and inode.ino != ROOT_INO:
            del self._by_ino[inode.ino]
            if inode.path is not None:
                del self._by_path[inode.path]

    def lookup(self, path: bytes) -> Inode:
        """Reserve and count in one step."""
        inode = self.reserve(path)
        self.count(inode)
        return inode

    def forget(self, ino: int, lookups: int) -> None:
        """Subtract `lookups` answers; at zero the inode is freed. Never raises, because forget has no
        reply."""
        inode = self._by_ino.get(ino)
        if inode is not None:
            inode.lookups = max(0, inode.lookups - lookups)
            self.discard(inode)

    def unlink(self, path: bytes) -> None:
        """Note that the name is gone; the kernel may still have the inode (an open file)."""
        inode = self._by_path.pop(path, None)
        if inode is not None:
            inode.path = None

    def rename(self, old: bytes, new: bytes) -> None:
        """Move a name and everything below it; the file at `new` becomes nameless."""
        if old == new:
            return
        self.unlink(new)
        rename_keys(self._by_path, old, new)
        for path, inode in self._by_path.items():
            inode.path = path

    def check_invariants(self) -> None:
        """Assert what the module's docstring promises (for tests)."""
        assert self._by_ino[ROOT_INO].path == ROOT
        for path, inode in self._by_path.items():
            assert inode.path == path
            assert self._by_ino[inode.ino] is inode
        for ino, inode in self._by_ino.items():
            assert inode.ino == ino
            assert inode.lookups > 0 or ino == ROOT_INO
            assert inode.path is None or self._by_path[inode.path] is inode

    def _free_number(self, path: bytes) -> int:
        digest = hashlib.blake2b(path, digest_size=8).digest()
        number = int.from_bytes(digest, "little") & _INO_MASK
        while number <= ROOT_INO or number in self._by_ino:
            number = (number + 1) & _INO_MASK
        return number


MAX_KEPT = 100_000
"""Paths for which attributes that were set are remembered."""


@dataclass(slots=True)
class UserAttributes:
    """The attributes that programs set on one path, so that `cp -p`, `rsync -a`, `tar` and `touch` see them.

    None = not set. mode: permission bits; times in nanoseconds since 1970 UTC. mtime_ns: of a directory; the
    tree knows those of files, and when these change.
    """

    mode: int | None = None
    uid: int | None = None
    gid: int | None = None
    atime_ns: int | None = None
    mtime_ns: int | None = None

    def show(self, entry: Any, found: Stat) -> None:
        """Put the set attributes into `entry` (pyfuse3.EntryAttributes); found: the tree's own."""
        if self.mode is not None:
            entry.st_mode = stat_bits.S_IFMT(entry.st_mode) | self.mode
        if self.uid is not None:
            entry.st_uid = self.uid
        if self.gid is not None:
            entry.st_gid = self.gid
        if found.kind is EntryKind.DIRECTORY and self.mtime_ns is not None:
            entry.st_mtime_ns = self.mtime_ns
        entry.st_atime_ns = entry.st_mtime_ns if self.atime_ns is None else self.atime_ns


class UserAttributeTable:
    """The attributes set on a bounded number of paths; the table forgets the least recently changed first.

    Kept by path for the life of the mount: the kernel forgets inodes at will.
    """

    def __init__(self, limit: int = MAX_KEPT) -> None:
        self._limit = limit
        self._kept: OrderedDict[bytes, UserAttributes] = OrderedDict()

    def get(self, path: bytes) -> UserAttributes | None:
        """Return the attributes set on a path, or None."""
        return self._kept.get(path)

    def at(self, path: bytes) -> UserAttributes:
        """Return the attributes set on a path, for changing them."""
        kept = self._kept.get(path)
        if kept is None:
            kept = self._kept[path] = UserAttributes()
            if len(self._kept) > self._limit:
                self._kept.popitem(last=False)
        self._kept.move_to_end(path)
        return kept

    def drop(self, path: bytes) -> None:
        """Forget a path, because the file is gone."""
        self._kept.pop(path, None)

    def move(self, old: bytes, new: bytes) -> None:
        """Note that the path, and everything below it, has another name."""
        self.drop(new)
        rename_keys(self._kept, old, new)
