"""Which blocks of files are kept on the local disk for the next mount, and when they are used. Layer: cache.

Off unless `cache_dir=` names a directory. What tells versions of a file apart (design D10):
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
import zlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, TypeVar

import trio

from mavftpfs.cache.blocks import BLOCK_SIZE, FileBlocks
from mavftpfs.cache.kept_disk import BlockKey, FileKey, KeptDisk
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    MavftpfsError,
    RemoteProtocolError,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.shared.model import DirEntry, is_virtual

T = TypeVar("T")
log = logging.getLogger("mavftpfs.cache")

CLOCK_SET = 1_420_070_400
"""2015-01-01 UTC: an older mtime is that of a vehicle whose clock was not set."""

YOUNG = 60.0
"""Seconds after its mtime in which a file may change without its mtime changing (FAT: 2, clocks: more)."""

SETTLED = 12.0
"""Seconds after which bytes are beyond doubt: another client of the vehicle is noticed within 10."""

PERIOD = 4.0
"""Seconds between two looks at what may be kept."""

BLOCKS_PER_LOOK = 256
CRC_LIMIT = 10.0
"""Seconds to wait for a checksum that only saves reading the file."""


class InThread(Protocol):
    """Calls something that blocks, elsewhere than on the event loop."""

    async def __call__(self, work: Callable[[], T], /) -> T: ...


async def in_thread(work: Callable[[], T], /) -> T:
    """Call it in a worker thread of trio's."""
    return await trio.to_thread.run_sync(work)


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


@dataclass(slots=True)
class Kept:
    """What the disk has, or will have, of one version.

    arrived: when each block that is not there yet was first seen whole. done: blocks that are on the disk.
    """

    key: FileKey
    disk: KeptDisk
    run: InThread
    arrived: dict[int, float] = field(default_factory=dict)
    done: set[int] = field(default_factory=set)

    async def fill(self, blocks: FileBlocks, start: int, stop: int, wanted: Callable[[], bool]) -> None:
        """Add the blocks of [start, stop) that are lacking and on the disk, while they are `wanted`."""
        if not self.key.version:
            return
        for index in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)):
            first, last = self._extent(index)
            if blocks.missing(max(start, first), min(stop, last)):
                data = await self.run(partial(self.disk.read, self.block(index)))
                if not wanted():
                    return
                if data is not None:
                    blocks.preload(first, data)
                    self.done.add(index)

    def block(self, index: int) -> BlockKey:
        """Return the key of a block."""
        return self.key.block(*self._extent(index))

    def ripe(self, blocks: FileBlocks, now: float) -> list[int]:
        """Return the blocks that are not on the disk and were held whole for SETTLED seconds."""
        whole = [index for index in range(self.count) if self._is_whole(blocks, index)]
        self.arrived = {index: self.arrived.get(index, now) for index in whole if index not in self.done}
        return [index for index, at in self.arrived.items() if now - at >= SETTLED]

    def data(self, blocks: FileBlocks, index: int) -> bytes:
        """Return the bytes of a block that is held whole."""
        held = blocks.get(*self._extent(index))
        assert held is not None
        return bytes(held)

    @property
    def count(self) -> int:
        """How many blocks the file has."""
        return -(-self.key.size // BLOCK_SIZE)

    def _is_whole(self, blocks: FileBlocks, index: int) -> bool:
        return index in blocks and not blocks.missing(*self._extent(index))

    def _extent(self, index: int) -> tuple[int, int]:
        start = index * BLOCK_SIZE
        return start, min(start + BLOCK_SIZE, self.key.size)


class Version(Protocol):
    """What is asked of versions.Version."""

    path: bytes
    mtime: int | None
    blocks: FileBlocks
    handles: int
    dead: MavftpfsError | None
    kept: Kept | None

    @property
    def size(self) -> int: ...
    @property
    def compared(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class Facts:
    """What is asked about the vehicle; nothing here costs a request but crc32.

    identity: which vehicle it is, None if unknown. remembered: the listed entry of a path, if there is one.
    growing: whether somebody seems to write the file. crc32: asks the vehicle; crc_limit: largest file whose
    checksum may be asked for now. wall: seconds since 1970; clock: seconds, monotonic.
    """

    identity: Callable[[], bytes | None]
    remembered: Callable[[bytes], DirEntry | None]
    growing: Callable[[bytes], bool]
    crc32: Callable[[bytes], Awaitable[int]]
    crc_limit: Callable[[], int]
    wall: Callable[[], float]
    clock: Callable[[], float]


class KeptCache:
    """Decides what goes to the disk and what comes from it."""

    def __init__(self, disk: KeptDisk, facts: Facts, *, run: InThread = in_thread) -> None:
        """`run` calls something that blocks, in a thread."""
        self._disk = disk
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

    async def find(self, path: bytes, entry: DirEntry) -> Kept | None:
        """Return what is kept of a freshly listed file, None if its beginning is not, or may be another's."""
        kept = self._kept(path, entry)
        if kept is not None and not kept.key.version:
            kept = await self._by_crc32(kept)
        if kept is None or await self._run(partial(self._disk.read, kept.block(0))) is None:
            return None
        if self._facts.remembered(path) is not entry:
            return None  # listed anew, or changed by us, meanwhile
        self.revived += 1
        return kept

    async def _by_crc32(self, kept: Kept) -> Kept | None:
        """Return what is kept of the file with the CRC32 that the vehicle has; asks only if there is any."""
        if self._crc_silent or await self._run(partial(self._disk.read, kept.key.block(0, 0))) is None:
            return None
        with trio.move_on_after(CRC_LIMIT) as scope:
            try:
                return _with_crc32(kept, await self._facts.crc32(kept.key.path))
            except (Armed, FtpNak, RemoteProtocolError, RequestTimeout, VehicleLost):
                return None
        self._crc_silent = scope.cancelled_caught
        return None

    def _kept(self, path: bytes, entry: DirEntry) -> Kept | None:
        if self._facts.growing(path):
            return None
        key = key_of(self._facts.identity(), path, entry, self._facts.wall())
        if key is None or (not key.version and key.size > self._facts.crc_limit()):
            return None
        return Kept(key, self._disk, self._run)

    # --- to the disk

    def keep(self, version: Version, entry: DirEntry) -> None:
        """A version was opened that a fresh listing shows as `entry`: what is read of it may be kept, unless
        it was listed anew, or changed by us, while it was opened."""
        if entry.size == version.size and self._facts.remembered(version.path) is entry:
            version.kept = self._kept(version.path, entry)

    def watch(self, version: Version) -> None:
        """A version is open, perhaps again: more of it may be read."""
        if version.kept is not None:
            self._watched[version] = version.kept

    async def run(self) -> None:
        """Keep what may be kept, until cancelled."""
        await self._run(self._disk.shrink)
        while not self._broken:
            await trio.sleep(PERIOD)
            await self.look()

    async def look(self) -> None:
        """Write what is beyond doubt by now."""
        left = BLOCKS_PER_LOOK
        for version, kept in list(self._watched.items()):
            if self._broken:
                return
            if not self._may_keep(version, kept):
                del self._watched[version]
                version.kept = None
                continue
            ripe = kept.ripe(version.blocks, self._facts.clock())
            if version.mtime is not None and not version.compared:
                continue
            if kept.key.version:
                left -= await self._write(version, kept, ripe[:left])
            elif len(ripe) == kept.count:
                left -= await self._write_whole(version, kept)
            if not version.handles and kept.done.issuperset(kept.arrived):
                self._watched.pop(version, None)

    def _may_keep(self, version: Version, kept: Kept) -> bool:
        """Return whether a version is still, for all we know, what its key says."""
        key, listed = kept.key, self._facts.remembered(version.path)
        if version.kept is not kept or version.path != key.path:
            return False
        if self._facts.identity() != key.vehicle or self._facts.growing(key.path):
            return False
        return listed is None or (listed.size, listed.mtime) == (key.size, version.mtime)

    async def _write(self, version: Version, kept: Kept, indices: list[int]) -> int:
        """Write blocks; return how many."""
        done = 0
        for index in indices:
            if version.dead is not None or index not in version.blocks:
                break
            data = kept.data(version.blocks, index)
            if not await self._to_disk(kept.block(index), data):
                break
            kept.done.add(index)
            done += 1
        return done

    async def _write_whole(self, version: Version, kept: Kept) -> int:
        """Write a file that only its CRC32 tells from others, and that there is one of that path and size."""
        parts = [kept.data(version.blocks, index) for index in range(kept.count)]
        value = 0xFFFFFFFF
        for part in parts:
            value = zlib.crc32(part, value)
        known = _with_crc32(kept, value ^ 0xFFFFFFFF)
        for index, data in enumerate(parts):
            if not await self._to_disk(known.block(index), data):
                return index
            kept.done.add(index)
        await self._to_disk(kept.key.block(0, 0), b"")
        return len(parts)

    async def _to_disk(self, key: BlockKey, data: bytes) -> bool:
        try:
            await self._run(partial(self._disk.write, key, data))
        except OSError as error:
            self._broken = True
            log.warning("nothing more is kept in cache_dir: %s", error)
            return False
        self.written += bool(data)
        return True


def _with_crc32(kept: Kept, crc32: int) -> Kept:
    """Return what is kept of the file of this CRC32 (start value 0, no final xor)."""
    return replace(kept, key=replace(kept.key, version=f"crc32 {crc32:08x}"), arrived={}, done=set())
