"""Where bytes wait that are not proven to be on the vehicle. Layer: cache.

Up to `memory_max` bytes over all files lie in memory; beyond that a file's bytes move to a file of their own
in a 0700 directory, at the same offsets, up to `spool_max` over all. Nothing leaves before its draft is told
that the vehicle has it. A file's name is written down when it goes to disk, and `persist` writes down all
that is known of it (fsynced), so that the next mount of the vehicle finds it after a kill -9 (`recovery`).

A local disk that fails is an error of the file whose bytes it had (SpoolFailed), never of the mount.

Local files are written in the event loop: they go to the page cache, in pieces of at most a megabyte.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavftpfs.cache.recovery import disk_error, remove, write_facts
from mavftpfs.shared.errors import NoSpace, SpoolFailed
from mavftpfs.shared.extents import ExtentSet

log = logging.getLogger("mavftpfs.cache")

PAGE = 64 * 1024


class Spool:
    """The budget that all drafts share, in bytes.

    Attributes:
        in_memory, on_disk: bytes held. full: the disk had no room, and nothing was freed since.
    """

    def __init__(
        self, *, memory_max: Callable[[], int], spool_max: int, directory: Path | None = None
    ) -> None:
        """`memory_max()` bytes in memory, `spool_max` on disk, in `directory` or one made when needed."""
        self.memory_max = memory_max
        self.in_memory = 0
        self.on_disk = 0
        self.full = False
        self._spool_max = spool_max
        self._directory = directory
        self._temporary: Path | None = None
        self._number = 0

    def require_disk(self, more: int) -> None:
        """Raise NoSpace unless `more` bytes may go to disk."""
        if self.on_disk + more > self._spool_max:
            raise NoSpace(f"{self.on_disk} bytes wait for the vehicle, spool_max is {self._spool_max}")

    def new_file(self) -> Path:
        """Return the path of a file that is not there yet. Raises OSError."""
        if self._directory is None:
            self._directory = self._temporary = Path(tempfile.mkdtemp(prefix="mavftpfs-"))
        while True:  # a dead mount may have left some
            self._number += 1
            path = self._directory / f"{self._number:06}.data"
            if not path.exists():
                return path

    def remove_file(self, path: Path) -> None:
        """Remove a file; a directory that was made here goes with its last one."""
        remove(path)
        self.full = False
        if self._temporary is not None:
            with contextlib.suppress(OSError):  # another file is in it
                self._temporary.rmdir()
                self._directory = self._temporary = None


class SpoolContent:
    """The held bytes of one draft; implements cache.draft.Content."""

    def __init__(self, spool: Spool, name: Callable[[], str | None] = lambda: "") -> None:
        """`name()`: the file's path on the vehicle, None once nobody wants it any more."""
        self._spool = spool
        self._name = name
        self._pages: dict[int, bytearray] = {}
        self._file: int | None = None
        self._path: Path | None = None
        self._stored = ExtentSet()
        self._persisted = False
        self._settled = False

    def put(self, offset: int, data: bytes | memoryview) -> None:
        """Keep bytes.

        Raises:
            NoSpace: the budget is used up, or the local disk is full. SpoolFailed: the local disk fails.
                What was kept before is as it was.
        """
        if self._file is None and self._put_in_memory(offset, memoryview(data)):
            self._note_changed()
            return
        said = self._spool.full  # an attempt that fails frees what it had taken itself
        try:
            self._spill()
            self._note_changed()
            self._put_on_disk(offset, data)
        except NoSpace as error:
            if not said:  # to a program ENOSPC means the card
                log.warning("no room here, not on the vehicle, for what is not delivered yet: %s", error)
            self._spool.full = True
            raise

    def get(self, start: int, stop: int) -> bytes:
        """Return bytes that were put.

        Raises:
            SpoolFailed: the local disk does not give them back.
        """
        if self._file is not None:
            try:
                data = os.pread(self._file, stop - start, start)
            except OSError as exc:
                raise SpoolFailed(f"cannot read {self._path}: {exc}") from exc
            if len(data) != stop - start:
                raise SpoolFailed(f"{self._path} lost bytes that were in it")
            return data
        parts = []
        while start < stop:
            index, at = divmod(start, PAGE)
            parts.append(memoryview(self._pages[index])[at : min(PAGE, at + stop - start)])
            start += len(parts[-1])
        return b"".join(parts)

    def cut(self, size: int) -> None:
        """Forget what lies at and beyond `size`; if it is extended again, zeros are there.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        self._note_changed()
        if self._file is not None:
            try:
                os.ftruncate(self._file, min(size, os.fstat(self._file).st_size))
            except OSError as exc:
                raise SpoolFailed(f"cannot cut {self._path}: {exc}") from exc
            before = self._stored.total
            self._stored.discard(size, max(size, self._stored.end))
            self._spool.on_disk += self._stored.total - before
            return
        for index in [i for i in self._pages if i * PAGE >= size]:
            del self._pages[index]
            self._spool.in_memory -= PAGE
        last = self._pages.get(size // PAGE)
        if last is not None:
            last[size % PAGE :] = bytes(PAGE - size % PAGE)

    def settle(self) -> None:
        """The vehicle has all of it: until more is put the next mount need not offer it."""
        self._settled = True
        self.restate()

    def restate(self) -> None:
        """Its name changed, or nobody wants it any more: write that down; a failure is only logged."""
        if self._path is None:
            return
        self._persisted = False
        try:
            self._write_name(self._path)
        except OSError as exc:
            log.warning("what %s is cannot be written down: %s", self._path, exc)

    def persist(self, facts: dict[str, Any]) -> None:
        """Have bytes and `facts` (JSON) survive the end of this process; once until more is put or cut.

        Raises:
            NoSpace, SpoolFailed, OSError.
        """
        if self._persisted:
            return
        self._spill()
        assert self._file is not None
        assert self._path is not None
        os.ftruncate(self._file, facts["size"])
        os.fsync(self._file)
        write_facts(self._path, facts, durable=True)
        self._persisted = True

    def close(self) -> None:
        """The vehicle has it, or nobody wants it: forget the bytes. Raises nothing."""
        self._spool.in_memory -= len(self._pages) * PAGE
        self._pages = {}
        if self._file is None or self._path is None:
            return
        self._spool.on_disk -= self._stored.total
        self._stored.clear()
        try:
            os.close(self._file)
        except OSError as exc:
            log.warning("closing %s: %s", self._path, exc)  # nobody needs its bytes any more
        self._spool.remove_file(self._path)
        self._file = self._path = None

    # --- inside

    def _note_changed(self) -> None:
        """Something of it is the vehicle's no longer: what is written down must not be less than true."""
        before = (self._settled, self._persisted)
        self._settled = self._persisted = False
        if self._path is None or not any(before):
            return
        try:
            self._write_name(self._path)
        except OSError as exc:
            self._settled, self._persisted = before  # else the next one would take it for written
            raise disk_error(exc, self._path) from exc

    def _write_name(self, data: Path) -> None:
        name = self._name()
        facts = {"path": name, "unfinished": True} if name and not self._settled else {"needed": False}
        if name != "":
            write_facts(data, facts, durable=False)

    def _put_in_memory(self, offset: int, data: memoryview) -> bool:
        """Return False, having kept nothing, if that is too much for memory."""
        more = 0
        for index in range(offset // PAGE, -(-(offset + len(data)) // PAGE)):
            more += 0 if index in self._pages else PAGE
        if self._spool.in_memory + more > self._spool.memory_max():
            return False
        self._spool.in_memory += more
        while data:
            index, at = divmod(offset, PAGE)
            page = self._pages.get(index)
            if page is None:
                page = self._pages[index] = bytearray(PAGE)
            count = min(len(data), PAGE - at)
            page[at : at + count] = data[:count]
            data, offset = data[count:], offset + count
        return True

    def _put_on_disk(self, offset: int, data: bytes | bytearray | memoryview) -> None:
        """Write what is new before what replaces something: a full disk refuses the former."""
        assert self._file is not None
        whole, stop, before = memoryview(data), offset + len(data), self._stored.total
        new = self._stored.missing(offset, stop)
        self._spool.require_disk(sum([b - a for a, b in new]))
        try:
            for a, b in [*new, *self._stored.intersection(offset, stop)]:
                while a < b:
                    a += os.pwrite(self._file, whole[a - offset : b - offset], a)
        except OSError as exc:
            raise disk_error(exc, self._path) from exc
        self._stored.add(offset, stop)
        self._spool.on_disk += self._stored.total - before

    def _spill(self) -> None:
        """Move from memory to disk.

        Raises:
            NoSpace, SpoolFailed: all is where it was.
        """
        if self._file is not None:
            return
        self._spool.require_disk(len(self._pages) * PAGE)
        pages, path = self._pages, None
        try:
            path = self._spool.new_file()
            self._write_name(path)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except OSError as exc:
            if path is not None:
                self._spool.remove_file(path)
            raise NoSpace(f"no local file for what waits for the vehicle: {exc}") from exc
        self._path, self._pages = path, {}
        try:
            for index, page in pages.items():
                self._put_on_disk(index * PAGE, page)
        except (NoSpace, SpoolFailed):
            self.close()
            self._pages = pages
            raise
        self._spool.in_memory -= len(pages) * PAGE
