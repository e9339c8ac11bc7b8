"""Local files that keep pending changes until the vehicle has them. Layer: cache.

From its first changed byte on, a file has a local file in a 0700 directory, with the same bytes at the same
offsets; all of these hold at most `spool_max` bytes. A description beside the local file says which file of
which vehicle it belongs to, as long as the vehicle lacks something of it. `persist` writes down all that is
known, with fsync. So the next mount of the vehicle finds the file after a kill -9 (`recovery`).

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

SPOOL_MAX = 1 << 30
"""Bytes that may wait for a vehicle."""

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class Spool:
    """The budget that the pending changes of all files share, in bytes.

    Attributes:
        held: bytes of all files.
    """

    def __init__(
        self,
        directory: Path | None = None,
        *,
        spool_max: int = SPOOL_MAX,
        vehicle: Callable[[], Mapping[str, object]] = dict,
    ) -> None:
        """`spool_max` bytes in `directory`, or in one that is made when it is needed. `vehicle`: what each
        description says of the vehicle, as JSON holds it."""
        self.vehicle = vehicle
        self.held = 0
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
        if self._temporary is not None:
            with contextlib.suppress(OSError):  # another file is in it
                self._temporary.rmdir()
                self._directory = self._temporary = None


class SpoolContent:
    """The local file with the held bytes of one file (`content.Content`).

    Attributes:
        name: the file's path on the vehicle, None once all programs are done with it.
        held: the extents that are kept.
    """

    def __init__(self, spool: Spool, name: bytes | None = b"") -> None:
        self.name = name
        self._spool = spool
        self._file: int | None = None
        self._path: Path | None = None
        self.held = ExtentSet()
        self._told: dict[str, Any] | None = None  # the description beside the file, if there is one
        self._durable = False

    def put(self, offset: int, data: bytes | memoryview, *, zeros: int = 0) -> None:
        """Keep bytes. zeros: so many zeros before them, where the local file ended, are kept, too.

        Raises:
            NoSpace: the budget is used up, or the local disk is full. SpoolFailed: the local disk fails.
                The bytes that were kept before stay.
        """
        try:
            self._open()
            self._write_down()
            self._write(offset, data, zeros)
        except NoSpace as error:  # a program takes ENOSPC for a full card
            log.warning("no room here, not on the vehicle, for what is not delivered yet: %s", error)
            raise

    def get(self, start: int, stop: int) -> bytes:
        """Return bytes that were put.

        Raises:
            SpoolFailed: the local disk does not give them back.
        """
        assert self._file is not None
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
        if self._file is None:
            return
        self._write_down()
        try:
            os.ftruncate(self._file, min(size, os.fstat(self._file).st_size))
        except OSError as exc:
            raise SpoolFailed(f"cannot cut {self._path}: {exc}") from exc
        before = self.held.total
        self.held.discard(size, max(size, self.held.end))
        self._spool.held += self.held.total - before

    def mark_unneeded(self) -> None:
        """Remove the description, until more is put: the vehicle has all of it, or no program wants it any
        more. So the next mount does not offer it."""
        if self._path is not None:
            remove_description(self._path)
            self._told, self._durable = None, False

    def persist(self, facts: dict[str, Any]) -> str:
        """Make bytes and `facts` (JSON) survive the end of this process. A second call does nothing, until
        more is put or cut, or other facts than the time (`at`) are given.

        Returns the path of the file that holds the bytes.

        Raises:
            NoSpace, SpoolFailed, OSError.
        """
        self._open()
        assert self._file is not None
        assert self._path is not None
        if os.fstat(self._file).st_size < self.held.end:
            raise SpoolFailed(f"{self._path} lost bytes that were in it")
        facts = {**facts, **self._spool.vehicle()}
        if self._durable and {**facts, "at": None} == {**(self._told or {}), "at": None}:
            return str(self._path)
        os.ftruncate(self._file, facts["size"])
        os.fsync(self._file)
        write_facts(self._path, facts, durable=True)
        self._told, self._durable = facts, True
        return str(self._path)

    def close(self) -> None:
        """Forget the bytes: the vehicle has them, or no program wants them. Raises nothing."""
        self._spool.held -= self.held.total
        self.held = ExtentSet()
        if self._file is not None:
            try:
                os.close(self._file)
            except OSError as exc:
                log.warning("closing %s: %s", self._path, exc)  # its bytes are useless by now
        if self._path is not None:
            self._spool.remove_file(self._path)
        self._file = self._path = self._told = None
        self._durable = False

    # --- inside

    def _open(self) -> None:
        """Make the local file, with its description, if there is none yet.

        Raises:
            NoSpace: there is none.
        """
        if self._file is not None:
            return
        try:
            self._path = self._spool.new_file()
            self._write_down()
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except (OSError, NoSpace, SpoolFailed) as exc:
            self.close()
            raise NoSpace(f"no local file for what waits for the vehicle: {exc}") from exc

    def _write_down(self) -> None:
        """Say beside the local file what it is, if that is not said yet.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        if self.name is None or self._path is None:
            return
        facts = {"path": self.name.decode(errors="surrogateescape"), **self._spool.vehicle()}
        if facts != self._told:
            try:
                write_facts(self._path, facts, durable=False)
            except OSError as exc:
                raise disk_error(exc, self._path) from exc
            self._told, self._durable = facts, False

    def _write(self, offset: int, data: bytes | memoryview, zeros: int) -> None:
        """Write new bytes before bytes that replace others: a full disk refuses the new ones, and nothing is
        replaced."""
        assert self._file is not None
        whole, stop = memoryview(data), offset + len(data)
        old = self.held.intersection(offset, stop)
        more = zeros + len(data)
        for a, b in old:
            more -= b - a
        spool = self._spool
        if spool.held + more > spool.spool_max:
            raise NoSpace(f"{spool.held} bytes wait for the vehicle, at most {spool.spool_max} may")
        try:
            if zeros:  # a put that failed may have left bytes there
                os.ftruncate(self._file, offset - zeros)
                os.ftruncate(self._file, offset)
            for a, b in [*self.held.missing(offset, stop), *old]:
                while a < b:
                    a += os.pwrite(self._file, whole[a - offset : b - offset], a)
        except OSError as exc:
            raise disk_error(exc, self._path) from exc
        self.held.add(offset - zeros, stop)
        spool.held += more


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
    _unlink(data)
    remove_description(data)


def remove_description(data: Path) -> None:
    """Remove the description of a spooled file; what cannot be removed is only logged."""
    _unlink(data.with_suffix(".json"), data.with_suffix(".new"))


def _unlink(*paths: Path) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as exc:
            log.warning("cannot remove %s: %s", path, exc)


def disk_error(exc: OSError, path: Path | None) -> NoSpace | SpoolFailed:
    """Return what a local disk's error means to a writer: it is full, or it fails."""
    kind = NoSpace if exc.errno in _FULL else SpoolFailed
    return kind(f"cannot keep bytes in {path}: {exc}")
