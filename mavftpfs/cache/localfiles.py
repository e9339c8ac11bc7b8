"""Files whose names never reach the vehicle: swap files, locks. Layer: cache.

Editors make such files beside the files they work on; patterns know their names. They live in memory, within
a limit, and only this mount shows them. Directories with such names cannot be made: a trash directory would
be lost with the mount, and a file manager that finds none offers to delete instead. A rename between a local
name and the vehicle is EXDEV, as between two disks, so programs copy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import translate
from re import compile as compile_pattern

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.shared.errors import AlreadyExists, NoSpace, NotFound
from mavftpfs.shared.model import EntryKind, rename_keys, split

MAX_FILES = 10_000

NAMES = (".*.sw?", ".*.sw?x", "4913", ".~lock*", ".Trash-*", "._*")
"""What editors and file managers leave beside the files they work on; vim makes `.*.sw?x` for a moment, to
find out whether the disk cuts names short."""

_PATTERN = compile_pattern("|".join(map(translate, NAMES)).encode())


@dataclass(slots=True, eq=False)
class LocalFile:
    """mtime_ns: nanoseconds since 1970. handles: how many are open; named: it was not unlinked."""

    mtime_ns: int
    data: bytearray = field(default_factory=bytearray)
    handles: int = 0
    named: bool = True


def stays_local(path: bytes) -> bool:
    """Return whether a name in a path is one of those that never reach the vehicle."""
    return any(map(_PATTERN.match, path.split(b"/")))


class LocalFiles:
    """All local names of a mount, by path.

    Attributes:
        used: bytes of content, also of files that are open and have no name any more.
    """

    def __init__(self, limit: int, now_ns: Callable[[], int], *, used: bool) -> None:
        """`limit`: bytes of all content. used: False if all names are the vehicle's."""
        self._is_used = used
        self._limit = limit
        self._now_ns = now_ns
        self._files: dict[bytes, LocalFile] = {}
        self.used = 0

    def owns(self, path: bytes) -> bool:
        """Return whether a path is local, whether it exists or not."""
        return self._is_used and stays_local(path)

    def find(self, path: bytes) -> LocalFile:
        """Return the file of a path.

        Raises:
            NotFound.
        """
        file = self._files.get(path)
        if file is None:
            raise NotFound(f"{path!r} does not exist")
        return file

    def stat(self, path: bytes) -> Stat:
        """Return attributes. Raises NotFound."""
        file = self.find(path)
        return Stat(EntryKind.FILE, len(file.data), file.mtime_ns, 0.0)

    def names(self, directory: bytes) -> list[bytes]:
        """Return the local names in one of the vehicle's directories."""
        return [name for parent, name in map(split, self._files) if parent == directory]

    def open(self, path: bytes, *, write: bool, truncate: bool = False) -> LocalHandle:
        """Open a file. Raises NotFound."""
        file = self.find(path)
        if truncate:
            self.resize(file, 0)
        return LocalHandle(self, file, writable=write)

    def create(self, path: bytes, *, exclusive: bool) -> LocalHandle:
        """Make a file, or open the one that is there. The caller has checked its directory.

        Raises:
            AlreadyExists, NoSpace.
        """
        if path not in self._files:
            if len(self._files) >= MAX_FILES:
                raise NoSpace(f"there may be {MAX_FILES} local files")
            self._files[path] = LocalFile(self._now_ns())
        elif exclusive:
            raise AlreadyExists(f"{path!r} exists")
        return self.open(path, write=True)

    def unlink(self, path: bytes) -> None:
        """Remove a file; handles keep it. Raises NotFound."""
        file = self.find(path)
        del self._files[path]
        file.named = False
        self.forget_unused(file)

    def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """Rename within the local names.

        Raises:
            NotFound, AlreadyExists (noreplace).
        """
        file = self.find(old)
        if noreplace and new in self._files:
            raise AlreadyExists(f"{new!r} exists")
        if new in self._files and self._files[new] is not file:
            self.unlink(new)
        self._files[new] = self._files.pop(old)

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """One of the vehicle's directories has another name."""
        rename_keys(self._files, old, new)

    def resize(self, file: LocalFile, size: int) -> None:
        """Cut a file or extend it with zeros. Raises NoSpace."""
        more = size - len(file.data)
        if more > 0 and self.used + more > self._limit:
            raise NoSpace(f"local files may take {self._limit} bytes in all")
        if more > 0:
            file.data.extend(bytes(more))
        else:
            del file.data[size:]
        self.used += more
        file.mtime_ns = self._now_ns()

    def forget_unused(self, file: LocalFile) -> None:
        """Stop counting the bytes of a file that has neither a name nor a handle any more."""
        if not file.named and not file.handles:
            self.used -= len(file.data)


class LocalHandle(OpenFile):
    """One open() of a local file. It is never delivered."""

    writable = False

    def __init__(self, files: LocalFiles, file: LocalFile, *, writable: bool) -> None:
        self._files = files
        self._file = file
        self._closed = False
        self.writable = writable
        file.handles += 1

    @property
    def size(self) -> int:
        """Bytes."""
        return len(self._file.data)

    async def read(self, offset: int, size: int) -> bytes:
        """Return bytes, fewer only at the end."""
        return bytes(self._file.data[offset : offset + size])

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Write. Raises NoSpace."""
        self._files.resize(self._file, max(self.size, offset + len(data)))
        self._file.data[offset : offset + len(data)] = data
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut or extend. Raises NoSpace."""
        self._files.resize(self._file, size)

    def close(self) -> None:
        """Close; closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._file.handles -= 1
            self._files.forget_unused(self._file)
