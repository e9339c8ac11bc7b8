"""Which blocks of files are kept on the local disk for the next mount, and when they are used. Layer: cache.

Off unless `cache_dir=` names a directory. What tells versions of a file apart:
- its size and mtime, where a listing tells an mtime of a clock that was set: blocks are then used without a
  request;
- else its size and CRC32: the vehicle is asked for it when blocks of that path and size are kept, only while
  it is disarmed, of files up to verify_max, and for at most CRC_LIMIT seconds. Only whole files are kept so.

Never kept: `@` files, a file that grows or was changed in the last minute, what was read within SETTLED
seconds, and anything after the vehicle restarted (it may be another one by then). Every SETTLED seconds all
blocks in memory are looked at, and those that were there the last time go to the disk. The disk is only
touched in threads.
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
from mavftpfs.cache.versions import BLOCK_SIZE, NEVER, BlockCache, Version
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.shared.model import DirEntry, is_virtual

log = logging.getLogger("mavftpfs.cache")

CLOCK_SET = 1_420_070_400
"""2015-01-01 UTC: an older mtime is that of a vehicle whose clock was not set."""

YOUNG = 60.0
"""Seconds after its mtime in which a file may change without its mtime changing (FAT: 2, clocks: more)."""

SETTLED = 12.0
"""Seconds after which bytes are beyond doubt: another client of the vehicle is noticed within 10."""

CRC_LIMIT = 10.0
"""Seconds to wait for a checksum that only saves reading the file."""

CRC_PAUSE = 600.0
"""Seconds for which none is asked for after one that did not come."""


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
        blocks: BlockCache,
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
        self._blocks = blocks
        self._identity = identity
        self._crc32 = crc32
        self._crc_limit = crc_limit
        self._wall = wall
        self._run = run
        self._ask_after = NEVER
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
        clock = self._directories.clock
        if clock() < self._ask_after or await self._run(self._disk.read, key.block(0, 0)) is None:
            return None
        with trio.move_on_after(CRC_LIMIT) as scope:
            try:
                return _of_crc32(key, await self._crc32(key.path))
            except MavftpfsError:  # without one all is read
                return None
        if scope.cancelled_caught:
            self._ask_after = clock() + CRC_PAUSE
        return None

    # --- to the disk

    def keep(self, version: Version, entry: DirEntry) -> None:
        """A version was opened that a fresh listing shows as `entry`: what is read of it may be kept, unless
        it was listed anew, or changed by us, while it was opened."""
        if entry.size == version.size and self._directories.entry(version.path) is entry:
            key = self._key(version.path, entry)
            version.kept = None if key is None else Kept(key)

    async def run(self) -> None:
        """Keep what may be kept, until cancelled, or until the disk takes no more."""
        await self._run(self._disk.shrink)
        seen: dict[Version, dict[int, bytearray]] = {}
        try:
            while True:
                await trio.sleep(SETTLED)
                before, seen = seen, self._held()
                for version, held in seen.items():
                    known = before.get(version, {})
                    await self._write(version, {i: b for i, b in held.items() if known.get(i) is b})
        except OSError as error:
            log.warning("nothing more is kept in cache_dir: %s", error)

    def _held(self) -> dict[Version, dict[int, bytearray]]:
        """Return the blocks that are whole and not on the disk, of files that may be kept."""
        held: dict[Version, dict[int, bytearray]] = {}
        for version, index in self._blocks.used:
            block = version.block(index)
            if block is None or version.kept is None or index in version.kept.done:
                continue
            if not version.missing(*_extent(version.size, index)):
                held.setdefault(version, {})[index] = block
        return held

    def _may_keep(self, version: Version, key: FileKey) -> bool:
        """Return whether a version is still, for all we know, what its key says."""
        if version.path != key.path or self._identity() != key.vehicle:
            return False
        if self._directories.is_growing(key.path):
            return False
        listed = self._directories.entry(key.path)
        return listed is None or (listed.size, listed.mtime) == (key.size, version.mtime)

    async def _write(self, version: Version, ripe: dict[int, bytearray]) -> None:
        """Write blocks that were held whole for SETTLED seconds.

        Raises:
            OSError: the disk does not take them.
        """
        kept = version.kept
        if kept is None or not self._may_keep(version, kept.key):
            version.kept = None
            return
        if version.mtime is not None and not version.compared:
            return
        if not kept.key.version:
            if sum(map(len, ripe.values())) < version.size:
                return
            value = 0xFFFFFFFF
            for index in sorted(ripe):
                value = zlib.crc32(ripe[index], value)
            marker = kept.key.block(0, 0)  # it is worth asking for the checksum of this path and size
            version.kept = kept = Kept(_of_crc32(kept.key, value ^ 0xFFFFFFFF))
            await self._run(self._disk.write, marker, b"")
        for index, block in ripe.items():
            if version.kept is not kept or version.block(index) is not block:
                return  # it is in doubt, or another file, by now
            await self._run(self._disk.write, kept.key.block(*_extent(version.size, index)), bytes(block))
            kept.done.add(index)
            self.written += 1


def _extent(size: int, index: int) -> tuple[int, int]:
    return index * BLOCK_SIZE, min((index + 1) * BLOCK_SIZE, size)


def _of_crc32(key: FileKey, crc32: int) -> FileKey:
    """Return the key of the file of this CRC32 (start value 0, no final xor)."""
    return replace(key, version=f"crc32 {crc32:08x}")
