"""Keeps what was read of files for the next mount, and serves it then. Layer: cache; see `persistent`.

Off unless `cache_dir=` names a directory. A file is served from it without a request where a fresh listing
shows the very size and mtime; where mtimes tell nothing, after one checksum request, if checksums may be
asked and every byte of it is there. Bytes go to the disk when they have been beyond suspicion for a while,
never of a file that grows or was seen to change, never after the vehicle restarted (it may be another one by
then). The disk is only touched in threads.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

import trio

from mavftpfs.cache.blockdirectory import BlockDirectory
from mavftpfs.cache.blocks import BLOCK_SIZE, BlockCache, FileBlocks
from mavftpfs.cache.kept import InThread, Kept, extent, in_thread
from mavftpfs.cache.persistent import key_of, trusted
from mavftpfs.cache.reopens import is_unsettled
from mavftpfs.cache.versions import Version
from mavftpfs.shared.errors import Armed, FtpNak, RemoteProtocolError, RequestTimeout, VehicleLost
from mavftpfs.shared.model import DirEntry

log = logging.getLogger("mavftpfs.cache")

PERIOD = 4.0
"""Seconds between two looks at what may be kept."""

BLOCKS_PER_LOOK = 256
CRC_LIMIT = 10.0
"""Seconds to wait for a checksum that only saves reading the file."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What the keeper asks about the vehicle; nothing here costs a request but crc32.

    identity: which vehicle it is, None if unknown. remembered: the listed entry of a path, if there is one.
    growing: whether somebody seems to write the file. crc32: asks the vehicle; crc_limit: largest file whose
    checksum may be asked for now. wall: seconds since 1970.
    """

    identity: Callable[[], bytes | None]
    remembered: Callable[[bytes], DirEntry | None]
    growing: Callable[[bytes], bool]
    crc32: Callable[[bytes], Awaitable[int]]
    crc_limit: Callable[[], int]
    wall: Callable[[], float]


class Keeper:
    """Decides what goes to the disk and what comes from it."""

    def __init__(
        self, directory: BlockDirectory, cache: BlockCache, facts: Facts, *, run: InThread = in_thread
    ) -> None:
        """`run` calls something that blocks, in a thread."""
        self._directory = directory
        self._cache = cache
        self._facts = facts
        self._run = run
        self._watched: dict[Version, Kept] = {}
        self._crc_silent = False
        self._broken = False
        self.revived = 0
        self.written = 0

    def status(self) -> dict[str, object]:
        """Return counters."""
        return {"files_from_disk": self.revived, "blocks_to_disk": self.written, "disk_failed": self._broken}

    # --- from the disk

    async def revive(self, path: bytes, entry: DirEntry, listed_at: float) -> Version | None:
        """Return a version of a freshly listed file whose beginning is on the disk, None if it is not."""
        kept = self._kept(path, entry)
        first = None if kept is None else await kept.load(0)
        if kept is None or first is None:
            return None
        blocks = FileBlocks(self._cache, kept.key.size)
        proven_at = listed_at
        if kept.key.mtime is None:
            proven_at = self._cache.clock()
            if not await self._load_proven(kept, blocks, first):
                return None
        else:
            kept.give(blocks, 0, first)
        if self._facts.remembered(path) is not entry:
            blocks.clear()
            return None  # listed anew, or changed by us, while the disk was read
        self.revived += 1
        version = Version(path, kept.key.mtime, blocks, proven_at, sure=True, kept=kept)
        self._watched[version] = kept
        return version

    async def _load_proven(self, kept: Kept, blocks: FileBlocks, first: bytes) -> bool:
        """Load all of a file if the vehicle's checksum is that of it."""
        size = kept.key.size
        if self._crc_silent or size > self._cache.provable:
            return False
        parts = [first]
        for index in range(1, -(-size // BLOCK_SIZE)):
            data = await kept.load(index)
            if data is None:
                return False
            parts.append(data)
        value = 0xFFFFFFFF
        for part in parts:
            value = zlib.crc32(part, value)
        if await self._ask_crc32(kept.key.path) != value ^ 0xFFFFFFFF:
            return False
        for index, data in enumerate(parts):
            kept.give(blocks, index, data)
        return True

    async def _ask_crc32(self, path: bytes) -> int | None:
        with trio.move_on_after(CRC_LIMIT) as scope:
            try:
                return await self._facts.crc32(path)
            except (Armed, FtpNak, RemoteProtocolError, RequestTimeout, VehicleLost):
                return None
        self._crc_silent = scope.cancelled_caught
        return None

    def _kept(self, path: bytes, entry: DirEntry) -> Kept | None:
        if self._facts.growing(path):
            return None
        key = key_of(self._facts.identity(), path, entry, self._facts.wall())
        if key is None or (key.mtime is None and key.size > self._facts.crc_limit()):
            return None
        return Kept(key, self._directory, self._run)

    # --- to the disk

    def keep(self, version: Version, entry: DirEntry) -> None:
        """A version was opened that a fresh listing shows as `entry`: what is read of it may be kept, unless
        it was listed anew, or changed by us, while it was opened."""
        if entry.size == version.size and self._facts.remembered(version.path) is entry:
            version.kept = self._kept(version.path, entry)
            self.watch(version)

    def watch(self, version: Version) -> None:
        """A version is open, perhaps again: more of it may be read."""
        if version.kept is not None:
            self._watched[version] = version.kept

    async def run(self) -> None:
        """Keep what may be kept, until cancelled."""
        await self._run(self._directory.shrink)
        while not self._broken:
            await trio.sleep(PERIOD)
            await self.look()

    async def look(self) -> None:
        """Write what is beyond suspicion by now."""
        left = BLOCKS_PER_LOOK
        for version, kept in list(self._watched.items()):
            if not self._worth(version, kept):
                del self._watched[version]
                version.kept = None
                continue
            ripe = kept.settling.ripe(_whole(version.blocks), self._cache.clock())
            for index in ripe[:left]:
                left -= 1
                await self._write(version, kept, index)
            if not version.handles and not kept.settling.waiting:
                self._watched.pop(version, None)

    def _worth(self, version: Version, kept: Kept) -> bool:
        """Return whether a version is still, for all we know, what its key says."""
        key, listed = kept.key, self._facts.remembered(version.path)
        if version.dead is not None or version.boot or version.path != key.path:
            return False
        if self._facts.identity() != key.vehicle or self._facts.growing(key.path):
            return False
        return listed is None or (listed.size, trusted(listed.mtime)) == (key.size, key.mtime)

    async def _write(self, version: Version, kept: Kept, index: int) -> None:
        data = version.blocks.get(*extent(kept.key.size, index))  # never provisional
        if data is None or version.dead is not None or is_unsettled(version) or self._broken:
            return
        try:
            await self._run(partial(self._directory.write, kept.block(index), bytes(data)))
        except OSError as error:
            self._broken = True
            log.warning("nothing more is kept in cache_dir: %s", error)
            return
        kept.settling.on_kept(index)
        self.written += 1


def _whole(blocks: FileBlocks) -> list[int]:
    """Return the blocks that are held from end to end."""
    indices = range(-(-blocks.size // BLOCK_SIZE))
    return [i for i in indices if i in blocks and not blocks.missing(*extent(blocks.size, i))]
