"""Names that never reach the vehicle: swap files, locks, trash. Layer: cache.

Editors and file managers put such files beside the ones they work on, by names that the `local=` patterns
know. They live in memory, bounded, and are seen by this mount only. What lies below a directory of such a
name is local as well. Between them and those on the vehicle nothing is renamed: they are two places, so
programs hear EXDEV and copy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import translate
from re import compile as compile_pattern

from mavftpfs.cache.attributes import SECOND, Stat
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.shared.errors import (
    AlreadyExists,
    DirectoryNotEmpty,
    IsADirectory,
    NoSpace,
    NotADirectory,
    NotFound,
)
from mavftpfs.shared.model import EntryKind, join, rename_keys, split

MAX_ENTRIES = 10_000


@dataclass(slots=True, eq=False)
class LocalEntry:
    """A file (data is its content) or a directory (data is None).

    handles: how many are open; named: it was not unlinked.
    """

    data: bytearray | None
    mtime_ns: int
    handles: int = 0
    named: bool = True

    @property
    def kind(self) -> EntryKind:
        """File or directory."""
        return EntryKind.DIRECTORY if self.data is None else EntryKind.FILE


class LocalFiles:
    """All local names of a mount, by path.

    Attributes:
        used: bytes of content, also of files that are open and have no name any more.
    """

    def __init__(self, patterns: tuple[str, ...], limit: int, now_ns: Callable[[], int]) -> None:
        """`limit`: bytes of all content."""
        joined = "|".join(translate(pattern) for pattern in patterns) or r"(?!)"
        self._pattern = compile_pattern(joined.encode("utf-8", "surrogateescape"))
        self._limit = limit
        self._now_ns = now_ns
        self._entries: dict[bytes, LocalEntry] = {}
        self.used = 0

    def owns(self, path: bytes) -> bool:
        """Return whether a path is local, whether it exists or not."""
        return any(map(self._pattern.match, path.split(b"/")))

    def find(self, path: bytes) -> LocalEntry:
        """Return what a path is.

        Raises:
            NotFound.
        """
        entry = self._entries.get(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return entry

    def stat(self, path: bytes) -> Stat:
        """Return attributes.

        Raises:
            NotFound.
        """
        entry = self.find(path)
        seconds, nanoseconds = divmod(entry.mtime_ns, SECOND)
        return Stat(entry.kind, len(entry.data or b""), seconds, 0.0, nanoseconds)

    def names(self, directory: bytes) -> list[bytes]:
        """Return the local names in a directory, which may be the vehicle's."""
        return [name for parent, name in map(split, self._entries) if parent == directory]

    def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return the entries of a local directory.

        Raises:
            NotFound, NotADirectory.
        """
        if self.find(path).data is not None:
            raise NotADirectory(f"{path!r} is not a directory")
        return [(name, self.stat(join(path, name))) for name in self.names(path)]

    def open(self, path: bytes, *, write: bool, truncate: bool = False) -> LocalHandle:
        """Open a file.

        Raises:
            NotFound, IsADirectory.
        """
        entry = self.find(path)
        if entry.data is None:
            raise IsADirectory(f"{path!r} is a directory")
        if truncate:
            self.resize(entry, 0)
        return LocalHandle(self, entry, writable=write)

    def truncate(self, path: bytes, size: int) -> None:
        """Cut a file or extend it with zeros.

        Raises:
            NotFound, IsADirectory, NoSpace.
        """
        entry = self.find(path)
        if entry.data is None:
            raise IsADirectory(f"{path!r} is a directory")
        self.resize(entry, size)

    def create(self, path: bytes, *, exclusive: bool) -> LocalHandle:
        """Make a file, or open the one that is there; the directory it is put in was checked.

        Raises:
            AlreadyExists, IsADirectory, NoSpace.
        """
        if path not in self._entries:
            self._add(path, LocalEntry(bytearray(), self._now_ns()))
        elif exclusive:
            raise AlreadyExists(f"{path!r} exists")
        return self.open(path, write=True)

    def mkdir(self, path: bytes) -> None:
        """Make a directory.

        Raises:
            AlreadyExists, NoSpace.
        """
        if path in self._entries:
            raise AlreadyExists(f"{path!r} exists")
        self._add(path, LocalEntry(None, self._now_ns()))

    def unlink(self, path: bytes) -> None:
        """Remove a file; handles keep it.

        Raises:
            NotFound, IsADirectory.
        """
        entry = self.find(path)
        if entry.data is None:
            raise IsADirectory(f"{path!r} is a directory")
        del self._entries[path]
        entry.named = False
        self.forget_unused(entry)

    def rmdir(self, path: bytes) -> None:
        """Remove an empty directory.

        Raises:
            NotFound, NotADirectory, DirectoryNotEmpty.
        """
        if self.find(path).data is not None:
            raise NotADirectory(f"{path!r} is not a directory")
        if self.names(path):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        del self._entries[path]

    def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """Rename within the local names, over a file or an empty directory of the same kind.

        Raises:
            NotFound, AlreadyExists (noreplace), IsADirectory, NotADirectory, DirectoryNotEmpty.
        """
        entry, target = self.find(old), self._entries.get(new)
        if noreplace and target is not None:
            raise AlreadyExists(f"{new!r} exists")
        if target is entry:
            return
        if target is not None:
            if entry.data is None:
                self.rmdir(new)
            else:
                self.unlink(new)
        self.move_below(old, new)

    def move_below(self, old: bytes, new: bytes) -> None:
        """The directory `old` is called `new` now, whosever it is."""
        rename_keys(self._entries, old, new)

    def resize(self, entry: LocalEntry, size: int) -> None:
        """Cut a file or extend it with zeros.

        Raises:
            NoSpace.
        """
        assert entry.data is not None
        more = size - len(entry.data)
        if more > 0 and self.used + more > self._limit:
            raise NoSpace(f"local files may take {self._limit} bytes in all")
        if more > 0:
            entry.data.extend(bytes(more))
        else:
            del entry.data[size:]
        self.used += more
        entry.mtime_ns = self._now_ns()

    def write(self, entry: LocalEntry, offset: int, data: bytes | memoryview) -> None:
        """Write into a file.

        Raises:
            NoSpace.
        """
        assert entry.data is not None
        if offset + len(data) > len(entry.data):
            self.resize(entry, offset + len(data))
        entry.data[offset : offset + len(data)] = data
        entry.mtime_ns = self._now_ns()

    def forget_unused(self, entry: LocalEntry) -> None:
        """A file has fewer names or handles; without any its bytes are not counted any more."""
        if not entry.named and not entry.handles:
            self.used -= len(entry.data or b"")

    def _add(self, path: bytes, entry: LocalEntry) -> None:
        if len(self._entries) >= MAX_ENTRIES:
            raise NoSpace(f"there may be {MAX_ENTRIES} local files")
        self._entries[path] = entry


class LocalHandle(OpenFile):
    """One open() of a local file. There is nowhere to deliver it."""

    writable = False

    def __init__(self, files: LocalFiles, entry: LocalEntry, *, writable: bool) -> None:
        self._files = files
        self._entry = entry
        assert entry.data is not None
        self._data = entry.data
        self._closed = False
        self.writable = writable
        entry.handles += 1

    @property
    def size(self) -> int:
        """Bytes."""
        return len(self._data)

    async def read(self, offset: int, size: int) -> bytes:
        """Return bytes, fewer only at the end."""
        return bytes(self._data[offset : offset + size])

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Write.

        Raises:
            NoSpace.
        """
        self._files.write(self._entry, offset, data)
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut or extend.

        Raises:
            NoSpace.
        """
        self._files.resize(self._entry, size)

    def close(self) -> None:
        """Close; closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._entry.handles -= 1
            self._files.forget_unused(self._entry)
