"""Which blocks of files are kept on the local disk for the next mount, and when they are used. Layer: cache.

Off unless `cache_dir=` names a directory. There are two kinds of keys that tell versions of a file apart:
- its size and mtime, where a listing tells an mtime of a clock that was set. Blocks of such a key are used
  without a request.
- its size and CRC32. Only whole files have such a key, and the CRC32 is computed here. Before their blocks
  are used the vehicle is asked for the CRC32 of its file: only where one of that path and size is kept, while
  it is disarmed, of files up to verify_max, and for at most CRC_LIMIT seconds.

Every SETTLED seconds all blocks in memory are looked at, and those that were there the last time go to the
disk: bytes that were read lately may yet turn out to be another file's. At a clean unmount files that are
here whole are kept even if they were read lately, by their CRC32: if the bytes are another file's, the
vehicle's CRC32 will not agree.

Never kept: `@` files, a file that grows or was changed in the last minute, and anything after the vehicle
restarted (it may be another one by then). The disk is only touched in threads.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import Any

import trio

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.kept_disk import FileKey, Kept, KeptDisk
from mavftpfs.cache.versions import BLOCK_SIZE, NEVER, BlockCache, Version
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.shared.model import DirEntry, is_virtual
from mavftpfs.shared.sameness import Listed, Sameness, compare

log = logging.getLogger("mavftpfs.cache")

CLOCK_SET = 1_420_070_400
"""2015-01-01 UTC: an older mtime is that of a vehicle whose clock was not set."""

_DATED = "mtime "

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
    return FileKey(vehicle, path, entry.size, _DATED + str(entry.mtime) if dated else "")


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
        self._takes_more = True
        self.written = 0

    def status(self) -> dict[str, object]:
        """Return counters."""
        return {"blocks_to_disk": self.written}

    # --- from the disk

    async def find(self, path: bytes, entry: DirEntry) -> Kept | None:
        """Return what is kept of a freshly listed file; None if its first block is not kept, or may be
        another file's."""
        key = self._key(path, entry)
        if key is not None and not (_is_dated(key) and await self._begins(key)):
            key = await self._with_crc32(key)
            if key is not None and not await self._begins(key):
                return None
        if key is None or self._directories.entry(path) is not entry:
            return None  # or it was listed anew, or changed by us, meanwhile
        return Kept(key)

    async def forget(self, path: bytes, entry: DirEntry) -> None:
        """Another file, listed as `entry`, is about to get this path: what is kept of one of the same path,
        size and time would pass for it."""
        key = key_of(self._identity(), path, entry, self._wall())
        if key is not None and _is_dated(key):
            indices = range(-(-key.size // BLOCK_SIZE))
            await self._run(self._disk.remove, [key.block(*_extent(key.size, index)) for index in indices])

    async def _begins(self, key: FileKey) -> bool:
        """Return whether the first block of a file is kept."""
        return await self._run(self._disk.read, key.block(*_extent(key.size, 0))) is not None

    async def fill(self, version: Version, start: int, stop: int) -> None:
        """Add the blocks of [start, stop) that the version lacks and the disk has."""
        kept = version.kept
        if kept is None or not kept.key.version:
            return
        for index in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)):
            begin, end = _extent(version.size, index)
            if version.missing(max(start, begin), min(stop, end)):
                data = await self._run(self._disk.read, kept.key.block(begin, end))
                if version.kept is not kept:
                    return
                if data is not None:
                    version.preload(begin, data)
                    kept.on_disk.add(index)

    def _key(self, path: bytes, entry: DirEntry) -> FileKey | None:
        """Return the key of a freshly listed file, None if nothing of it may be kept or used now."""
        if self._directories.is_growing(path):
            return None
        key = key_of(self._identity(), path, entry, self._wall())
        return None if key is None or (not key.version and key.size > self._crc_limit()) else key

    async def _with_crc32(self, key: FileKey) -> FileKey | None:
        """Return the key of the file with the CRC32 that the vehicle has; asks only if one of it is kept."""
        clock = self._directories.clock
        if clock() < self._ask_after or key.size > self._crc_limit():
            return None
        if await self._run(self._disk.read, _marker(key)) is None:
            return None
        with trio.move_on_after(CRC_LIMIT) as scope:
            try:
                self._directories.require_heard()
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
        while self._takes_more:
            await trio.sleep(SETTLED)
            before, seen = seen, self._in_memory()
            for version, here in seen.items():
                known = before.get(version, {})
                await self._keep(version, {i: b for i, b in here.items() if known.get(i) is b})

    async def keep_whole_files(self) -> None:
        """Keep the files that were read whole, even those read lately, because the mount ends."""
        for version in self._in_memory():
            if version.whole and version.size <= self._crc_limit():
                await self._keep(version, version.blocks(), by_crc32=True)

    def _in_memory(self) -> dict[Version, dict[int, bytearray]]:
        """Return the blocks that are whole and not on the disk, of files that may be kept."""
        here: dict[Version, dict[int, bytearray]] = {}
        for version, index in self._blocks.used:
            block = version.block(index)
            if block is None or version.kept is None or index in version.kept.on_disk:
                continue
            if not version.missing(*_extent(version.size, index)):
                here.setdefault(version, {})[index] = block
        return here

    def _may_keep(self, version: Version, key: FileKey) -> bool:
        """Return whether a version is still, for all we know, what its key says."""
        if version.path != key.path or self._identity() != key.vehicle:
            return False
        if self._directories.is_growing(key.path):
            return False
        listed = self._directories.entry(key.path)
        return listed is None or compare(version.known, Listed(listed)) is Sameness.SAME

    async def _keep(self, version: Version, blocks: dict[int, bytearray], *, by_crc32: bool = False) -> None:
        """Write whole blocks of a version. by_crc32: all of its blocks, under its CRC32 only."""
        kept = version.kept
        if kept is None or not self._may_keep(version, kept.key):
            version.kept = None
            return
        key = kept.key
        if _is_dated(key) and not by_crc32:
            if not version.current:
                return
        elif sum(map(len, blocks.values())) < version.size:
            return
        else:
            key = _of_crc32(key, _crc32(blocks))
        try:
            if not _is_dated(key):
                await self._run(self._disk.write, _marker(key), b"")
            await self._write(version, kept, key, blocks)
        except OSError as error:
            if self._takes_more:
                log.warning("nothing more is kept in cache_dir: %s", error)
            self._takes_more = False

    async def _write(self, version: Version, kept: Kept, key: FileKey, blocks: dict[int, bytearray]) -> None:
        """Write blocks under a key, while they are not in doubt.

        Raises:
            OSError: the disk does not take them.
        """
        for index, block in blocks.items():
            if version.kept is not kept or version.block(index) is not block:
                return  # it is in doubt, or another file, by now
            await self._run(self._disk.write, key.block(*_extent(version.size, index)), bytes(block))
            kept.on_disk.add(index)
            self.written += 1
        if not _is_dated(kept.key):
            kept.key = key


def _extent(size: int, index: int) -> tuple[int, int]:
    return index * BLOCK_SIZE, min((index + 1) * BLOCK_SIZE, size)


def _is_dated(key: FileKey) -> bool:
    return key.version.startswith(_DATED)


def _marker(key: FileKey) -> str:
    """Return the name of the empty block that says: something of this path and size is kept by its CRC32."""
    return replace(key, version="").block(0, 0)


def _crc32(blocks: Mapping[int, bytearray]) -> int:
    """Return the CRC32 of a whole file, as the vehicle computes it: start value 0, no final xor."""
    value = 0
    for index in sorted(blocks):
        value = crc32(blocks[index], value)
    return value


def _of_crc32(key: FileKey, crc32: int) -> FileKey:
    """Return the key of the file with this CRC32."""
    return replace(key, version=f"crc32 {crc32:08x}")
