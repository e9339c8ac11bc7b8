"""The trees that a simulated server serves: one in memory, and a real directory. Layer: sim.

Paths are bytes, separated by `/`; a leading slash is optional and `..` never leads above the root.
Every failure is an OSError with a Linux errno number.
"""

from __future__ import annotations

import errno
import os
import stat as stat_bits
from collections.abc import Callable, Iterable
from enum import Enum
from typing import NamedTuple, Protocol


class Kind(Enum):
    """The type of an entry, as readdir reports it."""

    FILE = "file"
    DIRECTORY = "directory"
    SYMLINK = "symlink"
    OTHER = "other"


class Stat(NamedTuple):
    """Size in bytes, mtime in whole seconds since 1970 UTC."""

    kind: Kind
    size: int
    mtime: int


class TreeEntry(NamedTuple):
    """One directory entry; the stat does not follow symlinks."""

    name: bytes
    stat: Stat


class OpenFile(Protocol):
    """An open file of a session. All methods raise OSError."""

    def read(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes; fewer at the end of the file, none past it."""
        ...

    def write(self, offset: int, data: bytes) -> int:
        """Write, and return the number of bytes that had room: at least 1 unless `data` is empty."""
        ...

    def size(self) -> int:
        """Return the present size. Virtual files may report a wrong one."""
        ...

    def close(self) -> None:
        """Make the written bytes durable. Harmless if called twice."""
        ...


class ClaimedFile:
    """The common part of open files that a server generates: the size that they claim, and a close that
    counts once. on_close: called by the first close.
    """

    def __init__(self, claimed: int, on_close: Callable[[], None]) -> None:
        self._claimed = claimed
        self._on_close = on_close
        self._closed = False

    def size(self) -> int:
        """See OpenFile."""
        return self._claimed

    def close(self) -> None:
        """See OpenFile."""
        if not self._closed:
            self._closed = True
            self._on_close()
            self.closed()

    def closed(self) -> None:
        """Clean up at the end; called once."""


class TreeFile(OpenFile, Protocol):
    """An open file of a tree."""

    def resize(self, size: int) -> None:
        """Cut or extend (with zeros) the file."""
        ...


class Tree(Protocol):
    """A directory tree. All methods raise OSError."""

    def entries(self, path: bytes) -> list[TreeEntry]:
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

    def remove(self, path: bytes) -> None:
        """Unlink a file; EISDIR for a directory."""
        ...

    def rename(self, old: bytes, new: bytes) -> None:
        """Rename as rename(2) does, replacing a file."""
        ...

    def mkdir(self, path: bytes) -> None:
        """Make a directory; EEXIST if the name exists."""
        ...

    def rmdir(self, path: bytes) -> None:
        """Remove an empty directory; ENOTEMPTY, ENOTDIR."""
        ...


def fail(number: int, path: bytes = b"") -> OSError:
    """Return the OSError of an errno number."""
    return OSError(number, os.strerror(number), path)


def split_path(path: bytes) -> list[bytes]:
    """Split into names. Empty names and `.` are dropped, `..` drops the name before it.

    Raises:
        OSError: ENAMETOOLONG for a name over 255 bytes, EINVAL for a NUL.
    """
    if b"\0" in path:
        raise fail(errno.EINVAL, path)
    names: list[bytes] = []
    for name in path.split(b"/"):
        if len(name) > 255:
            raise fail(errno.ENAMETOOLONG, path)
        if name == b"..":
            names = names[:-1]
        elif name not in (b"", b"."):
            names.append(name)
    return names


def parent_and_name(path: bytes) -> tuple[bytes, bytes]:
    """Split into the parent's path and the last name, ignoring trailing slashes; (b"/", b"") for the root."""
    parent, _, name = path.rstrip(b"/").rpartition(b"/")
    return parent or b"/", name


DEFAULT_MTIME = 1_700_000_000
MAX_FILE = 256 * 2**20
_DIRECTORY_SIZE = 4096
_DOTS = (b".", b"..")


class _Node:
    """A file, directory or something else; `linked` until it is removed."""

    __slots__ = ("children", "data", "kind", "linked", "mtime", "order")

    def __init__(self, kind: Kind, mtime: int) -> None:
        self.kind = kind
        self.mtime = mtime
        self.data = bytearray()
        self.children: dict[bytes, _Node] = {}
        self.order: dict[bytes, None] = {}
        self.linked = True

    def stat(self) -> Stat:
        return Stat(self.kind, _DIRECTORY_SIZE if self.kind is Kind.DIRECTORY else len(self.data), self.mtime)


class MemoryTree:
    """A tree in memory, without symlinks.

    capacity: the most bytes of all files together; None = no limit. Single files end at 256 MiB (EFBIG).
    clock: returns new mtimes, seconds since 1970; a constant unless given.
    """

    def __init__(
        self,
        *,
        capacity: int | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self.capacity = capacity
        self.used = 0
        self._clock = clock
        self._root = _Node(Kind.DIRECTORY, self._now())
        self._root.order = dict.fromkeys(_DOTS)

    # -- building a tree ---------------------------------------------------------------------

    def add(self, path: bytes, data: bytes = b"", mtime: int | None = None) -> None:
        """Make or replace a file, with its parents."""
        self.add_directory(parent_and_name(path)[0])
        with_file = self.open(path, write=True, create=True, truncate=True)
        if data:
            with_file.write(0, data)
        if mtime is not None:
            self._find(path).mtime = mtime

    def add_directory(self, path: bytes) -> None:
        """Make a directory and its parents; one that exists is left alone."""
        made = b""
        for name in split_path(path):
            made += b"/" + name
            try:
                self.mkdir(made)
            except FileExistsError:
                continue

    def add_other(self, path: bytes) -> None:
        """Make an entry that is neither file nor directory (a fifo, say)."""
        self._link(path, _Node(Kind.OTHER, self._now()))

    def data(self, path: bytes) -> bytes:
        """Return a file's content."""
        return bytes(self._find_file(path).data)

    def set_order(self, path: bytes, names: Iterable[bytes]) -> None:
        """Set the readdir order of a directory, also for later names and the dot entries. Other names
        follow."""
        node = self._find(path)
        node.order = dict.fromkeys([*names, *node.order])

    # -- the Tree protocol -------------------------------------------------------------------

    def entries(self, path: bytes) -> list[TreeEntry]:
        """See Tree."""
        node = self._find(path)
        if node.kind is not Kind.DIRECTORY:
            raise fail(errno.ENOTDIR, path)
        present = [name for name in node.order if name in node.children or name in _DOTS]
        return [TreeEntry(name, node.children.get(name, node).stat()) for name in present]

    def stat(self, path: bytes) -> Stat:
        """See Tree."""
        return self._find(path).stat()

    def open(
        self, path: bytes, *, write: bool = False, create: bool = False, truncate: bool = False
    ) -> TreeFile:
        """See Tree."""
        try:
            node = self._find_file(path)
        except FileNotFoundError:
            if not create:
                raise
            node = _Node(Kind.FILE, self._now())
            self._link(path, node)
        if truncate:
            self._resize(node, 0)
        return _MemoryFile(self, node, write)

    def remove(self, path: bytes) -> None:
        """See Tree."""
        parent, name, node = self._entry(path)
        if node.kind is Kind.DIRECTORY:
            raise fail(errno.EISDIR, path)
        self._unlink(parent, name)

    def rename(self, old: bytes, new: bytes) -> None:
        """See Tree."""
        old_parent, old_name, node = self._entry(old)
        new_parent, new_name = self._parent(new)
        target = new_parent.children.get(new_name)
        if target is node:
            return
        if node in self._walk(split_path(new)[:-1]):
            raise fail(errno.EINVAL, new)
        if target is not None:
            self._check_replaceable(node, target, new)
            self._unlink(new_parent, new_name)
        self._unlink(old_parent, old_name)
        self._link(new, node)

    def mkdir(self, path: bytes) -> None:
        """See Tree."""
        if not split_path(path):
            raise fail(errno.EEXIST, path)
        node = _Node(Kind.DIRECTORY, self._now())
        node.order = dict.fromkeys(_DOTS)
        self._link(path, node)

    def rmdir(self, path: bytes) -> None:
        """See Tree."""
        parent, name, node = self._entry(path)
        if node.kind is not Kind.DIRECTORY:
            raise fail(errno.ENOTDIR, path)
        if node.children:
            raise fail(errno.ENOTEMPTY, path)
        self._unlink(parent, name)

    # -- nodes -------------------------------------------------------------------------------

    def _now(self) -> int:
        return int(self._clock()) if self._clock is not None else DEFAULT_MTIME

    def _walk(self, names: list[bytes]) -> list[_Node]:
        """Return the nodes of this path, from the root on."""
        chain = [self._root]
        for name in names:
            if chain[-1].kind is not Kind.DIRECTORY:
                raise fail(errno.ENOTDIR, name)
            if name not in chain[-1].children:
                raise fail(errno.ENOENT, name)
            chain.append(chain[-1].children[name])
        return chain

    def _find(self, path: bytes) -> _Node:
        return self._walk(split_path(path))[-1]

    def _find_file(self, path: bytes) -> _Node:
        node = self._find(path)
        if node.kind is Kind.DIRECTORY:
            raise fail(errno.EISDIR, path)
        if node.kind is Kind.OTHER:
            raise fail(errno.ENXIO, path)
        return node

    def _parent(self, path: bytes) -> tuple[_Node, bytes]:
        names = split_path(path)
        if not names:
            raise fail(errno.EBUSY, path)
        parent = self._walk(names[:-1])[-1]
        if parent.kind is not Kind.DIRECTORY:
            raise fail(errno.ENOTDIR, path)
        return parent, names[-1]

    def _entry(self, path: bytes) -> tuple[_Node, bytes, _Node]:
        parent, name = self._parent(path)
        if name not in parent.children:
            raise fail(errno.ENOENT, path)
        return parent, name, parent.children[name]

    @staticmethod
    def _check_replaceable(node: _Node, target: _Node, path: bytes) -> None:
        if target.kind is Kind.DIRECTORY:
            if node.kind is not Kind.DIRECTORY:
                raise fail(errno.EISDIR, path)
            if target.children:
                raise fail(errno.ENOTEMPTY, path)
        elif node.kind is Kind.DIRECTORY:
            raise fail(errno.ENOTDIR, path)

    def _link(self, path: bytes, node: _Node) -> None:
        parent, name = self._parent(path)
        if name in parent.children:
            raise fail(errno.EEXIST, path)
        parent.children[name] = node
        parent.order.setdefault(name)
        parent.mtime = self._now()
        node.linked = True
        self.used += len(node.data)

    def _unlink(self, parent: _Node, name: bytes) -> None:
        node = parent.children.pop(name)
        del parent.order[name]
        parent.mtime = self._now()
        node.linked = False
        self.used -= len(node.data)

    def _limit(self, node: _Node) -> int:
        """Return the largest size that a file may have now."""
        if self.capacity is None:
            return MAX_FILE
        return min(MAX_FILE, len(node.data) + max(0, self.capacity - self.used))

    def _resize(self, node: _Node, size: int) -> None:
        grown = size - len(node.data)
        if grown > 0:
            node.data.extend(bytes(grown))
        else:
            del node.data[size:]
        if node.linked:
            self.used += grown
        node.mtime = self._now()


class _MemoryFile:
    """An open file of a MemoryTree. The file stays usable when its name is removed."""

    __slots__ = ("_data", "_node", "_tree", "_write")

    def __init__(self, tree: MemoryTree, node: _Node, write: bool) -> None:
        self._tree = tree
        self._node = node
        self._data = node.data
        self._write = write

    def read(self, offset: int, size: int) -> bytes:
        """See TreeFile."""
        return bytes(self._data[offset : offset + size])

    def write(self, offset: int, data: bytes) -> int:
        """See TreeFile."""
        if not self._write:
            raise fail(errno.EBADF)
        stop = offset + len(data)
        if stop > len(self._data):
            stop = self._grow(offset, stop)
            data = data[: stop - offset]
        self._data[offset:stop] = data
        self._node.mtime = self._tree._now()
        return len(data)

    def _grow(self, offset: int, stop: int) -> int:
        """Make room up to `stop` if the tree has it, and return the end of the possible write."""
        limit = self._tree._limit(self._node)
        if limit <= offset:
            raise fail(errno.EFBIG if offset >= MAX_FILE else errno.ENOSPC)
        stop = min(stop, limit)
        if stop > len(self._data):
            self._tree._resize(self._node, stop)
        return stop

    def size(self) -> int:
        """See TreeFile."""
        return len(self._data)

    def resize(self, size: int) -> None:
        """See TreeFile."""
        self._tree._resize(self._node, size)

    def close(self) -> None:
        """See TreeFile."""


def _describe(result: os.stat_result) -> Stat:
    if stat_bits.S_ISDIR(result.st_mode):
        kind = Kind.DIRECTORY
    elif stat_bits.S_ISREG(result.st_mode):
        kind = Kind.FILE
    else:
        kind = Kind.SYMLINK if stat_bits.S_ISLNK(result.st_mode) else Kind.OTHER
    return Stat(kind, result.st_size, int(result.st_mtime))


class DirectoryTree:
    """Serves the directory `root`; symlinks and `..` that lead out of it are refused with EACCES.

    Raises:
        OSError: `root` is not a directory, or does not exist.
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self._root = os.path.realpath(os.fsencode(root))
        if not os.path.isdir(self._root):
            raise fail(errno.ENOTDIR if os.path.exists(self._root) else errno.ENOENT, self._root)

    def entries(self, path: bytes) -> list[TreeEntry]:
        """See Tree."""
        here = self._real(path)
        found = [TreeEntry(name, _describe(os.stat(here))) for name in (b".", b"..")]
        with os.scandir(here) as scanned:
            for item in scanned:
                try:
                    found.append(TreeEntry(item.name, _describe(item.stat(follow_symlinks=False))))
                except FileNotFoundError:
                    continue  # removed meanwhile
        return found

    def stat(self, path: bytes) -> Stat:
        """See Tree."""
        return _describe(os.stat(self._real(path)))

    def open(
        self, path: bytes, *, write: bool = False, create: bool = False, truncate: bool = False
    ) -> TreeFile:
        """See Tree."""
        here = self._real(path)
        flags = os.O_RDWR if write else os.O_RDONLY
        flags |= (os.O_CREAT if create else 0) | (os.O_TRUNC if truncate else 0)
        # O_NONBLOCK, because a fifo must not block the server for ever.
        handle = os.open(here, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        if not stat_bits.S_ISREG(os.fstat(handle).st_mode):
            os.close(handle)
            raise fail(errno.EISDIR if os.path.isdir(here) else errno.ENXIO, path)
        return _RealFile(handle)

    def remove(self, path: bytes) -> None:
        """See Tree."""
        here = self._name(path)
        if os.path.isdir(here) and not os.path.islink(here):
            raise fail(errno.EISDIR, path)
        os.unlink(here)

    def rename(self, old: bytes, new: bytes) -> None:
        """See Tree."""
        os.rename(self._name(old), self._name(new))

    def mkdir(self, path: bytes) -> None:
        """See Tree."""
        os.mkdir(self._real(path))

    def rmdir(self, path: bytes) -> None:
        """See Tree."""
        os.rmdir(self._name(path))

    def _join(self, path: bytes) -> bytes:
        return os.path.join(self._root, *split_path(path))

    def _inside(self, real: bytes) -> bytes:
        if real != self._root and not real.startswith(self._root + b"/"):
            raise fail(errno.EACCES, real)
        return real

    def _real(self, path: bytes) -> bytes:
        """Return the real path with every symlink followed."""
        return self._inside(os.path.realpath(self._join(path)))

    def _name(self, path: bytes) -> bytes:
        """Return the real path of the entry itself, a last symlink not followed."""
        joined = self._join(path)
        if joined == self._root:
            raise fail(errno.EBUSY, path)
        parent, name = os.path.split(joined)
        return os.path.join(self._inside(os.path.realpath(parent)), name)


class _RealFile:
    """An open file of a DirectoryTree."""

    __slots__ = ("_handle",)

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def read(self, offset: int, size: int) -> bytes:
        """See TreeFile."""
        return os.pread(self._handle, size, offset)

    def write(self, offset: int, data: bytes) -> int:
        """See TreeFile."""
        return os.pwrite(self._handle, data, offset)

    def size(self) -> int:
        """See TreeFile."""
        return os.fstat(self._handle).st_size

    def resize(self, size: int) -> None:
        """See TreeFile."""
        os.ftruncate(self._handle, size)

    def close(self) -> None:
        """See TreeFile."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            os.close(handle)
