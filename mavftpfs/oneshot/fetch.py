"""Fetching one file so that it can go on after an interruption, and is proven. Layer: top.

What came lies beside the final name as NAME.part; the final name is given only to a whole file. A .part that
an earlier run left is gone on with, and then the vehicle's CRC32 of the whole file must agree.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Literal

import trio

from mavftpfs.oneshot.files import READ_SIZE, File, Session
from mavftpfs.oneshot.progress import Progress
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FileBusy,
    FtpNak,
    LinkError,
    MavftpfsError,
    NotDeliveredYet,
    NotSupported,
    RequestTimeout,
    SessionBusy,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import is_snapshot
from mavftpfs.shared.readable import name_text, readable_size

Complain = Callable[[str], None]
"""Hears in a line what went wrong with one of several things."""

Verify = Literal["auto", "all", "none"]

PROVEN_BY_DEFAULT = 16_000_000
"""Bytes up to which a file is proven that came in one piece. A vehicle computes about a megabyte of checksum
a second, and most answer nobody meanwhile."""

LEAST_READ, LARGEST_READ = 2048, 128 * 1024
"""Bytes of one read."""
QUICK, SLOW = 0.25, 1.0
"""Seconds after which reads become larger, or smaller."""

EARLIEST = 946_684_800
"""2000-01-01 UTC: an earlier time tells people nothing. (That a clock was set takes more: see cache.kept.)"""


@dataclass(frozen=True, slots=True)
class Log:
    """A file on the vehicle. below: its path below the log directory; mtime: seconds UTC, None if unknown."""

    path: bytes
    below: bytes
    size: int
    mtime: int | None


class Step(Enum):
    """What to do about one file."""

    SKIP = "it is here"
    FETCH = "from the start"
    RESUME = "go on with the .part"
    EXTEND = "the file here may be the beginning"


def known_time(mtime: int) -> int | None:
    """Return a listed time, None where it tells nothing."""
    return mtime if mtime >= EARLIEST else None


def decide(size: int, here: int | None, part: int | None) -> Step:
    """Say what to do about a file of `size` bytes on the vehicle.

    here: size of the local file of that name; part: of the .part beside it; None where there is none.
    """
    if here == size:
        return Step.SKIP
    if part is not None and 0 < part <= size:
        return Step.RESUME
    if here is not None and 0 < here < size:
        return Step.EXTEND
    return Step.FETCH


def proof_needed(verify: Verify, *, resumed: bool, size: int) -> bool:
    """Return whether the vehicle is asked for a checksum of the whole file."""
    if resumed or verify == "all":
        return True
    return verify == "auto" and size <= PROVEN_BY_DEFAULT


def next_read_size(size: int, took: float) -> int:
    """Return how much to read next, after `size` bytes took so many seconds.

    What was read is safe in the .part, and counts on the screen: on a radio that is to be every second or so.
    """
    if took < QUICK:
        return min(size * 2, LARGEST_READ)
    return max(size // 2, LEAST_READ) if took > SLOW else size


def newest_first(logs: Iterable[Log]) -> list[Log]:
    """Order logs: by time, then by their numbers. Those without a time come last, then what is no log."""

    def age(log: Log) -> tuple[bool, int, object]:
        return not log.below.endswith(NO_LOG), log.mtime or 0, natural(log.below)

    return sorted(logs, key=age, reverse=True)


def select(logs: Sequence[Log], *, newest: int | None, since: float | None) -> list[Log]:
    """Return the newest N, of those that are not older than `since` (seconds UTC).

    A log without a time is not left out by `since`: it may be a new one.
    """
    young = [log for log in logs if since is None or log.mtime is None or log.mtime >= since]
    return young if newest is None else young[:newest]


def natural(name: bytes) -> tuple[tuple[int, int, bytes], ...]:
    """Return a key by which `log10` comes after `log9`."""
    parts = re.split(rb"(\d+)", name)
    return tuple((1, int(part), b"") if part.isdigit() else (0, 0, part) for part in parts)


NO_LOG = b"LASTLOG.TXT"
"""ArduPilot keeps the number of its last log beside the logs. `sync --newest` is not to count it as one."""
PART_SUFFIX = ".part"
MAX_RETURNS = 20
"""How often a vehicle may vanish and return while one file is fetched."""

_NOT_NOW: dict[type[MavftpfsError], str] = {
    Armed: "no checksums while armed",
    NotDeliveredYet: "the vehicle is armed, or has not got all of it yet",
    RequestTimeout: "the vehicle did not answer",
    SessionBusy: "another program has the vehicle's session",
    FileBusy: "another program has the vehicle's session",  # so a mount says it
}
"""Why there is no checksum now, though there may be one later."""

NO_CHECKSUM: tuple[type[MavftpfsError], ...] = (*_NOT_NOW, FtpNak, NotSupported)
"""Errors that say that there is no checksum, and nothing else about the file."""


class LocalDiskFull(UsageError):
    """Nothing more can be written on the local disk."""


class StillGrowing(MavftpfsError):
    """The vehicle writes the file; what came so far is kept as its .part."""


class NotProvenYet(MavftpfsError):
    """All bytes are in the .part, but some are of an earlier run and nothing proves them now."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A file to fetch. name: for people; size: as listed; mtime: seconds UTC, None if unknown.

    part: where it lies until it is whole. keep_old: a local file of that name that is not the beginning of
    this one is renamed to NAME.~1~.
    """

    remote: bytes
    local: Path
    name: str
    size: int
    mtime: int | None
    part: Path
    keep_old: bool = False


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file that was fetched. resumed: bytes that were here already; proof: how it was verified."""

    remote: bytes
    local: Path
    name: str
    size: int
    resumed: int
    proof: str


def part_of(local: Path, finals: Collection[Path] = ()) -> Path:
    """Return where a file lies until it is whole. finals: the final names of all files of the run."""
    part = local.with_name(local.name + PART_SUFFIX)
    return part if part not in finals else local.with_name(f"{local.name}.mavftpfs{PART_SUFFIX}")


@contextmanager
def local_disk(place: Path) -> Iterator[None]:
    """Turn what the local disk refuses into an error that says so in a line."""
    try:
        yield
    except OSError as exc:
        full = exc.errno in (errno.ENOSPC, errno.EDQUOT)
        raise (LocalDiskFull if full else UsageError)(f"{place}: {exc.strerror}") from exc


def local_crc32(file: Path) -> int:
    """Return the CRC32 of a local file."""
    crc = 0
    with file.open("rb") as source:
        while data := source.read(READ_SIZE):
            crc = crc32(data, crc)
    return crc


class Part:
    """A .part, locked against a second program that fetches the same."""

    def __init__(self, path: Path, local: Path) -> None:
        """Raises: UsageError: it is no file, or is in use. OSError."""
        self.local = local
        self.path = path
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        fd = os.open(self.path, flags, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise UsageError(f"{self.path} is no file")
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException as exc:
            os.close(fd)
            if isinstance(exc, BlockingIOError):
                raise UsageError(f"{self.path} is being written by another program") from None
            raise
        self._file = os.fdopen(fd, "r+b")

    @property
    def size(self) -> int:
        """Bytes that are here."""
        return os.fstat(self._file.fileno()).st_size

    def cut(self, size: int) -> None:
        """Keep the first `size` bytes only."""
        self._file.truncate(size)

    def append(self, data: bytes | memoryview) -> None:
        """Add bytes; they are in the file when this returns, so that nothing is lost by a kill."""
        self._file.seek(0, os.SEEK_END)
        self._file.write(data)
        self._file.flush()

    def commit(self, mtime: int | None, *, keep_old: bool) -> None:
        """Give the file its name, once it is on the disk. mtime: None leaves the present."""
        os.fsync(self._file.fileno())
        if mtime is not None:
            os.utime(self.path, (mtime, mtime))
        if keep_old and self.local.exists() and not self._begins_like(self.local):
            self.local.rename(_free_name(self.local))
        self.path.replace(self.local)

    def _begins_like(self, old: Path) -> bool:
        """Return whether all of another file is at the beginning of this one."""
        self._file.seek(0)
        with old.open("rb") as other:
            while theirs := other.read(READ_SIZE):
                if self._file.read(len(theirs)) != theirs:
                    return False
        return True

    def drop(self) -> None:
        """Remove it."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Leave it for the next run, unless it is empty or has its name."""
        if self.size == 0:
            self.drop()
        self._file.close()


def _free_name(local: Path) -> Path:
    """Return NAME.~1~, or the first such name that is free, as cp --backup makes them."""
    number = 1
    while (place := local.with_name(f"{local.name}.~{number}~")).exists():
        number += 1
    return place


@dataclass(frozen=True, slots=True)
class Fetcher:
    """Fetches files of one session, one after the other."""

    session: Session
    progress: Progress
    verify: Verify = "auto"
    resume: bool = True

    async def fetch(self, wanted: Wanted, *, beginning: Path | None = None) -> Fetched:
        """Fetch a file, and go on when the vehicle is heard again after it was lost for a while.

        beginning: a local file that may hold its first bytes, where there is no .part.

        Raises:
            DataUnproven: size or checksum disagreed twice. StillGrowing, NotProvenYet: its .part stays.
            UsageError: the local disk does not take it. VehicleLost: it was not heard again within
            connect_timeout. Else as Files.open and OpenFile.read.
        """
        for _ in range(MAX_RETURNS):
            try:
                return await self._fetch(wanted, beginning)
            except (VehicleLost, RequestTimeout) as exc:
                if not self.session.silent():
                    raise
                self.progress.wait()
                if not await self.session.returned():
                    raise VehicleLost("the vehicle is silent") from exc
        raise VehicleLost(f"the vehicle was lost {MAX_RETURNS} times")

    async def _fetch(self, wanted: Wanted, beginning: Path | None) -> Fetched:
        if wanted.local.is_dir():
            raise UsageError(f"{wanted.local} is a directory")
        with local_disk(wanted.local):
            part = Part(wanted.part, wanted.local)
            try:
                if not self.resume or part.size > wanted.size:
                    part.cut(0)
                if beginning is not None and part.size == 0:
                    await trio.to_thread.run_sync(shutil.copyfile, beginning, part.path)
                return await self._fetch_and_commit(wanted, part)
            except DataUnproven:
                part.drop()
                raise
            finally:
                part.close()

    async def _fetch_and_commit(self, wanted: Wanted, part: Part) -> Fetched:
        resumed = part.size
        try:
            size, proof = await self._attempt(wanted, part)
        except DataUnproven:
            self.session.files.forget_caches()
            part.cut(0)
            resumed = 0
            size, proof = await self._attempt(wanted, part)
        await trio.to_thread.run_sync(lambda: part.commit(wanted.mtime, keep_old=wanted.keep_old))
        return Fetched(wanted.remote, wanted.local, wanted.name, size, resumed, proof)

    async def _attempt(self, wanted: Wanted, part: Part) -> tuple[int, str]:
        """Fetch what is missing, and prove the whole; returns its size, and how it was proven."""
        here = part.size
        self.progress.begin(wanted.name, wanted.size, here)
        crc = await trio.to_thread.run_sync(local_crc32, part.path) if here else 0
        size = wanted.size
        if here == 0 or here < wanted.size:
            file = await self.session.files.open(wanted.remote)
            try:
                size = file.size
                if here > size:
                    raise DataUnproven(f"{wanted.name} has shrunk from {here} to {size} bytes")
                crc = await self._copy(file, part, here, crc)
            finally:
                file.close()
        self.progress.check()
        return size, await self._prove(wanted, size, crc, resumed=here > 0)

    async def _copy(self, file: File, part: Part, offset: int, crc: int) -> int:
        """Append the rest of a file and return the CRC32 of all of it."""
        size = LEAST_READ
        while offset < file.size:
            began = trio.current_time()
            data = await file.read(offset, size)
            if not data:
                raise DataUnproven(f"the file ended at {offset} of {file.size} bytes")
            size = next_read_size(size, trio.current_time() - began)
            part.append(data)
            crc = crc32(data, crc)
            offset += len(data)
            self.progress.at(offset)
        return crc

    async def _prove(self, wanted: Wanted, size: int, crc: int, *, resumed: bool) -> str:
        """Compare with the vehicle's checksum where that is wanted and can be had; returns what was proven.

        Raises:
            DataUnproven: they differ, or what was resumed can only be had by fetching all of it again.
            StillGrowing, NotProvenYet.
        """
        if is_snapshot(self.session.on_vehicle(wanted.remote)):
            if resumed:
                raise DataUnproven(f"{wanted.name} is made anew at each opening, so it cannot be resumed")
            return "size (generated at each opening, so a checksum proves nothing)"
        if not proof_needed(self.verify, resumed=resumed, size=size):
            await self._require_size(wanted, size)
            return "size"
        try:
            theirs = await self.session.files.crc32(wanted.remote)
        except LinkError:
            raise
        except tuple(_NOT_NOW) as exc:
            why = next(words for kind, words in _NOT_NOW.items() if isinstance(exc, kind))
            await self._require_size(wanted, size)
            if resumed:
                raise NotProvenYet(
                    f"{wanted.name}: all of it is here, as {wanted.part}, but what an earlier run "
                    f"fetched is not proven ({why}); the next run tries again"
                ) from exc
            return f"size ({why})"
        except MavftpfsError as exc:
            await self._require_size(wanted, size)
            if resumed:
                raise DataUnproven(f"{wanted.name}: the vehicle computes no checksum: {exc}") from exc
            return "size (the vehicle refused to compute a checksum)"
        if theirs != crc:
            await self._require_size(wanted, size)
            raise DataUnproven(
                f"{wanted.name}: {size} bytes came with CRC32 {crc:08x}, the vehicle has {theirs:08x}"
            )
        return "size and CRC32"

    async def _require_size(self, wanted: Wanted, size: int) -> None:
        """Ask for the size again: no checksum says that the file was whole.

        Raises:
            StillGrowing: it has become larger. DataUnproven: it has become smaller.
        """
        files = self.session.files
        files.expire(wanted.remote)
        now = (await files.stat(wanted.remote)).size
        if now > size:
            raise StillGrowing(
                f"{wanted.name} is still growing: its first {readable_size(size)} are here, as {wanted.part}"
            )
        if now < size:
            raise DataUnproven(f"{name_text(wanted.remote)} has shrunk from {size} to {now} bytes")


def named(path: bytes, error: MavftpfsError) -> str:
    """Return an error with the name of what it is about, which some have already."""
    name, text = name_text(path), str(error)
    return text if name in text else f"{name}: {text}"
