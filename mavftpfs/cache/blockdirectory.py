"""Blocks of files in a directory of the local disk. Layer: cache; blocks the caller: run it in threads.

Every block is a file of its own that appears whole under its name or not at all (rename), and is checked when
it is read. So several mounts, of the same vehicle too, share a directory without locks, and a crash leaves at
worst a temporary file that a later `shrink` removes.
"""

from __future__ import annotations

import errno
import os
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path

from mavftpfs.cache.persistent import BlockKey, Stored, surplus

NAME = "mavftpfs-blocks"
PRIVATE = 0o700
ABANDONED = 3600.0
"""Seconds after which a temporary file belongs to no writer any more."""

_TEMPORARY = ".new-"


class BlockDirectory:
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
            temporary.write_bytes(packed)
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
