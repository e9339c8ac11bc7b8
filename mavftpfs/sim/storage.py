"""A tree as one firmware's filesystem shows it. Layer: sim; pure.
This module adds the differences of FatFs, LittleFS and NuttX (servers.md 6, 8, 9) and the virtual `@` trees.
NoErrno: the firmware fails without setting errno, so the server reports an older one.
"""

from __future__ import annotations

import errno
import random
import re
import weakref

from mavftpfs.protocol.payload import crc32
from mavftpfs.sim import profiles
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.pseudo import VirtualTrees
from mavftpfs.sim.tree import Kind, OpenFile, Stat, Tree, TreeEntry, TreeFile, fail, parent_and_name

_FAT_FORBIDDEN = frozenset(b'"*:<>?|\x7f') | frozenset(range(32))
_SIGNS = rb"!#-)\-0-9@^-`{}~"
_SHORT = re.compile(
    rb"(?:[%(s)bA-Z]{1,8}|[%(s)ba-z]{1,8})(?:\.(?:[%(s)bA-Z]{,3}|[%(s)ba-z]{,3}))?" % {b"s": _SIGNS}
)
"""Names that NuttX stores without a long name (its fat_parsesfname)."""

_GAP_LIMIT = 65_536
_CRC_BLOCK = 65_536
_SECTOR = 512


class NoErrno(OSError):
    """A failure that sets no errno: the server reports the errno of an earlier failure."""

    def __init__(self) -> None:
        super().__init__()


class Storage:
    """The filesystem of one server. Every method raises OSError.

    removes_first: a rename removes its target even if the source is missing (NuttX before October 2022).
    """

    def __init__(
        self, tree: Tree, profile: Profile, rng: random.Random, virtual: VirtualTrees | None = None
    ) -> None:
        self._tree = tree
        self.kind = profile.storage
        self.removes_first = False
        self._fold = profile.case_fold
        self._rng = rng
        self._fat = self.kind in (profiles.Storage.FATFS, profiles.Storage.NUTTX_FAT)
        self.virtual = virtual or VirtualTrees(
            profile.virtual_trees, exact=profile.of_2026, says_so=profile.sessions > 1
        )
        self._writing: weakref.WeakSet[_FatFile] = weakref.WeakSet()

    def entries(self, path: bytes) -> list[TreeEntry]:
        """Return the directory in readdir order; FAT has no dot entries."""
        if self.virtual.owns(path):
            return self.virtual.entries(path)
        folder = self._resolve(path)
        found = self._tree.entries(folder)
        if self._fat:
            below = folder.rstrip(b"/") + b"/"
            found = [self._fat_entry(below, entry) for entry in found if entry.name not in (b".", b"..")]
        return found

    def stat(self, path: bytes) -> Stat:
        """Describe `path`."""
        if self.virtual.owns(path):
            return self.virtual.stat(path)
        real = self._resolve(path)
        return self._as_entered(real, self._tree.stat(real))

    def open(
        self, path: bytes, *, write: bool = False, create: bool = False, truncate: bool = False
    ) -> OpenFile:
        """Open a file."""
        if self.virtual.owns(path):
            return self.virtual.open(path, write=write)
        if create:
            self._check_name(path)
        place = self._resolve(path)
        real = self._tree.open(place, write=write, create=create, truncate=truncate)
        if not self._fat:
            return real
        if not write:
            return _Entered(real, self._as_entered(place, self._tree.stat(place)).size)
        opened = _FatFile(place, real, self.kind is profiles.Storage.FATFS, self._rng)
        self._writing.add(opened)
        return opened

    def lose_power(self) -> None:
        """Lose the bytes of files that are still open, if this storage loses them."""
        for opened in self._writing:
            opened.lose()
        self._writing.clear()

    def crc(self, path: bytes) -> tuple[int, int]:
        """Return the CRC32 of a file, and the number of its bytes."""
        if self.virtual.owns(path):
            content = self.virtual.content(path, block=64)
            return crc32(content), len(content)
        opened = self.open(path)
        try:
            checksum, offset = 0, 0
            while block := opened.read(offset, _CRC_BLOCK):
                checksum = crc32(block, checksum)
                offset += len(block)
            return checksum, offset
        finally:
            opened.close()

    def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file."""
        self._refuse_virtual(path)
        opened = self._tree.open(self._resolve(path), write=True)
        opened.resize(size)
        opened.close()

    def mkdir(self, path: bytes) -> None:
        """Make a directory."""
        self._refuse_virtual(path)
        self._check_name(path)
        try:
            self._tree.mkdir(self._resolve(path))
        except FileNotFoundError as exc:
            if self.kind is profiles.Storage.NUTTX_FAT:
                raise fail(errno.EIO, path) from exc
            raise

    def unlink(self, path: bytes) -> None:
        """Remove a file; EISDIR for a directory."""
        self._refuse_virtual(path)
        self._remove(self._resolve(path))

    def rmdir(self, path: bytes) -> None:
        """Remove an empty directory; ENOTDIR, ENOTEMPTY."""
        self._refuse_virtual(path)
        self._tree.rmdir(self._resolve(path))

    def remove_any(self, path: bytes) -> None:
        """Remove a file or an empty directory, as ArduPilot's one unlink does (servers.md 9)."""
        try:
            self.rmdir(path)
        except NotADirectoryError:
            self.unlink(path)
        except OSError as exc:
            if exc.errno != errno.ENOTEMPTY:
                raise
            if self.kind is profiles.Storage.FATFS:
                raise fail(errno.EACCES, path) from exc
            if self.kind is profiles.Storage.POSIX:
                self.unlink(path)  # runs after rmdir failed; its EISDIR is reported
            raise

    def rename(self, old: bytes, new: bytes) -> None:
        """Rename; treat an existing target as this filesystem does."""
        self._refuse_virtual(old)
        self._refuse_virtual(new)
        if self.kind is profiles.Storage.LITTLEFS:
            raise NoErrno
        source, target = self._resolve(old), self._resolve(new)
        if self._fat:
            self._check_name(new)
            target = self._fat_target(source, target)
        self._tree.rename(source, target)
        for opened in self._writing:
            if opened.path == source:
                opened.path = target

    def _remove(self, path: bytes) -> None:
        self._tree.remove(path)
        for opened in self._writing:
            if opened.path == path:
                opened.path = b""

    def _fat_target(self, source: bytes, target: bytes) -> bytes:
        try:
            there = self._tree.stat(target)
        except FileNotFoundError:
            return target
        if not self.removes_first:
            self._tree.stat(source)
        if self.kind is profiles.Storage.FATFS:
            if source == target:
                return target
            raise fail(errno.EEXIST, target)
        if there.kind is Kind.DIRECTORY:
            return target.rstrip(b"/") + b"/" + parent_and_name(source)[1]
        if source != target:
            self._remove(target)  # NuttX fs_rename: not atomic
        return target

    def _refuse_virtual(self, path: bytes) -> None:
        if self.virtual.owns(path):
            raise fail(errno.EROFS, path)

    def _check_name(self, path: bytes) -> None:
        if self._fat and _FAT_FORBIDDEN.intersection(parent_and_name(path)[1]):
            raise fail(errno.EINVAL, path)

    def _fat_entry(self, below: bytes, entry: TreeEntry) -> TreeEntry:
        stat = self._as_entered(below + entry.name, entry.stat)
        return TreeEntry(entry.name, stat._replace(mtime=stat.mtime & ~1))

    def _as_entered(self, path: bytes, stat: Stat) -> Stat:
        """Return a stat with the size in FAT's directory entry.

        A file that is open for writing gets its size there only when it is closed.
        """
        for opened in self._writing:
            if opened.path == path and opened.is_open:
                return stat._replace(size=opened.entered)
        return stat

    def _resolve(self, path: bytes) -> bytes:
        """Return the path in this filesystem's spelling.

        FAT drops ends of names (`_kept`). Where case is folded, as NuttX does with short names, a missing
        name becomes an existing one in another case.
        """
        if not self._fat:
            return path
        resolved = b""
        for name in path.split(b"/"):
            if name:
                kept = self._kept(name)
                folds = self._fold or self._is_short(kept)
                resolved += b"/" + (self._folded(resolved or b"/", kept) if folds else kept)
        return resolved or b"/"

    def _kept(self, name: bytes) -> bytes:
        """Return a name without the end that FAT drops.

        FatFs drops all dots and blanks there (its create_name). NuttX keeps them in long names. One dot
        behind a short name begins an empty extension, and is lost.
        """
        if self.kind is profiles.Storage.NUTTX_FAT:
            return name.removesuffix(b".") if self._is_short(name) else name
        return name.rstrip(b". ") or name

    def _is_short(self, name: bytes) -> bool:
        return self.kind is profiles.Storage.NUTTX_FAT and _SHORT.fullmatch(name) is not None

    def _exists(self, path: bytes) -> bool:
        try:
            self._tree.stat(path)
        except OSError:
            return False
        return True

    def _folded(self, parent: bytes, name: bytes) -> bytes:
        if not self._fold and self._exists(parent.rstrip(b"/") + b"/" + name):
            return name
        try:
            names = [entry.name for entry in self._tree.entries(parent)]
        except OSError:
            return name
        if name in names:
            return name
        if self._fold:
            return next((other for other in names if _in_page_850(other) == _in_page_850(name)), name)
        alike = (other for other in names if other.lower() == name.lower())
        return next((other for other in alike if self._is_short(other)), name)


def _in_page_850(name: bytes) -> str:
    """Return a name in FatFs's capitals. FatFs takes its bytes for code page 850 (servers.md 9)."""
    return "".join(c.upper() if len(c.upper()) == 1 else c for c in name.decode("cp850"))


class _Entered:
    """A FAT file open for reading, which ends at the size of its directory entry at the opening."""

    def __init__(self, real: TreeFile, size: int) -> None:
        self._real = real
        self._size = size
        self.close = real.close

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        return self._real.read(offset, max(0, min(size, self.size() - offset)))

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        return self._real.write(offset, data)

    def size(self) -> int:
        """See OpenFile."""
        return self._size


class _FatFile:
    """A FAT file open for writing. Closing it writes the size to its directory entry. The last written sector
    is in memory until then, or until another one is written. On FatFs a full card is EIO, and so is a write
    of no bytes; a gap has the old bytes of the card.

    path: its present name. entered: the size in its directory entry. is_open: nobody has closed it.
    """

    def __init__(self, path: bytes, real: TreeFile, fatfs: bool, rng: random.Random) -> None:
        self.path = path
        self._real = real
        self._fatfs = fatfs
        self._rng = rng
        self.entered = real.size()
        self.is_open = True
        self._sector = -1
        self._on_card = b""
        self.read = real.read
        self.size = real.size

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        self._hold_sector(offset + len(data) - 1)
        if not self._fatfs:
            return self._real.write(offset, data)
        if not data:
            raise fail(errno.EIO)
        try:
            size = self._real.size()
            if size < offset:
                self._real.write(size, self._rng.randbytes(min(offset - size, _GAP_LIMIT)))
            return self._real.write(offset, data)
        except OSError as exc:
            raise fail(errno.EIO if exc.errno == errno.ENOSPC else exc.errno or errno.EIO) from exc

    def close(self) -> None:
        """See OpenFile."""
        self.is_open = False
        self._real.close()

    def lose(self) -> None:
        """Lose the power: the bytes appended since the file was opened, and those in memory, are lost."""
        if not self.is_open:
            return
        if self._on_card:
            self._real.write(self._sector * _SECTOR, self._on_card)
        if self._real.size() > self.entered:
            self._real.resize(self.entered)

    def _hold_sector(self, offset: int) -> None:
        """Note that the sector of this position is about to be written in memory."""
        sector = offset // _SECTOR
        if sector != self._sector:
            start = sector * _SECTOR
            self._sector = sector
            self._on_card = self._real.read(start, min(_SECTOR, max(0, self.entered - start)))
