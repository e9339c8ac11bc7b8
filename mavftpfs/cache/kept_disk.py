"""Blocks of files in a directory of the local disk. Layer: cache; blocks the caller: run it in threads.

A block is named by a digest of everything that decides whose bytes it holds: the vehicle, the path, the
size, what tells its versions apart (`FileKey.version`) and the block's place. The name is part of its
checksum. So a block of another version is never found, one under a wrong name counts as damaged, and two
mounts that write the same block write the same bytes.

Every block is a file of its own that appears whole under its name or not at all (rename). So several mounts,
of the same vehicle too, share a directory without locks, and a crash leaves at worst a temporary file that a
later `shrink` removes.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import struct
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from mavftpfs.shared.private import open_private

MAGIC = b"mavftpfs block 2\n"
DIGEST_SIZE = 16
NAME = "mavftpfs-blocks"
PRIVATE = 0o700
ABANDONED = 3600.0
"""Seconds after which a temporary file belongs to no writer any more."""

_TEMPORARY = ".new-"
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class FileKey:
    """One version of one file of one vehicle. version: what tells it from others of the same size."""

    vehicle: bytes
    path: bytes
    size: int
    version: str

    def block(self, start: int, stop: int) -> BlockKey:
        """Return the key of a block, whatever size blocks have in this version of the program."""
        parts = (self.vehicle, self.path, str((self.size, self.version, start, stop)).encode())
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


@dataclass(frozen=True, slots=True)
class Stored:
    """A file of the directory. used: seconds since 1970 of its last use."""

    name: str
    size: int
    used: float


class KeptDisk:
    """A directory of our own (0700) in `parent`, made if need be, that holds at most about `budget` bytes.

    Raises:
        OSError: it cannot be made, or is somebody else's.
    """

    def __init__(self, parent: Path, budget: int) -> None:
        parent.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
        self._path = parent / NAME
        self._path.mkdir(mode=PRIVATE, exist_ok=True)
        facts = self._path.lstat()
        if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.getuid():
            raise PermissionError(errno.EPERM, "the directory in it is somebody else's", str(self._path))
        self._path.chmod(PRIVATE)
        self._budget = budget
        self._numbers = count()
        self._until_shrink = 0

    def read(self, key: BlockKey) -> bytes | None:
        """Return a block; None if it is not there. A damaged block is removed."""
        path = self._place(key)
        try:
            stored = path.read_bytes()
        except OSError:
            return None
        data = key.unpack(stored)
        with suppress(OSError):
            path.unlink() if data is None else os.utime(path)
        return data

    def write(self, key: BlockKey, data: bytes) -> None:
        """Keep a block.

        Raises:
            OSError: there is no room, or the directory is gone.
        """
        path = self._place(key)
        path.parent.mkdir(mode=PRIVATE, exist_ok=True)
        temporary = path.parent / f"{_TEMPORARY}{os.getpid()}-{next(self._numbers)}"
        packed = key.pack(data)
        try:
            with open(temporary, "wb", opener=open_private) as file:
                file.write(packed)
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
        self._until_shrink -= len(packed)
        if self._until_shrink <= 0:
            self.shrink()

    def shrink(self) -> None:
        """Remove what was not used for longest until the rest fits, and what crashed writers left."""
        self._until_shrink = self._budget // 16
        now = time.time()
        files = list(self._stored())
        doomed = [file for file in files if _TEMPORARY in file.name and file.used < now - ABANDONED]
        doomed += surplus((file for file in files if _TEMPORARY not in file.name), self._budget)
        for file in doomed:
            with suppress(OSError):  # another mount was faster
                (self._path / file.name).unlink()

    def _place(self, key: BlockKey) -> Path:
        return self._path / key.name[:2] / key.name

    def _stored(self) -> Iterator[Stored]:
        for folder in self._path.glob("[0-9a-f][0-9a-f]"):
            with suppress(OSError), os.scandir(folder) as entries:
                for entry in entries:
                    with suppress(OSError):
                        facts = entry.stat(follow_symlinks=False)
                        yield Stored(f"{folder.name}/{entry.name}", facts.st_size, facts.st_mtime)


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
