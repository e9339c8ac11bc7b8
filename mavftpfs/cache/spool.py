"""Where bytes wait that are not proven to be on the vehicle. Layer: cache.

Up to `memory_max` bytes of all files together lie in memory. Beyond that, a file's bytes move to a local file
of its own in a 0700 directory, at the same offsets, up to `spool_max` bytes together. Bytes stay until the
draft is told that the vehicle has them. When a file goes to disk, its name is written down beside it.
`persist` writes down all that is known of it, with fsync. So the next mount of the vehicle finds it after a
kill -9 (`recovery`).

If the local disk fails, the file whose bytes it had gets the error (SpoolFailed), never the whole mount.

Local files are written in the event loop: they go to the page cache, in pieces of at most a megabyte.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mavftpfs.shared.errors import NoSpace, SpoolFailed
from mavftpfs.shared.extents import ExtentSet

log = logging.getLogger("mavftpfs.cache")

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class Spool:
    """The budget that all drafts share, in bytes.

    Attributes:
        in_memory, on_disk: bytes held. full: the disk had no room, and nothing was freed since.
    """

    def __init__(
        self,
        *,
        spool_max: int,
        directory: Path | None = None,
        memory_max: Callable[[], int] = lambda: 0,
        vehicle: Callable[[], Mapping[str, object]] = dict,
    ) -> None:
        """`memory_max()` bytes in memory, `spool_max` on disk, in `directory` or one made when needed.
        `vehicle`: what each description says of the vehicle, as JSON holds it."""
        self.memory_max = memory_max
        self.vehicle = vehicle
        self.in_memory = 0
        self.on_disk = 0
        self.full = False
        self.spool_max = spool_max
        self._directory = directory
        self._temporary: Path | None = None
        self._number = 0

    def new_file(self) -> Path:
        """Return the path of a file that is not there yet. Raises OSError."""
        if self._directory is None:
            self._directory = self._temporary = Path(tempfile.mkdtemp(prefix="mavftpfs-"))
        self._number += 1
        return self._directory / f"{self._number:06}.data"

    def remove_file(self, path: Path) -> None:
        """Remove a local file, and with the last one the directory, if it was made here."""
        remove(path)
        self.full = False
        if self._temporary is not None:
            with contextlib.suppress(OSError):  # another file is in it
                self._temporary.rmdir()
                self._directory = self._temporary = None


class SpoolContent:
    """The held bytes of one draft; implements cache.draft.Content.

    Attributes:
        name: the file's path on the vehicle, None once no program wants it any more.
    """

    def __init__(self, spool: Spool, name: bytes | None = b"") -> None:
        self.name = name
        self._spool = spool
        self._memory = bytearray()
        self._file: int | None = None
        self._path: Path | None = None
        self._stored = ExtentSet()
        self._told: dict[str, Any] | None = None  # what is written down beside the file
        self._durable = False

    def put(self, offset: int, data: bytes | memoryview) -> None:
        """Keep bytes.

        Raises:
            NoSpace: the budget is used up, or the local disk is full. SpoolFailed: the local disk fails.
                What was kept before is as it was.
        """
        spool, memory = self._spool, self._memory
        more = max(0, offset + len(data) - len(memory))
        if self._file is None and spool.in_memory + more <= spool.memory_max():
            if offset > len(memory):
                memory.extend(bytes(offset - len(memory)))
            memory[offset : offset + len(data)] = data
            spool.in_memory += more
            return
        said = spool.full  # a failed attempt resets it as it cleans up
        try:
            self._spill()
            self._write_down(needed=True)
            self._put_on_disk(offset, data)
        except NoSpace as error:
            if not said:  # a program takes ENOSPC for a full card
                log.warning("no room here, not on the vehicle, for what is not delivered yet: %s", error)
            spool.full = True
            raise

    def get(self, start: int, stop: int) -> bytes:
        """Return bytes that were put.

        Raises:
            SpoolFailed: the local disk does not give them back.
        """
        if self._file is None:
            return bytes(self._memory[start:stop])
        try:
            data = os.pread(self._file, stop - start, start)
        except OSError as exc:
            raise SpoolFailed(f"cannot read {self._path}: {exc}") from exc
        if len(data) != stop - start:
            raise SpoolFailed(f"{self._path} lost bytes that were in it")
        return data

    def cut(self, size: int) -> None:
        """Forget the bytes at and beyond `size`. If the file is extended again, zeros are there.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        self._write_down(needed=True)
        if self._file is None:
            before = len(self._memory)
            del self._memory[size:]
            self._spool.in_memory += len(self._memory) - before
            return
        try:
            os.ftruncate(self._file, min(size, os.fstat(self._file).st_size))
        except OSError as exc:
            raise SpoolFailed(f"cannot cut {self._path}: {exc}") from exc
        before = self._stored.total
        self._stored.discard(size, max(size, self._stored.end))
        self._spool.on_disk += self._stored.total - before

    def mark_unneeded(self) -> None:
        """Write down that the next mount need not offer it, until more is put: the vehicle has all of it, or
        no program wants it any more. A failure is only logged."""
        try:
            self._write_down(needed=False)
        except (NoSpace, SpoolFailed) as exc:
            log.warning("what %s is cannot be written down: %s", self._path, exc)

    def persist(self, facts: dict[str, Any]) -> str:
        """Make bytes and `facts` (JSON) survive the end of this process. A second call does nothing, until
        more is put or cut.

        Returns the path of the file that holds the bytes.

        Raises:
            NoSpace, SpoolFailed, OSError.
        """
        self._spill()
        assert self._file is not None
        assert self._path is not None
        if os.fstat(self._file).st_size < self._stored.end:
            raise SpoolFailed(f"{self._path} lost bytes that were in it")
        if self._durable:
            return str(self._path)
        facts = {**facts, **self._spool.vehicle()}
        os.ftruncate(self._file, facts["size"])
        os.fsync(self._file)
        write_facts(self._path, facts, durable=True)
        self._told, self._durable = facts, True
        return str(self._path)

    def close(self) -> None:
        """Forget the bytes: the vehicle has them, or no program wants them. Raises nothing."""
        self._spool.in_memory -= len(self._memory)
        self._spool.on_disk -= self._stored.total
        self._memory, self._stored = bytearray(), ExtentSet()
        if self._file is not None:
            try:
                os.close(self._file)
            except OSError as exc:
                log.warning("closing %s: %s", self._path, exc)  # its bytes are not needed any more
        if self._path is not None:
            self._spool.remove_file(self._path)
        self._file = self._path = self._told = None
        self._durable = False

    # --- inside

    def _write_down(self, *, needed: bool) -> None:
        """Update the description beside the local file, if there is one. needed: the vehicle lacks something
        of it.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        facts: dict[str, Any] = {"needed": False}
        if self.name is not None and needed:
            facts = {"path": self.name.decode(errors="surrogateescape"), **self._spool.vehicle()}
        if self._path is not None and facts != self._told:
            try:
                write_facts(self._path, facts, durable=False)
            except OSError as exc:
                raise disk_error(exc, self._path) from exc
            self._told, self._durable = facts, False

    def _put_on_disk(self, offset: int, data: bytes | bytearray | memoryview) -> None:
        """Write new bytes before bytes that replace others: a full disk refuses the new ones, and nothing is
        replaced."""
        assert self._file is not None
        whole, stop = memoryview(data), offset + len(data)
        old = self._stored.intersection(offset, stop)
        more = len(data)
        for a, b in old:
            more -= b - a
        spool = self._spool
        if spool.on_disk + more > spool.spool_max:
            raise NoSpace(f"{spool.on_disk} bytes wait for the vehicle, spool_max is {spool.spool_max}")
        try:
            for a, b in [*self._stored.missing(offset, stop), *old]:
                while a < b:
                    a += os.pwrite(self._file, whole[a - offset : b - offset], a)
        except OSError as exc:
            raise disk_error(exc, self._path) from exc
        self._stored.add(offset, stop)
        spool.on_disk += more

    def _spill(self) -> None:
        """Move from memory to disk.

        Raises:
            NoSpace, SpoolFailed: all is where it was.
        """
        if self._file is not None:
            return
        memory, self._memory = self._memory, bytearray()
        try:
            try:
                self._path = self._spool.new_file()
                self._write_down(needed=True)
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            except (OSError, NoSpace, SpoolFailed) as exc:
                raise NoSpace(f"no local file for what waits for the vehicle: {exc}") from exc
            self._put_on_disk(0, memory)
        except (NoSpace, SpoolFailed):
            self.close()
            self._memory = memory
            raise
        self._spool.in_memory -= len(memory)


def write_facts(data: Path, facts: Mapping[str, object], *, durable: bool) -> None:
    """Write the description of a spooled file. If the process is killed meanwhile, the old one or the new one
    is there.

    durable: also after a loss of power.

    Raises:
        OSError.
    """
    path = data.with_suffix(".json")
    new = path.with_suffix(".new")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    with open(os.open(new, flags, 0o600), "wb") as file:
        file.write(json.dumps(facts, indent=1).encode())
        file.flush()
        if durable:
            os.fsync(file.fileno())
    new.replace(path)
    if durable:
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def remove(data: Path) -> None:
    """Remove a spooled file and its description; what cannot be removed is only logged."""
    for path in (data, data.with_suffix(".json"), data.with_suffix(".new")):
        try:
            path.unlink(missing_ok=True)
        except OSError as exc:
            log.warning("cannot remove %s: %s", path, exc)


def disk_error(exc: OSError, path: Path | None) -> NoSpace | SpoolFailed:
    """Return what a local disk's error means to a writer: it is full, or it fails."""
    kind = NoSpace if exc.errno in _FULL else SpoolFailed
    return kind(f"cannot keep bytes in {path}: {exc}")
