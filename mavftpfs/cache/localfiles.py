"""Files whose names never reach the vehicle: swap files, locks. Layer: cache.

Editors make such files beside the files they work on; patterns know their names. They live in memory, within
a limit, and only this mount shows them. What already has such a name on the card stays the card's.
Directories with such names cannot be made: a trash directory would be lost with the mount, and a file manager
that finds none offers to delete instead. A rename between a local name and the vehicle is EXDEV, as between
two disks, so programs copy.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from fnmatch import translate
from re import compile as compile_pattern

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.items import Folder, Item
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.source import Opening, Source
from mavftpfs.shared.errors import AlreadyExists, NoSpace, NotADirectory, NotFound, NotSupported
from mavftpfs.shared.model import EntryKind

MAX_FILES = 10_000

RequireDirectory = Callable[[bytes], Awaitable[None]]
"""Checks that the directory of a path exists."""

NAMES = (".*.sw?", ".*.sw?x", "4913", ".~lock*", ".Trash-*", "._*")
"""Files that editors and file managers make beside those they work on; vim makes `.*.sw?x` for a moment, to
learn whether the disk cuts names short."""

_PATTERN = compile_pattern("|".join(map(translate, NAMES)).encode())


class LocalFile(Item):
    """A file in memory.

    Attributes:
        mtime_ns: nanoseconds since 1970. handles: how many are open.
    """

    __slots__ = ("data", "handles", "mtime_ns")

    def __init__(self, folder: Folder, name: bytes, mtime_ns: int) -> None:
        super().__init__(folder, name)
        self.mtime_ns = mtime_ns
        self.data = bytearray()
        self.handles = 0

    @property
    def is_local(self) -> bool:
        """See Item."""
        return True


def stays_local(path: bytes) -> bool:
    """Return whether a name in a path is one of those that never reach the vehicle."""
    return any(map(_PATTERN.match, path.split(b"/")))


class LocalFiles(Source):
    """All local files of a mount. They are entries of its tree, so they follow their directory.

    Attributes:
        used: bytes of content, also of open files that were removed.
    """

    def __init__(
        self, root: Folder, limit: int, now_ns: Callable[[], int], require_directory: RequireDirectory
    ) -> None:
        """`limit`: bytes of all content. require_directory(path) raises NotFound or NotADirectory."""
        self._root = root
        self._limit = limit
        self._now_ns = now_ns
        self._require_directory = require_directory
        self._count = 0
        self.used = 0

    def find(self, path: bytes) -> LocalFile:
        """Return the file of a path.

        Raises:
            NotFound.
        """
        file = self._root.find(path)
        if not isinstance(file, LocalFile):
            raise NotFound(f"{path!r} does not exist")
        return file

    def has(self, path: bytes) -> bool:
        """Return whether a path is that of a local file."""
        return isinstance(self._root.find(path), LocalFile)

    def below(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return the local files in one of the vehicle's directories."""
        folder = self._root.find_folder(path)
        entries = [] if folder is None else list(folder.children.values())
        return [(entry.name, self._stat(entry)) for entry in entries if isinstance(entry, LocalFile)]

    def _stat(self, file: LocalFile) -> Stat:
        return Stat(EntryKind.FILE, len(file.data), file.mtime_ns, 0.0)

    # --- what the tree asks

    async def stat(self, path: bytes) -> Stat:
        """Return attributes. Raises NotFound."""
        return self._stat(self.find(path))

    async def open(self, path: bytes, how: Opening) -> LocalHandle:
        """Open a file. Raises NotFound."""
        file = self.find(path)
        if how.truncate:
            self.resize(file, 0)
        return LocalHandle(self, file, writable=how.write)

    async def crc32(self, path: bytes) -> int:
        """No vehicle has it. Raises NotFound."""
        raise NotFound(f"{path!r} is not on the vehicle")

    async def create(self, path: bytes, *, exclusive: bool) -> LocalHandle:
        """Make a file, or open the one that is there.

        Raises:
            AlreadyExists, NoSpace. NotFound, NotADirectory: its directory.
        """
        await self._require_directory(path)
        folder, name = self._root.home(path)
        file = folder.children.get(name)
        if not isinstance(file, LocalFile):
            if self._count >= MAX_FILES:
                raise NoSpace(f"there may be {MAX_FILES} local files")
            self._count += 1
            file = folder.children[name] = LocalFile(folder, name, self._now_ns())
        elif exclusive:
            raise AlreadyExists(f"{path!r} exists")
        return LocalHandle(self, file, writable=True)

    async def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file. Raises NotFound, NoSpace."""
        self.resize(self.find(path), size)

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Show an mtime. Raises NotFound."""
        self.find(path).mtime_ns = mtime_ns

    async def mkdir(self, path: bytes) -> None:
        """Refuse: see the module."""
        raise NotSupported(f"{path!r} is a name for files that stay in memory")

    async def rmdir(self, path: bytes) -> None:
        """There are no local directories. Raises NotFound, NotADirectory."""
        self.find(path)
        raise NotADirectory(f"{path!r} is not a directory")

    async def unlink(self, path: bytes) -> None:
        """Remove a file; handles keep it. Raises NotFound."""
        self._remove(self.find(path))

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """Rename within the local names.

        Raises:
            NotFound, AlreadyExists (noreplace). NotFound, NotADirectory: the new directory.
        """
        await self._require_directory(new)
        file, (folder, name) = self.find(old), self._root.home(new)
        there = folder.children.get(name)
        if isinstance(there, LocalFile) and there is not file:
            if noreplace:
                raise AlreadyExists(f"{new!r} exists")
            self._remove(there)
            folder, name = self._root.home(new)
        file.move(folder, name)

    # --- for handles

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
        """Stop counting the bytes of a file that lost its name and its last handle."""
        if not file.has_name and not file.handles:
            self.used -= len(file.data)

    def _remove(self, file: LocalFile) -> None:
        file.leave_tree()
        self._count -= 1
        self.forget_unused(file)
        if file.folder is not None:
            file.folder.prune()


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
