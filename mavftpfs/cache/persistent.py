"""What is kept of the vehicle's files from one mount to the next, and when it may be believed. Layer: cache;
pure: disk and time belong to `blockdirectory` and `keeper`.

A block on the disk is named by a digest of everything that decides whose bytes it holds: the vehicle, the
path, the size, the mtime and the block's place; the same digest is part of its checksum. So a block of
another version is never found, one that lies under a wrong name is as good as damaged, and two mounts that
write the same block write the same bytes.

Believed by size and mtime alone are only mtimes that tell versions apart: a vehicle without a clock stamps
all it writes with the same second, and within the last minute a file may be written again in the same tick.
What has no such mtime is believed after the vehicle's CRC32 agreed (`Files` asks for it).
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable
from dataclasses import dataclass

from mavftpfs.shared.model import DirEntry, is_virtual

MAGIC = b"mavftpfs block 1\n"
DIGEST_SIZE = 16

CLOCK_SET = 1_420_070_400
"""2015-01-01 UTC: an older mtime is that of a vehicle whose clock was not set."""

YOUNG = 60.0
"""Seconds after its mtime in which a file may change without its mtime changing (FAT: 2, clocks: more)."""

SETTLED = 12.0
"""Seconds after which bytes are beyond suspicion: another client of the vehicle is noticed within 10
(session.suspicion.SUSPECT_WITHIN)."""

_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class FileKey:
    """One version of one file of one vehicle. mtime: None where it tells nothing."""

    vehicle: bytes
    path: bytes
    size: int
    mtime: int | None

    def block(self, start: int, stop: int) -> BlockKey:
        """Return the key of a block, whatever size blocks have in this version of the program."""
        parts = (self.vehicle, self.path, str((self.size, self.mtime, start, stop)).encode())
        digest = hashlib.blake2b(digest_size=DIGEST_SIZE)
        for part in parts:
            digest.update(_LENGTH.pack(len(part)) + part)
        return BlockKey(digest.hexdigest(), stop - start)


@dataclass(frozen=True, slots=True)
class BlockKey:
    """name: the block's file name, which is unique to its content. size: its bytes."""

    name: str
    size: int

    def pack(self, data: bytes) -> bytes:
        """Return a block as it lies on the disk."""
        return MAGIC + self._checksum(data) + data

    def unpack(self, stored: bytes) -> bytes | None:
        """Return the block's bytes, None if what is stored is not exactly what was packed."""
        start = len(MAGIC) + DIGEST_SIZE
        data = stored[start:]
        if len(data) != self.size or stored[:start] != MAGIC + self._checksum(data):
            return None
        return data

    def _checksum(self, data: bytes) -> bytes:
        return hashlib.blake2b(data, digest_size=DIGEST_SIZE, key=self.name.encode()).digest()


def vehicle_identity(uid: int, uid2: bytes, flight_sw_version: int, git_hash: bytes) -> bytes | None:
    """Return what tells this vehicle, with this firmware, from all others; None if it does not say."""
    if uid == 0 and not any(uid2):
        return None
    return repr((uid, uid2, flight_sw_version, git_hash)).encode()


def key_of(vehicle: bytes | None, path: bytes, entry: DirEntry, now: float) -> FileKey | None:
    """Return the key of a freshly listed file, None if nothing may be kept of it. now: seconds since 1970."""
    if vehicle is None or not entry.size or is_virtual(path):
        return None
    if entry.mtime is not None and entry.mtime > now - YOUNG:
        return None
    return FileKey(vehicle, path, entry.size, trusted(entry.mtime))


def trusted(mtime: int | None) -> int | None:
    """Return an mtime that tells versions apart, None for one that does not."""
    return None if mtime is None or mtime < CLOCK_SET else mtime


class Settling:
    """The blocks of one file that arrived, and when: they are kept once they are beyond suspicion."""

    def __init__(self) -> None:
        self._arrived: dict[int, float] = {}
        self._done: set[int] = set()

    def ripe(self, held: Iterable[int], now: float) -> list[int]:
        """Return which of the blocks held now were held SETTLED seconds ago, and were not returned before."""
        present = [index for index in held if index not in self._done]
        self._arrived = {index: self._arrived.get(index, now) for index in present}
        return [index for index in present if now - self._arrived[index] >= SETTLED]

    def on_kept(self, index: int) -> None:
        """A block is on the disk."""
        self._done.add(index)

    @property
    def waiting(self) -> bool:
        """Whether blocks were seen that are not kept yet."""
        return bool(self._arrived.keys() - self._done)


@dataclass(frozen=True, slots=True)
class Stored:
    """A file of the cache directory. used: seconds since 1970 of its last use."""

    name: str
    size: int
    used: float


def surplus(stored: Iterable[Stored], budget: int) -> list[Stored]:
    """Return the least recently used files that have to go for the rest to fit nine tenths of the budget;
    none while all of them fit it."""
    files = sorted(stored, key=lambda file: file.used)
    total = sum(file.size for file in files)
    if total <= budget:
        return []
    goal, doomed = budget * 9 // 10, []
    for file in files:
        if total <= goal:
            break
        doomed.append(file)
        total -= file.size
    return doomed
