"""A real directory, served by a simulated vehicle. Layer: sim."""

from __future__ import annotations

import errno
import os
import stat as stat_bits

from mavftpfs.sim.filesystem import Entry, Kind, Stat, TreeFile, fail, split_path


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
        OSError: `root` is no directory, or not there.
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self._root = os.path.realpath(os.fsencode(root))
        if not os.path.isdir(self._root):
            raise fail(errno.ENOTDIR if os.path.exists(self._root) else errno.ENOENT, self._root)

    def entries(self, path: bytes) -> list[Entry]:
        """See Tree."""
        here = self._real(path)
        found = [Entry(name, _describe(os.stat(here))) for name in (b".", b"..")]
        with os.scandir(here) as scanned:
            for item in scanned:
                try:
                    found.append(Entry(item.name, _describe(item.stat(follow_symlinks=False))))
                except FileNotFoundError:
                    continue  # removed while we looked
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
        # O_NONBLOCK: a fifo must not block the server for ever.
        handle = os.open(here, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        if not stat_bits.S_ISREG(os.fstat(handle).st_mode):
            os.close(handle)
            raise fail(errno.EISDIR if os.path.isdir(here) else errno.ENXIO, path)
        return _RealFile(handle)

    def truncate(self, path: bytes, size: int) -> None:
        """See Tree."""
        os.truncate(self._real(path), size)

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
        names: list[bytes] = []
        for name in split_path(path):
            names = names[:-1] if name == b".." else [*names, name]
        return os.path.join(self._root, *names)

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
