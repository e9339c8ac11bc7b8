"""Open regular files: close-to-open consistency over cached blocks. Layer: cache.

At open it is decided whether what is cached of the path is still the vehicle's file:
- size and mtime of a fresh listing are known and equal the version's, or
- the version was proven (by an open ACK, a CRC32 or a listing) less than `dir_timeout` ago and no later
  listing says otherwise: it is kept, and nothing is asked;
- else the file is opened on the vehicle and a new version starts with the size in the ACK, because equal
  sizes without an mtime prove nothing.
Old handles of a file that turned out smaller, or of the same size with another mtime, get FileChanged, for
good (`Version.lost`) unless that came of what we are changing there; of one that is larger they go on at the
size they opened: logs grow. The kernel has one page cache for all handles of a path, so a new version
bypasses it (direct_io) while handles of an older one are open. What a restart of the vehicle does to open
files says `restarts`, and `reopens` what the end of the server's session on one does.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from functools import partial
from itertools import islice

from mavftpfs.cache.blocks import BlockCache, FileBlocks
from mavftpfs.cache.directories import Directories
from mavftpfs.cache.filehandle import FileHandle
from mavftpfs.cache.flights import Flights
from mavftpfs.cache.keeper import Keeper
from mavftpfs.cache.options import MIB
from mavftpfs.cache.readahead import Pace
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.reopens import Reopens, is_unsettled
from mavftpfs.cache.restarts import Restarts
from mavftpfs.cache.versions import Fetcher, Version, became_another
from mavftpfs.shared.errors import (
    DataUnproven,
    FileTooLarge,
    LocalProtocolError,
    NotFound,
    VehicleLost,
)
from mavftpfs.shared.model import DirEntry, split

MAX_CLOSED = 4096
"""How many files that nobody has open are remembered with their blocks."""

WRAP = 1 << 32
"""Open replies tell sizes modulo this, and no request reaches beyond it; MAVSDK lists true sizes."""

READING = 3.0
"""Seconds for which a file of which bytes came counts as being read."""

MAX_PIECE = MIB
"""A read is served in pieces of at most so many bytes (or a quarter of the cache)."""


class Files:
    """All regular files that are open or cached. Paths are the vehicle's.

    Attributes:
        is_changing: whether we are changing what the vehicle has of a path, or may have done so in part.
    """

    def __init__(
        self,
        store: RemoteStore,
        cache: BlockCache,
        *,
        dir_timeout: float,
        directories: Directories,
        on_size: Callable[[bytes, int], None],
        invalidate: Callable[[bytes], None],
    ) -> None:
        """`on_size` hears sizes that open ACKs told and listings did not."""
        self.keeper: Keeper | None = None
        self.is_changing: Callable[[bytes], bool] = lambda path: False
        self._store = store
        self._cache = cache
        self._clock = cache.clock
        self._dir_timeout = dir_timeout
        self._rebooted_at = float("-inf")
        self._directories = directories
        self._on_size = on_size
        self._invalidate = invalidate
        self.fetcher = Fetcher(store, cache, on_distrust=self._distrust, on_changed=self._kill)
        self.restarts = Restarts(self.fetcher, self._facts, on_changed=self._kill)
        self.reopens = Reopens(
            self.fetcher,
            directories,
            clock=cache.clock,
            opened=lambda: self._open_versions,
            is_changing=lambda path: self.is_changing(path),
            on_changed=self._kill,
        )
        self.piece = min(MAX_PIECE, cache.budget // 4)
        self._current: OrderedDict[bytes, Version] = OrderedDict()
        self._open_versions: dict[Version, None] = {}
        self._opening: Flights[bytes, tuple[Version, bool]] = Flights()
        self.open_count = 0
        self.hits = 0
        self.misses = 0

    # --- opening

    async def open(self, path: bytes, entry: DirEntry, listed_at: float, *, fresh: bool) -> FileHandle:
        """Open a path that a listing (begun at `listed_at`, perhaps not `fresh` any more) shows as `entry`.

        Raises:
            As RemoteStore.open_reader.
        """
        work = partial(self._open_version, path, entry, listed_at, fresh)
        version, kept = await self._opening.run(path, work)
        keep_cache = kept and version.shown
        version.handles += 1
        version.shown = True
        self.open_count += 1
        self._open_versions[version] = None
        others = (v for v in self._open_versions if v.path == path and v is not version)
        direct_io = any(v.dead is None or v.lost for v in others)
        return FileHandle(self, version, keep_cache=keep_cache, direct_io=direct_io)

    async def learn_size(self, path: bytes) -> int:
        """Return the size that an open ACK tells, for listings that tell none.

        Raises:
            As RemoteStore.open_reader.
        """
        version = self._current.get(path)
        if version is not None and version.handles and version.dead is None:
            return version.size
        reader = await self._store.open_reader(path, FileBlocks(self._cache))
        reader.close()
        return reader.size

    async def _open_version(
        self, path: bytes, entry: DirEntry, listed_at: float, fresh: bool
    ) -> tuple[Version, bool]:
        """Return the version to serve, and whether it is the one that was served before."""
        version = self._current.get(path)
        if version is not None and not version.handles:
            self._drop_doubtful(version)
        if version is not None and self._still_right(version, entry, listed_at, fresh):
            self._current.move_to_end(path)
            if self.keeper is not None:
                self.keeper.watch(version)
            return version, True
        kept = await self.keeper.revive(path, entry, listed_at) if fresh and self.keeper else None
        if kept is not None:
            self._replace(path, kept)
            return kept, False
        version = await self._start_version(path, entry)
        if fresh and self.keeper is not None:
            self.keeper.keep(version, entry)
        return version, False

    def _still_right(self, version: Version, entry: DirEntry, listed_at: float, fresh: bool) -> bool:
        """Return whether a version is known to be what the vehicle holds now."""
        if version.dead is not None or version.recheck:
            return False
        newer = listed_at > version.proven_at
        if newer and became_another(version.size, version.mtime, entry):
            self._kill(version)
            return False
        same_size = entry.size in (None, version.size)
        if fresh and entry.size == version.size and entry.mtime is not None and entry.mtime == version.mtime:
            version.sure |= newer
            version.proven_at = max(version.proven_at, listed_at)
            return True
        recent = self._clock() - version.proven_at < self._dir_timeout
        return recent and (same_size or not newer)

    async def _start_version(self, path: bytes, entry: DirEntry) -> Version:
        blocks = FileBlocks(self._cache)
        reader = await self._store.open_reader(path, blocks)
        if entry.size is not None and entry.size >= WRAP and entry.size % WRAP == reader.size:
            reader.close()
            raise FileTooLarge(f"{path!r} has {entry.size} bytes, more than an open reply can tell")
        blocks.size = reader.size
        old = self._current.get(path)
        if old is not None and old.size > reader.size:
            self._kill(old)
        if entry.size is not None and reader.size < entry.size and not self.is_changing(path):
            try:
                entry = await self._require_listed(path, reader.size)
            except BaseException:
                reader.close()
                raise
        mtime = entry.mtime if entry.size in (None, reader.size) else None
        version = Version(path, mtime, blocks, self._clock(), reader)
        self._replace(path, version)
        if entry.size != reader.size:
            self._on_size(path, reader.size)
        return version

    async def _require_listed(self, path: bytes, size: int) -> DirEntry:
        """Return what a listing that begins now shows of a file whose open reply told this size.

        A reply with a size that is too small would make a copy too short, without an error.

        Raises:
            DataUnproven: it shows another size. NotFound; else as RemoteStore.list_directory.
        """
        parent, name = split(path)
        entry = (await self._directories.recent(parent, began=self._clock())).entries.get(name)
        if entry is None:
            raise NotFound(f"{path!r} does not exist any more")
        if entry.size != size:
            raise DataUnproven(f"{path!r} has {entry.size} bytes as listed, and {size} as opened")
        return entry

    def _replace(self, path: bytes, version: Version) -> None:
        old = self._current.pop(path, None)
        if old is not None and not old.handles:
            old.blocks.clear()
        self._current[path] = version
        if len(self._current) > MAX_CLOSED:
            closed = (v for v in self._current.values() if not v.handles and v is not version)
            for surplus in list(islice(closed, 1)):
                self._forget(surplus)

    def status(self) -> dict[str, object]:
        """Return counters."""
        kept = {} if self.keeper is None else self.keeper.status()
        return {"hits": self.hits, "misses": self.misses, "reads_unproven": self.fetcher.unproven, **kept}

    def reads(self) -> list[dict[str, object]]:
        """Return the files that are being fetched: path, size and done in bytes."""
        recent = self._clock() - READING
        return [
            {"path": v.path.decode(errors="replace"), "size": v.size, "done": v.blocks.done}
            for v in self._open_versions
            if v.blocks.waited_for or (v.blocks.received_at > recent and v.blocks.done < v.size)
        ]

    def pace(self) -> Pace:
        """Return the bounds for readahead now."""
        return self._cache.pace(len(self._open_versions))

    def on_read(self, version: Version) -> None:
        """The kernel gets bytes of a version: if it is an old one, they are wrong for the current one."""
        current = self._current.get(version.path)
        if current is not None and current is not version:
            current.shown = False

    # --- the file changed

    def _kill(self, version: Version) -> None:
        """The path is another file now: none of those that were opened there up to this version."""
        lost = not self.is_changing(version.path)
        newest = self._current.get(version.path) is version
        older = [v for v in self._open_versions if newest and v.path == version.path]
        for one in dict.fromkeys((version, *older)):
            if one.dead is None:
                one.lost = lost
                one.end(f"{one.path!r} changed on the vehicle after it was opened")
                self._invalidate(one.path)

    def distrust(self, path: bytes) -> None:
        """The kernel may hold bytes of a file that had the path before."""
        current = self._current.get(path)
        if current is not None:
            current.shown = False
        self._invalidate(path)

    def _distrust(self, version: Version) -> None:
        """Bytes of it were dropped as doubtful: the kernel may hold copies."""
        version.shown = False
        self._invalidate(version.path)

    def _drop_doubtful(self, version: Version) -> None:
        """Nobody has it open who could settle a suspicion."""
        if version.blocks.suspicion is not None:
            version.blocks.drop_unproven()
            self._distrust(version)

    def rebooted(self) -> None:
        """Nothing is proven any more; open files are compared with a listing before their next read."""
        self._rebooted_at = self._clock()
        for version in self._current.values():
            version.proven_at = float("-inf")
        for version in self._open_versions:
            version.boot += 1

    async def _facts(self, path: bytes) -> DirEntry:
        """Return an entry listed since the last reboot."""
        found = await self._directories.find(path)
        if found.directory.listed_at < self._rebooted_at:
            raise VehicleLost("the vehicle restarted and does not answer yet")
        return found.entry

    # --- we changed the file ourselves

    def cached(self, path: bytes) -> FileBlocks | None:
        """Return what is cached of a path's present version, if all that is surely of one file."""
        version = self._current.get(path)
        if version is None or version.dead is not None or version.recheck or is_unsettled(version):
            return None
        return version.blocks

    def was_lost(self, path: bytes) -> bool:
        """Return whether somebody has a version of the path open, and is to read nothing more."""
        return any(v.path == path and v.lost for v in self._open_versions)

    def end(self, path: bytes, *, doubted: bool) -> None:
        """What we are about to write there must not be given to who has another file open, or may have one
        (`doubted`)."""
        for version in [v for v in self._open_versions if v.path == path and v.dead is None]:
            if not doubted or (version.blocks.given and version.blocks.openings.doubted):
                self._kill(version)

    def was_replaced(self, path: bytes) -> bool:
        """Return whether somebody who is to read on has a version open that is not the vehicle's any more."""
        return any(v.path == path and v.dead is not None and not v.lost for v in self._open_versions)

    def on_written(self, path: bytes) -> None:
        """What was cached of the path is no longer the file; who has it open opens it anew."""
        current = self._current.pop(path, None)
        older = [v for v in self._open_versions if v.path == path and v is not current]
        for version in older if current is None else [current, *older]:
            version.end(f"{path!r} was written")

    def adopt(self, path: bytes, size: int, pieces: Iterable[tuple[int, bytes]], *, proven_at: float) -> None:
        """Take over the content of a file we wrote: (offset, bytes) of all of it, then proven."""
        self.on_written(path)
        if proven_at <= self._rebooted_at:
            return
        blocks = FileBlocks(self._cache, size)
        blocks.on_given(0, size)
        self._replace(path, Version(path, None, blocks, proven_at, shown=True))
        for offset, data in pieces:
            blocks.preload(offset, data)

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """A file, or a directory with all below it, has another path now; open files follow."""
        self.on_removed(new)
        for version in self._versions(old):
            current = self._current.get(version.path) is version
            if current:
                del self._current[version.path]
            version.close_reader()
            version.path = new + version.path[len(old) :]
            version.blocks.ask_again()
            if current:
                self._current[version.path] = version

    def on_removed(self, path: bytes) -> None:
        """A file, or an empty directory, is gone."""
        for version in self._versions(path):
            self.on_written(version.path)

    def _versions(self, path: bytes) -> list[Version]:
        """Return what is cached or open of a path, older ones too, and of what lies below it."""
        known = dict.fromkeys((*self._current.values(), *self._open_versions))
        return [v for v in known if v.path == path or v.path.startswith(path + b"/")]

    # --- closing

    def release(self, version: Version) -> None:
        """A handle of the version was closed."""
        self.open_count -= 1
        version.handles -= 1
        if version.handles:
            return
        del self._open_versions[version]
        version.close_reader()
        version.blocks.on_failed(LocalProtocolError(f"{version.path!r} was closed while it was read"))
        self._drop_doubtful(version)
        if self._current.get(version.path) is not version:
            version.blocks.clear()
        elif version.dead is not None or version.recheck:
            self._forget(version)

    def forget_closed(self) -> None:
        """Drop everything that is not open."""
        for version in list(self._current.values()):
            if not version.handles:
                self._forget(version)

    def _forget(self, version: Version) -> None:
        version.blocks.clear()
        del self._current[version.path]
