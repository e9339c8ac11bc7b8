"""The `@` trees: files whose listed sizes lie and which must be read whole. Layer: cache.

ArduPilot announces `@SYS` and `@ROMFS` in the listing of `/` and keeps `@PARAM` and `@MISSION` to itself,
because they cannot be listed (AP_Filesystem::opendir has no backend entry for them; servers.md 11); newer
PX4 has `@PARAM/param.pck`. `@SYS` claims 100000 bytes for most files, generates them at open, and refuses
some that it lists. So every such file is read whole into a snapshot: a stat takes one, for the true size,
and the open that follows reuses it, so that stat, open and read agree and rsync, tar and cp work.
"""

from __future__ import annotations

import math
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import trio

from mavftpfs.cache.attributes import Stat, shown_mtime
from mavftpfs.cache.directories import Directories, Found
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import (
    DataUnproven,
    FtpNak,
    IsADirectory,
    LinkError,
    ListingIncomplete,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    RequestTimeout,
    SessionBusy,
)
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, join, split

UNLISTABLE: dict[bytes, tuple[bytes, ...]] = {
    b"@PARAM": (b"param.pck",),
    b"@MISSION": (b"mission.dat", b"fence.dat", b"rally.dat"),
}
"""Trees that no listing shows, and what is shown in them; other names (`param.pck?start=1`) may be opened."""

PARAM_FILE = b"/@PARAM/param.pck"
ANNOUNCERS = frozenset({b"@SYS", b"@ROMFS"})
TRUE_SIZES = frozenset({b"@ROMFS"})
COST_FACTOR = 10
"""A snapshot that took T seconds to read is good for at least COST_FACTOR * T."""

GRACE = 10.0
"""An open may use a snapshot for so many seconds after it ceased to answer stat: who asked for the size just
before gets the bytes of that size."""

MAX_SIZES = 4096
"""Of how many files the true size is remembered."""


def tree_of(path: bytes) -> bytes:
    """Return the first part of an absolute path."""
    return path[1:].partition(b"/")[0]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A whole `@` file. good_until: when it no longer answers stat."""

    data: bytes
    good_until: float


class Snapshots:
    """Remembered snapshots within a budget of bytes, and the true sizes of more."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._snapshots: OrderedDict[bytes, Snapshot] = OrderedDict()
        self._sizes: OrderedDict[bytes, int] = OrderedDict()
        self.bytes_cached = 0

    def get(self, path: bytes, now: float) -> Snapshot | None:
        """Return a snapshot that is good at `now`."""
        snapshot = self._snapshots.get(path)
        return snapshot if snapshot is not None and now < snapshot.good_until else None

    def size_of(self, path: bytes) -> int | None:
        """Return the size that the last snapshot had, in bytes."""
        return self._sizes.get(path)

    def put(self, path: bytes, snapshot: Snapshot) -> None:
        """Remember a snapshot; one that exceeds the budget leaves only its size."""
        self._drop(path)
        self._sizes.pop(path, None)
        self._sizes[path] = len(snapshot.data)
        if len(self._sizes) > MAX_SIZES:
            self._drop(self._sizes.popitem(last=False)[0])
        self._snapshots[path] = snapshot
        self.bytes_cached += len(snapshot.data)
        while self.bytes_cached > self._budget:
            self._drop(next(iter(self._snapshots)))

    def clear(self) -> None:
        """Forget everything."""
        self._snapshots.clear()
        self._sizes.clear()
        self.bytes_cached = 0

    def _drop(self, path: bytes) -> None:
        snapshot = self._snapshots.pop(path, None)
        if snapshot is not None:
            self.bytes_cached -= len(snapshot.data)


class SnapshotHandle(OpenFile):
    """One open() of an `@` file."""

    size = 0
    direct_io = True

    def __init__(self, data: bytes, on_close: Callable[[], None]) -> None:
        self._data = memoryview(data)
        self._on_close: Callable[[], None] | None = on_close
        self.size = len(data)

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end.

        Raises:
            LocalProtocolError: the handle was closed.
        """
        if self._on_close is None:
            raise LocalProtocolError("read of a closed handle")
        return self._data[offset : offset + size]

    def close(self) -> None:
        """Release the handle."""
        if self._on_close is not None:
            self._on_close()
            self._on_close = None


class VirtualTrees:
    """stat, list and open below `/@...`. Paths are the vehicle's."""

    def __init__(
        self,
        store: RemoteStore,
        directories: Directories,
        options: CacheOptions,
        *,
        clock: Callable[[], float],
        invalidate: Callable[[bytes], None],
        nursery: trio.Nursery | None = None,
    ) -> None:
        self._store = store
        self._directories = directories
        self._options = options
        self._clock = clock
        self._invalidate = invalidate
        self._reading: SingleFlight[bytes, Snapshot] = SingleFlight(nursery)
        self._param_opens: bool | None = None
        self._absent: dict[bytes, float] = {}  # until when a name is known not to open
        self._unread: set[bytes] = set()  # too slow or refused otherwise: listing does not try again
        self.snapshots = Snapshots(options.at_cache_size)
        self.open_count = 0

    # --- what the tree asks

    def shown_in_root(self, names: Iterable[bytes]) -> tuple[bytes, ...]:
        """Return the directories that appear beside the listed `names` of `/`; costs no traffic."""
        if self._param_opens or not ANNOUNCERS.isdisjoint(names):
            return tuple(UNLISTABLE)
        return ()

    def absent_until(self, path: bytes) -> float:
        """Return until when a path, listed or not, is not shown because it did not open; 0 if it is."""
        return self._absent.get(path, 0.0)

    async def stat(self, path: bytes) -> Stat:
        """Return attributes; of a file with its true size, reading it where the listed one lies.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory and read_whole.
        """
        found = await self._find(path)
        if found is None or found.entry.kind is EntryKind.FILE:
            return await self._stat_file(path, found)
        return self.listed_stat(path, found)

    def listed_stat(self, path: bytes, found: Found | None) -> Stat:
        """Return what is known without traffic; valid_for is 0 where asking again tells more."""
        now = self._clock()
        entry = DirEntry(b"", EntryKind.FILE) if found is None else found.entry
        size, until = self._size(path, found), now
        snapshot = self.snapshots.get(path, now)
        if found is not None and (entry.kind is EntryKind.DIRECTORY or tree_of(path) in TRUE_SIZES):
            until = found.directory.fresh_until
        elif snapshot is not None:
            until = snapshot.good_until
        valid_for = max(0.0, min(self._options.attr_timeout, until - now))
        return Stat(entry.kind, size, shown_mtime(path, entry.mtime), valid_for)

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return the entries that can be opened, with true sizes as far as they are known in time.

        Raises:
            As Tree.list.
        """
        tree = tree_of(path)
        founds: dict[bytes, Found | None]
        cut_short = False
        if tree in UNLISTABLE:
            if path != b"/" + tree:
                raise NotADirectory(f"{path!r} is not a directory")
            await self._require_shown(tree)
            founds = dict.fromkeys(UNLISTABLE[tree])
        else:
            directory = await self._directories.get(path)
            cut_short = directory.cut_short
            founds = {name: Found(entry, directory) for name, entry in directory.entries.items()}
        by_path = {join(path, name): found for name, found in founds.items()}
        await self._probe(by_path)
        shown = [(split(p)[1], self.listed_stat(p, f)) for p, f in by_path.items() if self._shows(p)]
        if cut_short:
            raise ListingIncomplete(f"{path!r} was not listed to its end", shown)
        return shown

    async def open(self, path: bytes) -> SnapshotHandle:
        """Read the file whole, unless that was just done.

        Raises:
            NotFound, NotADirectory, IsADirectory; else as RemoteStore.read_whole.
        """
        found = await self._find(path)
        if found is not None and found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        snapshot = self.snapshots.get(path, self._clock() - GRACE) or await self._read(path)
        self.open_count += 1
        return SnapshotHandle(snapshot.data, self._on_close)

    async def crc32(self, path: bytes) -> int:
        """Return the CRC32 (as FileBlocks.crc32) of what a reader gets; the vehicle sums other bytes.

        Raises:
            As open.
        """
        handle = await self.open(path)
        try:
            return zlib.crc32(await handle.read(0, handle.size), 0xFFFFFFFF) ^ 0xFFFFFFFF
        finally:
            handle.close()

    def rebooted(self) -> None:
        """Forget what this server was seen to do, and all snapshots."""
        self._param_opens = None
        self._absent.clear()
        self._unread.clear()
        self.snapshots.clear()

    # --- finding

    async def _find(self, path: bytes) -> Found | None:
        """Return what the listing says, None for a file in a tree that cannot be listed."""
        tree = tree_of(path)
        if tree in UNLISTABLE:
            return await self._find_unlistable(path, tree)
        found = await self._directories.find(path)
        if not self._shows(path):
            raise NotFound(f"{path!r} is listed, but the vehicle does not open it")
        return found

    async def _find_unlistable(self, path: bytes, tree: bytes) -> Found | None:
        await self._require_shown(tree)
        name = path[len(tree) + 2 :]
        if not name:
            root = await self._directories.get(ROOT)
            return Found(DirEntry(tree, EntryKind.DIRECTORY), root)
        # No such file starts with a dot, but file managers ask for many that do.
        if b"/" in name or name.startswith(b".") or not self._shows(path):
            raise NotFound(f"{path!r} does not exist")
        return None

    async def _require_shown(self, tree: bytes) -> None:
        """Raise NotFound unless this server has such trees; asks it at most once in its life."""
        root = await self._directories.get(ROOT)
        if self.shown_in_root(root.entries):
            return
        if tree == tree_of(PARAM_FILE) and self._param_opens is None:
            try:
                await self._read(PARAM_FILE)
            except (FtpNak, NotFound):
                self._param_opens = False
            else:
                self._param_opens = True
                return
        raise NotFound(f"this vehicle has no {tree.decode()}")

    def _shows(self, path: bytes) -> bool:
        return self._absent.get(path, 0.0) <= self._clock()

    # --- reading

    def _size(self, path: bytes, found: Found | None) -> int:
        """Return the true size if a snapshot ever told it, else what the listing claims."""
        true_size = self.snapshots.size_of(path)
        if true_size is not None:
            return true_size
        if found is None or found.entry.kind is EntryKind.DIRECTORY:
            return 0
        return found.size or 0

    async def _stat_file(self, path: bytes, found: Found | None) -> Stat:
        good = self.snapshots.get(path, self._clock()) is not None
        if not good and self._lies(path, found) and not self._directories.lost:
            try:
                await self._read(path)
            except (FtpNak, DataUnproven, LinkError, SessionBusy):
                if found is None and self.snapshots.size_of(path) is None:
                    raise
        return self.listed_stat(path, found)

    def _lies(self, path: bytes, found: Found | None) -> bool:
        """Return whether the file is to be read to know its size."""
        if found is None or found.size is None:
            return True
        return tree_of(path) not in TRUE_SIZES and found.size <= self._options.at_stat_limit

    async def _probe(self, by_path: dict[bytes, Found | None]) -> None:
        """Read what was never read, to know what opens; stop when `probe_time` is over."""
        with trio.move_on_after(self._options.probe_time):
            for path, found in by_path.items():
                if self._to_be_probed(path, found) and not await self._probe_one(path):
                    return

    def _to_be_probed(self, path: bytes, found: Found | None) -> bool:
        if found is not None and found.entry.kind is not EntryKind.FILE:
            return False
        known = self.snapshots.size_of(path) is not None or path in self._unread
        return not known and self._shows(path) and self._lies(path, found)

    async def _probe_one(self, path: bytes) -> bool:
        """Read a file to see whether it opens; return False if the link is too bad to go on."""
        self._unread.add(path)
        try:
            await self._read(path)
        except (LinkError, RequestTimeout, SessionBusy):
            self._unread.discard(path)
            return False
        except (FtpNak, DataUnproven, NotFound):
            return True  # shown with its listed size, or hidden by _read
        self._unread.discard(path)
        return True

    async def _read(self, path: bytes) -> Snapshot:
        """Take a snapshot; concurrent callers share it.

        Raises:
            NotFound: the vehicle does not know the file, listed or not. Else as RemoteStore.read_whole.
        """
        return await self._reading.run(path, partial(self._read_once, path))

    async def _read_once(self, path: bytes) -> Snapshot:
        began = self._clock()
        try:
            data = await self._store.read_whole(path, self._options.at_file_limit)
        except FtpNak as nak:
            if nak.opcode == Opcode.OPEN_FILE_RO:
                self._refused(path, nak)
            raise
        now = self._clock()
        life = max(self._options.proof_time, COST_FACTOR * (now - began))
        snapshot = Snapshot(data, now + life)
        shown = self.snapshots.size_of(path)
        self.snapshots.put(path, snapshot)
        if shown not in (None, len(data)):
            self._invalidate(path)
        return snapshot

    def _refused(self, path: bytes, nak: FtpNak) -> None:
        """Remember that a file does not open, if the refusal says so.

        Raises:
            NotFound: it does.
        """
        if tree_of(path) in UNLISTABLE:
            if len(self._absent) >= MAX_SIZES:
                self._absent.clear()
            self._absent[path] = self._clock() + self._options.proof_time
        elif nak.code == NakCode.FILE_NOT_FOUND:
            self._absent[path] = math.inf  # until the vehicle restarts
        else:
            return
        raise NotFound(f"the vehicle does not open {path!r}") from nak

    def _on_close(self) -> None:
        self.open_count -= 1
