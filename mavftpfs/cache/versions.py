"""One version of a remote file, and how its bytes are proven. Layer: cache.

A version is what one open ACK's size and one listing's mtime describe. Handles of the same version share
its blocks and its remote reader. When the file is seen to have become another one, the old version is
`dead`: its handles get FileChanged, and new opens start a new version. If that was somebody else's doing the
version is `lost`: who has it open is not to be given what has its path now, whoever wrote that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from mavftpfs.cache.blocks import BlockCache, FileBlocks, Gaps
from mavftpfs.cache.flights import Flights
from mavftpfs.cache.kept import Kept
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.readahead import NOTHING, Plan
from mavftpfs.cache.remote import Reader, RemoteStore
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FileChanged,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    RemoteProtocolError,
    RequestTimeout,
)
from mavftpfs.shared.model import DirEntry

MAX_RESTARTS = 8
"""How often one read starts anew because other readers of the file dropped doubtful bytes meanwhile."""


PROVE_SECONDS = 60.0
"""How long the rest of a file may take to be fetched only in order to prove a part of it."""


@dataclass(slots=True, eq=False)
class Version:
    """A file as it was when it was opened.

    mtime: None if not known to belong to this size. A listing of before it was opened told it, so it may be
    that of a predecessor until it is sure. dated: whether an unknown one was asked for. proven_at: when it
    was last known to be what the vehicle holds. handles: how many are open. shown: whether the kernel may
    hold pages of it and all of them are good. boot: how often the vehicle restarted while it was open.
    proven_boot: the one of these after which it was proven to be the same file still. dead: why it is not the
    path's file any more; lost: somebody else changed that. kept: its part on the local disk, if it may have
    one.
    """

    path: bytes
    mtime: int | None
    blocks: FileBlocks
    proven_at: float
    reader: Reader | None = None
    sure: bool = False
    dated: bool = False
    handles: int = 0
    shown: bool = False
    boot: int = 0
    proven_boot: int = 0
    dead: MavftpfsError | None = None
    lost: bool = False
    kept: Kept | None = None

    @property
    def size(self) -> int:
        """Size in bytes by the open ACK."""
        return self.blocks.size

    @property
    def recheck(self) -> bool:
        """Whether the vehicle restarted since it was proven, so that the file may be another one."""
        return self.boot != self.proven_boot

    def require_alive(self) -> None:
        """Raise FileChanged if the file became another one."""
        if self.dead is not None:
            raise self.dead.with_traceback(None)

    def end(self, why: str) -> None:
        """It is not the path's file any more; who waits for its bytes hears so."""
        self.dead = FileChanged(why)
        self.close_reader()
        self.blocks.on_failed(self.dead)
        self.blocks.clear()

    def close_reader(self) -> None:
        """Drop readahead and the remote reader."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.drop_readahead()
            reader.close()


class Fetcher:
    """Gets bytes of versions from the vehicle, believing them only when they are proven.

    What happens to provisional bytes (promise 1), exactly:
    1. A read whose range is not wholly proven waits while the suspicion is settled, once for all readers.
    2. If the file fits half of the cache and the rest of it comes within PROVE_SECONDS at the link's
       measured rate, the vehicle is asked for its CRC32, the rest is fetched, and the file is opened anew
       for its size. If both agree, everything held is proven.
    3. Otherwise (they differ, the file is too large, the vehicle is armed or refuses) all provisional
       bytes are dropped, here and in the kernel, and the read starts over with a new reader.
    4. If the new reader is suspected too, it is settled once more; a read that would have to drop bytes a
       second time ends with DataUnproven (EIO). The next read starts from the beginning.
    A time-out or a lost link while settling is the reader's error and leaves the bytes provisional.

    After a restart of the vehicle the same check decides, where the listing cannot, whether the file is
    still the one of which bytes were given out (`restarts`); it decides only if all of these are held.

    Attributes:
        paths: whose names are being changed by us: nothing is opened meanwhile.
        on_distrust: the kernel may hold bytes of a version that are in doubt now.
    """

    def __init__(
        self,
        store: RemoteStore,
        cache: BlockCache,
        *,
        on_distrust: Callable[[Version], None],
        on_changed: Callable[[Version], None],
    ) -> None:
        """`on_distrust` hears that bytes were dropped, `on_changed` that the file became another."""
        self._store = store
        self._cache = cache
        self.on_distrust = on_distrust
        self._on_changed = on_changed
        self.paths = PathLocks(cache.patience)
        self._opening: Flights[Version, Reader] = Flights()
        self._settling: Flights[Version, bool] = Flights()
        self.unproven = 0

    async def fetch(self, version: Version, start: int, stop: int, plan: Plan) -> bytes | memoryview:
        """Return [start, stop) of a version; `plan` is asked for beside it.

        Raises:
            FileChanged, DataUnproven, RequestTimeout; else as RemoteStore.open_reader.
        """
        drops = 0
        for _ in range(MAX_RESTARTS):
            if version.blocks.suspicion is not None and not await self._settle(version):
                drops += 1
                if drops > 1:
                    break
            data = await self._read(version, start, stop, plan)
            if data is not None:
                return data
        self.unproven += 1
        raise DataUnproven(f"bytes of {version.path!r} may be another file's, and could not be proven")

    async def _read(self, version: Version, start: int, stop: int, plan: Plan) -> bytes | memoryview | None:
        """Return [start, stop), None if it came provisional or was dropped."""
        blocks = version.blocks
        try:
            async with blocks.held(start, stop):
                if version.kept is not None and blocks.missing(start, stop):
                    await version.kept.fill(blocks, start, stop, version.require_alive)
                if blocks.missing(start, stop):
                    reader = await self.reader(version)
                    await blocks.fill(start, stop, partial(_want, reader, plan))
                return blocks.get(start, stop)
        except FileChanged:
            self._on_changed(version)
            raise

    async def reader(self, version: Version) -> Reader:
        """Return the version's reader, opening it if need be; it is good until the caller awaits again.

        Raises:
            FileChanged: the file is smaller now. Else as RemoteStore.open_reader.
        """
        for _ in range(MAX_RESTARTS):
            version.require_alive()
            if version.reader is not None:
                return version.reader
            await self._opening.run(version, partial(self._open, version, version.size))
        raise DataUnproven(f"{version.path!r} is doubted again and again")

    async def _open(self, version: Version, expected: int | None) -> Reader:
        async with self.paths.steady(lambda: version.path) as path:
            version.require_alive()
            version.close_reader()
            version.blocks.begin_reading()
            reader = await self._store.open_reader(path, version.blocks, expected_size=expected)
        if version.handles == 0:
            reader.close()
            raise LocalProtocolError(f"{version.path!r} was closed while it was read")
        if reader.size < version.size:
            reader.close()
            self._on_changed(version)
            version.require_alive()
        version.reader = reader
        return reader

    async def reopen(self, version: Version) -> Reader:
        """Have the server open a version's file anew.

        Raises:
            As `reader`.
        """
        return await self._opening.run(version, partial(self._open, version, None))

    async def prove(self, version: Version) -> bool:
        """Return whether what was given out and is held of a version is what the vehicle holds.

        Raises:
            As `fetch`.
        """
        return version.blocks.intact and await self._settle(version) and version.blocks.intact

    async def _settle(self, version: Version) -> bool:
        """Return True if every byte held is proven now, False if provisional ones were dropped."""
        return await self._settling.run(version, partial(self._settle_once, version))

    async def _settle_once(self, version: Version) -> bool:
        boot, intact = version.boot, version.blocks.intact
        if await self._agrees(version):
            if intact and version.blocks.intact:
                version.proven_boot = boot
            version.close_reader()  # it may be under suspicion by now; nobody waits on it, all is held
            version.blocks.accept()
            version.proven_at = self._cache.clock()
            return True
        version.close_reader()
        version.blocks.drop_unproven()
        self.on_distrust(version)
        return False

    async def _agrees(self, version: Version) -> bool:
        """Return whether the vehicle's size and CRC32 are those of the bytes held, fetching the rest."""
        if not self._affordable(version):
            return False
        try:
            remote = await self._store.crc32(version.path)
        except (Armed, FtpNak, RemoteProtocolError):
            return False
        except RequestTimeout:
            if not version.recheck:
                raise
            return False  # after a restart nothing else can prove it, and asking takes minutes
        async with version.blocks.held(0, version.size):
            while version.blocks.missing(0, version.size):
                reader = await self.reader(version)
                await version.blocks.fill(0, version.size, partial(_want, reader, NOTHING))
            fresh = await self.reopen(version)
            return fresh.size == version.size and remote == await version.blocks.crc32()

    def _affordable(self, version: Version) -> bool:
        """Return whether fetching the rest of the file fits the cache and somebody's patience."""
        if version.size > self._cache.provable:
            return False
        rate = self._cache.meter.rate
        lacking = sum(stop - start for start, stop in version.blocks.missing(0, version.size))
        return rate is None or lacking <= rate * PROVE_SECONDS


def _want(reader: Reader, plan: Plan, gaps: Gaps) -> None:
    for start, stop in gaps:
        reader.want(start, stop, demand=True)
    if plan.start < plan.stop:
        reader.want(plan.start, plan.stop, demand=False)


def became_another(size: int, mtime: int | None, entry: DirEntry) -> bool:
    """Return whether a newer listing contradicts what is known of a file (a larger one only grew)."""
    if entry.size is None or entry.size > size:
        return False
    if entry.size < size:
        return True
    return entry.mtime is not None and mtime is not None and entry.mtime != mtime
