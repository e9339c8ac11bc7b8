"""Blocks of files in a directory of the local disk. Layer: cache; blocks the caller: run it in threads.

A block is named by a digest of everything that decides which bytes it has: the vehicle, the path, the size,
what tells versions of the file apart (`FileKey.version`) and the block's place. The name is part of its
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
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
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

    def block(self, start: int, stop: int) -> str:
        """Return the name of a block. Its extent is part of it, so a later program may use another block
        size."""
        digest = hashlib.blake2b(digest_size=DIGEST_SIZE)
        for part in (self.vehicle, self.path, str((self.size, self.version, start, stop)).encode()):
            digest.update(_LENGTH.pack(len(part)) + part)
        return digest.hexdigest()


@dataclass(slots=True)
class Kept:
    """The part of one version of a file that is on the disk, or will be. on_disk: the blocks that are
    there."""

    key: FileKey
    on_disk: set[int] = field(default_factory=set)


class KeptDisk:
    """A directory of our own (0700) in `parent`, made if need be, that holds at most about `budget` bytes.

    Raises:
        OSError: it cannot be made, or belongs to another user.
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

    def read(self, name: str) -> bytes | None:
        """Return a block; None if it is not there. A damaged block is removed."""
        path = self._path / name[:2] / name
        try:
            stored = path.read_bytes()
        except OSError:
            return None
        data = stored[len(MAGIC) + DIGEST_SIZE :]
        good = stored == _packed(name, data)
        with suppress(OSError):
            os.utime(path) if good else path.unlink()
        return data if good else None

    def write(self, name: str, data: bytes) -> None:
        """Keep a block.

        Raises:
            OSError: there is no room, or the directory is gone.
        """
        path = self._path / name[:2] / name
        path.parent.mkdir(mode=PRIVATE, exist_ok=True)
        temporary = path.parent / f"{_TEMPORARY}{os.getpid()}-{next(self._numbers)}"
        try:
            with open(temporary, "wb", opener=open_private) as file:
                file.write(_packed(name, data))
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
        self._until_shrink -= len(data)
        if self._until_shrink <= 0:
            self.shrink()

    def remove(self, names: Iterable[str]) -> None:
        """Keep blocks no longer."""
        for name in names:
            with suppress(OSError):
                (self._path / name[:2] / name).unlink()

    def shrink(self) -> None:
        """If there is too much, remove the blocks not used for longest; and remove what crashed writers
        left."""
        self._until_shrink = self._budget // 16
        blocks, now = [], time.time()
        for folder in self._path.glob("[0-9a-f][0-9a-f]"):
            for path in folder.iterdir():
                with suppress(OSError):  # another mount was faster
                    facts = path.lstat()
                    if not path.name.startswith(_TEMPORARY):
                        blocks.append((facts.st_mtime, facts.st_size, path))
                    elif facts.st_mtime < now - ABANDONED:
                        path.unlink()
        total = sum(size for _, size, _ in blocks)
        goal = total if total <= self._budget else self._budget * 9 // 10
        for _, size, path in sorted(blocks):
            if total <= goal:
                break
            total -= size
            path.unlink(missing_ok=True)


def _packed(name: str, data: bytes) -> bytes:
    """Return a block as it lies on the disk."""
    checksum = hashlib.blake2b(data, digest_size=DIGEST_SIZE, key=name.encode())
    return MAGIC + checksum.digest() + data
