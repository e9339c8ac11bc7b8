"""Which blocks of files are kept on the local disk for the next mount, and when they are used. Layer: cache.

Off unless `cache_dir=` names a directory. What tells versions of a file apart:
- its size and mtime, where a listing tells an mtime of a clock that was set: blocks are then used without a
  request;
- else its size and CRC32: the vehicle is asked for it when blocks of that path and size are kept, only while
  it is disarmed, of files up to verify_max, and for at most CRC_LIMIT seconds. Only whole files are kept so.

Never kept: `@` files, a file that grows or was changed in the last minute, what was read within SETTLED
seconds, and anything after the vehicle restarted (it may be another one by then). The disk is only touched
in threads.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import trio

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.kept_disk import FileKey, Kept, KeptDisk
from mavftpfs.cache.versions import BLOCK_SIZE, Version
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.shared.model import DirEntry, is_virtual

log = logging.getLogger("mavftpfs.cache")

CLOCK_SET = 1_420_070_400
"""2015-01-01 UTC: an older mtime is that of a vehicle whose clock was not set."""

YOUNG = 60.0
"""Seconds after its mtime in which a file may change without its mtime changing (FAT: 2, clocks: more)."""

SETTLED = 12.0
"""Seconds after which bytes are beyond doubt: another client of the vehicle is noticed within 10."""

PERIOD = 4.0
"""Seconds between two looks at what may be kept."""

CRC_LIMIT = 10.0
"""Seconds to wait for a checksum that only saves reading the file."""


def vehicle_identity(uid: int, uid2: bytes, flight_sw_version: int, git_hash: bytes) -> bytes | None:
    """Return what tells this vehicle, with this firmware, from all others; None if it does not say."""
    if uid == 0 and not any(uid2):
        return None
    return repr((uid, uid2, flight_sw_version, git_hash)).encode()


def key_of(vehicle: bytes | None, path: bytes, entry: DirEntry, now: float) -> FileKey | None:
    """Return the key of a freshly listed file, None if nothing may be kept of it; its version is "" where
    only a CRC32 can tell. now: seconds since 1970."""
    if vehicle is None or not entry.size or is_virtual(path):
        return None
    if entry.mtime is not None and entry.mtime > now - YOUNG:
        return None
    dated = entry.mtime is not None and entry.mtime >= CLOCK_SET
    return FileKey(vehicle, path, entry.size, f"mtime {entry.mtime}" if dated else "")


class KeptCache:
    """Decides what goes to the disk and what comes from it."""

    def __init__(
        self,
        disk: KeptDisk,
        directories: Directories,
        *,
        identity: Callable[[], bytes | None],
        crc32: Callable[[bytes], Awaitable[int]],
        crc_limit: Callable[[], int],
        wall: Callable[[], float] = time.time,
        run: Callable[..., Awaitable[Any]] = trio.to_thread.run_sync,
    ) -> None:
        """`identity`: which vehicle it is, None if unknown. `crc32` asks it for one; `crc_limit`: the largest
        file for which it may be asked now. `wall`: seconds since 1970. `run` calls a thread."""
        self._disk = disk
        self._directories = directories
        self._identity = identity
        self._crc32 = crc32
        self._crc_limit = crc_limit
        self._wall = wall
        self._run = run
        self._watched: dict[Version, Kept] = {}
        self._crc_silent = False
        self._broken = False
        self.written = 0

    def status(self) -> dict[str, object]:
        """Return counters."""
        return {"blocks_to_disk": self.written}

    # --- from the disk

    async def find(self, path: bytes, entry: DirEntry) -> Kept | None:
        """Return what is kept of a freshly listed file, None if its beginning is not, or may be another's."""
        key = self._key(path, entry)
        if key is not None and not key.version:
            key = await self._with_crc32(key)
        if key is None or await self._run(self._disk.read, key.block(*_extent(key.size, 0))) is None:
            return None
        if self._directories.entry(path) is not entry:
            return None  # listed anew, or changed by us, meanwhile
        return Kept(key)

    async def fill(self, version: Version, start: int, stop: int) -> None:
        """Add the blocks of [start, stop) that are lacking and on the disk."""
        kept = version.kept
        if kept is None or not kept.key.version:
            return
        for index in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)):
            first, last = _extent(version.size, index)
            if version.missing(max(start, first), min(stop, last)):
                data = await self._run(self._disk.read, kept.key.block(first, last))
                if version.kept is not kept:
                    return
                if data is not None:
                    version.preload(first, data)
                    kept.done.add(index)

    def _key(self, path: bytes, entry: DirEntry) -> FileKey | None:
        """Return the key of a freshly listed file, None if nothing of it may be kept or used now."""
        if self._directories.is_growing(path):
            return None
        key = key_of(self._identity(), path, entry, self._wall())
        return None if key is None or (not key.version and key.size > self._crc_limit()) else key

    async def _with_crc32(self, key: FileKey) -> FileKey | None:
        """Return the key of the file with the CRC32 that the vehicle has; asks only if one of it is kept."""
        if self._crc_silent or await self._run(self._disk.read, key.block(0, 0)) is None:
            return None
        with trio.move_on_after(CRC_LIMIT) as scope:
            try:
                return _of_crc32(key, await self._crc32(key.path))
            except MavftpfsError:  # without one all is read
                return None
        self._crc_silent = scope.cancelled_caught
        return None

    # --- to the disk

    def keep(self, version: Version, entry: DirEntry) -> None:
        """A version was opened that a fresh listing shows as `entry`: what is read of it may be kept, unless
        it was listed anew, or changed by us, while it was opened."""
        if entry.size == version.size and self._directories.entry(version.path) is entry:
            key = self._key(version.path, entry)
            version.kept = None if key is None else Kept(key)

    def watch(self, version: Version) -> None:
        """A version is open, perhaps again: more of it may be read."""
        if version.kept is not None:
            self._watched[version] = version.kept

    async def run(self) -> None:
        """Keep what may be kept, until cancelled."""
        await self._run(self._disk.shrink)
        while not self._broken:
            await trio.sleep(PERIOD)
            for version, kept in list(self._watched.items()):
                if version.kept is not kept or not self._may_keep(version, kept.key):
                    del self._watched[version]
                    version.kept = None
                    continue
                await self._write_ripe(version, kept)
                if not version.handles and kept.done.issuperset(kept.arrived):
                    self._watched.pop(version, None)

    def _may_keep(self, version: Version, key: FileKey) -> bool:
        """Return whether a version is still, for all we know, what its key says."""
        if version.path != key.path or self._identity() != key.vehicle:
            return False
        if self._directories.is_growing(key.path):
            return False
        listed = self._directories.entry(key.path)
        return listed is None or (listed.size, listed.mtime) == (key.size, version.mtime)

    async def _write_ripe(self, version: Version, kept: Kept) -> None:
        """Write blocks that are not on the disk and were held whole for SETTLED seconds."""
        now = self._directories.clock()
        extents = [_extent(version.size, index) for index in range(-(-version.size // BLOCK_SIZE))]
        whole = [i for i, extent in enumerate(extents) if i in version and not version.missing(*extent)]
        kept.arrived = {index: kept.arrived.get(index, now) for index in whole if index not in kept.done}
        ripe = [index for index, at in kept.arrived.items() if now - at >= SETTLED]
        if version.mtime is not None and not version.compared:
            return
        if not kept.key.version:
            if len(ripe) == len(extents):
                await self._write_whole(version, kept.key, extents)
            return
        drops = version.drops
        for index in ripe:
            data = version.get(*extents[index])
            if data is None or version.kept is not kept or version.drops != drops:
                return  # it is in doubt, or another file, by now
            if not await self._to_disk(kept.key.block(*extents[index]), bytes(data)):
                return
            kept.done.add(index)

    async def _write_whole(self, version: Version, key: FileKey, extents: list[tuple[int, int]]) -> None:
        """Write a file that only its CRC32 tells from others, and that there is one of that path and size."""
        version.kept = None  # this was all
        parts, value = [bytes(version.get(*extent) or b"") for extent in extents], 0xFFFFFFFF
        for part in parts:
            value = zlib.crc32(part, value)
        known = _of_crc32(key, value ^ 0xFFFFFFFF)
        for extent, part in zip(extents, parts, strict=True):
            if not await self._to_disk(known.block(*extent), part):
                return
        await self._to_disk(key.block(0, 0), b"")

    async def _to_disk(self, name: str, data: bytes) -> bool:
        try:
            await self._run(self._disk.write, name, data)
        except OSError as error:
            if not self._broken:
                log.warning("nothing more is kept in cache_dir: %s", error)
            self._broken = True
            return False
        self.written += bool(data)
        return True


def _extent(size: int, index: int) -> tuple[int, int]:
    return index * BLOCK_SIZE, min((index + 1) * BLOCK_SIZE, size)


def _of_crc32(key: FileKey, crc32: int) -> FileKey:
    """Return the key of the file of this CRC32 (start value 0, no final xor)."""
    return replace(key, version=f"crc32 {crc32:08x}")
