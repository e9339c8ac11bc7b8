"""Where bytes wait that are not proven to be on the vehicle. Layer: cache.

Up to `memory_max` bytes over all files lie in memory; beyond that a file's bytes move to a file of their own
in a 0700 directory, at the same offsets, up to `spool_max` over all. Nothing leaves before its draft is told
that the vehicle has it. A file's name is written down when it goes to disk, and `persist` writes down all
that is known of it (fsynced), so that the next mount of the vehicle finds it after a kill -9:
`SpoolDirectory.rescue` moves what a dead mount left to a recovery directory. It is never written to a vehicle
by itself: nobody knows what happened to the file since.

A local disk that fails is an error of the file whose bytes it had (SpoolFailed), never of the mount.

Local files are written in the event loop: they go to the page cache, in pieces of at most a megabyte.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

from mavftpfs.cache import rescuing
from mavftpfs.cache.reserved import new_owner
from mavftpfs.shared.errors import NoSpace, SpoolFailed
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.private import make_private_directory

log = logging.getLogger("mavftpfs.cache")

PAGE = 64 * 1024
SLOTS = 64
"""Mounts of one vehicle by one user at the same time."""

TOKENS = 256
"""Mounts one after the other whose leftovers on the vehicle are known for ours."""


class SpoolDirectory:
    """A directory on disk that one mount at a time uses; `owner` marks the mount's names on the vehicle.

    Attributes:
        dead_owners: tokens of mounts that ended here; what they left on the vehicle is nobody's.
    """

    def __init__(self, base: Path, rng: Random) -> None:
        """Claim a free slot below `base`.

        Raises:
            OSError: it cannot be made, or every slot is taken.
        """
        make_private_directory(base)
        self._locks: dict[Path, int] = {}
        self.dead_owners: frozenset[bytes] = frozenset()
        free = [slot for slot in (base / f"slot{number}" for number in range(SLOTS)) if self._lock(slot)]
        if not free:
            raise OSError(f"all {SLOTS} slots of {base} are in use")
        self.path = free[0]
        self.dead_owners = frozenset(token for slot in free for token in self._tokens(slot))
        self.owner = self._new_token(self.path, rng)
        self._abandoned = free
        self._left = frozenset(rescuing.data_in(self.path))

    def rescue(self, recovery: Path) -> list[Path]:
        """Move what dead mounts left to `recovery`; return the files, and let go of their slots.

        What cannot be moved stays where a later mount finds it.

        Raises:
            OSError: there was something, and nothing of it could be moved.
        """
        found: list[Path] = []
        failed: list[OSError] = []
        for slot in self._abandoned:
            moved, stuck = rescuing.rescue(slot, recovery)
            found += moved
            failed += stuck
            if slot != self.path:
                self._unlock(slot)
        self._abandoned = []
        self._left = frozenset(rescuing.data_in(self.path))
        if failed and not found:
            raise failed[0]
        return found

    def discard(self) -> None:
        """Remove what this mount put here: the vehicle has it, though a program may not have closed it."""
        for data in rescuing.data_in(self.path):
            if data not in self._left:
                rescuing.remove(data)

    def close(self) -> None:
        """Let go of the directory."""
        for slot in list(self._locks):
            self._unlock(slot)

    def _lock(self, slot: Path) -> bool:
        if self._locks and not slot.exists():
            return False  # one new slot is enough
        slot.mkdir(mode=0o700, exist_ok=True)
        descriptor = os.open(slot / "owner", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        self._locks[slot] = descriptor
        return True

    def _unlock(self, slot: Path) -> None:
        os.close(self._locks.pop(slot))

    def _tokens(self, slot: Path) -> list[bytes]:
        """Return the tokens of the slot's mounts, the latest first."""
        return os.pread(self._locks[slot], 8 * TOKENS, 0).split()

    def _new_token(self, slot: Path, rng: Random) -> bytes:
        """Each mount has its own: other mounts that began before know the older ones for dead."""
        token = new_owner(rng)
        while token in self.dead_owners:
            token = new_owner(rng)
        kept = [token, *self._tokens(slot)][:TOKENS]
        os.pwrite(self._locks[slot], b"\n".join(kept) + b"\n", 0)
        return token


class FullDisk:
    """Says that it is the disk here that is full, once until there was room: to a program ENOSPC means the
    card."""

    def __init__(self) -> None:
        self._said = False

    @contextlib.contextmanager
    def told(self) -> Iterator[None]:
        """Log a NoSpace that comes from inside; it goes on."""
        said = self._said  # an attempt that fails frees what it had taken itself
        try:
            yield
        except NoSpace as error:
            if not said:
                log.warning("no room here, not on the vehicle, for what is not delivered yet: %s", error)
            self._said = True
            raise

    def freed(self) -> None:
        """There is room again: the next time is news."""
        self._said = False


class Spool:
    """The budget that all drafts share."""

    def __init__(
        self, *, memory_max: Callable[[], int], spool_max: int, directory: Path | None = None
    ) -> None:
        """`memory_max()` bytes in memory, `spool_max` on disk, in `directory` or one made when needed."""
        self._memory_max = memory_max
        self._spool_max = spool_max
        self._directory = directory
        self._temporary: Path | None = None
        self._number = 0
        self.in_memory = 0
        self.on_disk = 0
        self.full = FullDisk()

    @property
    def bytes_held(self) -> int:
        """Bytes in memory and on disk."""
        return self.in_memory + self.on_disk

    def content(self, name: Callable[[], str | None] | None = None) -> SpoolContent:
        """Return room for one file; `name()`: its path on the vehicle, None once nobody wants it any more."""
        return SpoolContent(self, name or (lambda: ""))

    def fits_memory(self, more: int) -> bool:
        """Return whether `more` bytes may be kept in memory."""
        return self.in_memory + more <= self._memory_max()

    def require_disk(self, more: int) -> None:
        """Raise NoSpace unless `more` bytes may go to disk."""
        if self.on_disk + more > self._spool_max:
            raise NoSpace(f"{self.on_disk} bytes wait for the vehicle, spool_max is {self._spool_max}")

    def new_file(self) -> Path:
        """Return the path of a file that is not there yet."""
        while True:  # a dead mount may have left some
            self._number += 1
            path = self._place() / f"{self._number:06}.data"
            if not path.exists():
                return path

    def file_gone(self) -> None:
        """A file was removed: a directory that was made here goes with its last one."""
        self.full.freed()
        if self._temporary is not None:
            with contextlib.suppress(OSError):  # another file is in it
                self._temporary.rmdir()
                self._directory = self._temporary = None

    def _place(self) -> Path:
        if self._directory is None:
            self._directory = self._temporary = Path(tempfile.mkdtemp(prefix="mavftpfs-"))
        return self._directory


class SpoolContent:
    """The held bytes of one draft; implements cache.draft.Content."""

    def __init__(self, spool: Spool, name: Callable[[], str | None]) -> None:
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
        if self._file is None:
            new = self._new_pages(offset, offset + len(data))
            if self._spool.fits_memory(new * PAGE):
                self._put_pages(offset, memoryview(data))
                self._changed()
                return
        with self._spool.full.told():
            self._spill()
            self._changed()
            self._put_file(offset, data)

    def get(self, start: int, stop: int) -> bytes:
        """Return bytes that were put.

        Raises:
            SpoolFailed: the local disk does not give them back.
        """
        if self._file is not None:
            return self._get_file(self._file, start, stop)
        parts = []
        while start < stop:
            base = start // PAGE * PAGE
            end = min(stop, base + PAGE)
            parts.append(memoryview(self._pages[base // PAGE])[start - base : end - base])
            start = end
        return b"".join(parts)

    def cut(self, size: int) -> None:
        """Forget what lies at and beyond `size`; if it is extended again, zeros are there.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        self._changed()
        if self._file is not None:
            try:
                os.ftruncate(self._file, min(size, os.fstat(self._file).st_size))
            except OSError as exc:
                raise SpoolFailed(f"cannot cut {self._path}: {exc}") from exc
            self._count_stored(size, max(size, self._stored.end), present=False)
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
        rescuing.write_facts(self._path, facts, durable=True)
        self._persisted = True

    def close(self) -> None:
        """The vehicle has it, or nobody wants it: forget the bytes. Raises nothing."""
        self._spool.in_memory -= len(self._pages) * PAGE
        self._pages = {}
        if self._file is not None:
            self._drop_file()

    # --- inside

    def _changed(self) -> None:
        """Something of it is the vehicle's no longer: what is written down must not be less than true."""
        before = (self._settled, self._persisted)
        self._settled = self._persisted = False
        if self._path is None or not any(before):
            return
        try:
            self._write_name(self._path)
        except OSError as exc:
            self._settled, self._persisted = before  # else the next one would take it for written
            raise rescuing.trouble(exc, self._path) from exc

    def _write_name(self, data: Path) -> None:
        name = self._name()
        facts = {"path": name, "unfinished": True} if name and not self._settled else {"needed": False}
        if name != "":
            rescuing.write_facts(data, facts, durable=False)

    def _new_pages(self, start: int, stop: int) -> int:
        return sum(1 for i in range(start // PAGE, -(-stop // PAGE)) if i not in self._pages)

    def _put_pages(self, offset: int, data: memoryview) -> None:
        while data:
            index, at = divmod(offset, PAGE)
            page = self._pages.get(index)
            if page is None:
                page = self._pages[index] = bytearray(PAGE)
                self._spool.in_memory += PAGE
            count = min(len(data), PAGE - at)
            page[at : at + count] = data[:count]
            data = data[count:]
            offset += count

    def _spill(self) -> None:
        """Move from memory to disk."""
        if self._file is not None:
            return
        self._spool.require_disk(len(self._pages) * PAGE)
        path: Path | None = None
        try:
            path = self._spool.new_file()
            self._write_name(path)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except OSError as exc:
            if path is not None:
                self._forget_file(path)
            raise NoSpace(f"no local file for what waits for the vehicle: {exc}") from exc
        self._path = path
        try:
            for index, page in self._pages.items():
                self._put_file(index * PAGE, page)
        except (NoSpace, SpoolFailed):  # nothing may leave memory before all of it is on disk
            self._drop_file()
            raise
        self._spool.in_memory -= len(self._pages) * PAGE
        self._pages = {}

    def _drop_file(self) -> None:
        assert self._file is not None
        assert self._path is not None
        self._count_stored(0, self._stored.end, present=False)
        try:
            os.close(self._file)
        except OSError as exc:
            log.warning("closing %s: %s", self._path, exc)  # nobody needs its bytes any more
        self._forget_file(self._path)
        self._file = self._path = None

    def _forget_file(self, path: Path) -> None:
        rescuing.remove(path)
        self._spool.file_gone()

    def _get_file(self, file: int, start: int, stop: int) -> bytes:
        try:
            data = os.pread(file, stop - start, start)
        except OSError as exc:
            raise SpoolFailed(f"cannot read {self._path}: {exc}") from exc
        if len(data) != stop - start:
            raise SpoolFailed(f"{self._path} lost bytes that were in it")
        return data

    def _put_file(self, offset: int, data: bytes | bytearray | memoryview) -> None:
        """Write what is new before what replaces something: a full disk refuses the former."""
        whole, stop = memoryview(data), offset + len(data)
        new = self._stored.missing(offset, stop)
        self._spool.require_disk(sum(b - a for a, b in new))
        try:
            for a, b in [*new, *self._stored.intersection(offset, stop)]:
                self._write(whole[a - offset : b - offset], a)
        except OSError as exc:
            raise rescuing.trouble(exc, self._path) from exc
        self._count_stored(offset, stop, present=True)

    def _write(self, data: memoryview, at: int) -> None:
        assert self._file is not None
        while data:
            written = os.pwrite(self._file, data, at)
            data, at = data[written:], at + written

    def _count_stored(self, start: int, stop: int, *, present: bool) -> None:
        before = self._stored.total
        if present:
            self._stored.add(start, stop)
        else:
            self._stored.discard(start, stop)
        self._spool.on_disk += self._stored.total - before
