"""Fetching one file so that it can go on after an interruption, and is proven. Layer: client.

A file is kept as NAME.part until it is whole; only then it gets its name. If an earlier run left a .part, the
fetch goes on with it, and then the vehicle's CRC32 of the whole file must agree.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
from collections.abc import Awaitable, Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import trio

from mavftpfs.client.files import READ_SIZE, Session, reading
from mavftpfs.client.progress import Progress
from mavftpfs.client.proof import (
    BY_CRC32,
    BY_SIZE,
    GENERATED,
    NOT_ASKED,
    Proof,
    Verify,
    ask_crc32,
    local_crc32,
    proof_needed,
)
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import (
    DataUnproven,
    IsADirectory,
    MavftpfsError,
    RequestTimeout,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind, is_snapshot
from mavftpfs.shared.readable import name_text, readable_size

LEAST_READ, LARGEST_READ = 2048, 128 * 1024
"""Bytes of one read."""
QUICK, SLOW = 0.25, 1.0
"""Seconds: a read that took less is followed by a larger one, one that took more by a smaller one."""

EARLIEST = 946_684_800
"""2000-01-01 UTC: an earlier time tells people nothing."""


def known_time(mtime: int) -> int | None:
    """Return a listed time, None if it tells nothing."""
    return mtime if mtime >= EARLIEST else None


def next_read_size(size: int, took: float) -> int:
    """Return how much to read next, after `size` bytes took so many seconds.

    After each read the bytes are safe in the .part, and the screen shows them. On a radio that should be
    about every second.
    """
    if took < QUICK:
        return min(size * 2, LARGEST_READ)
    return max(int(size * QUICK / took), LEAST_READ) if took > SLOW else size


PART_SUFFIX = ".part"
MAX_RETURNS = 20
"""How often a vehicle may vanish and return while one file is fetched."""


class LocalDiskFull(UsageError):
    """Nothing more can be written on the local disk."""


class StillGrowing(MavftpfsError):
    """The vehicle is writing the file; the bytes that came so far are kept as its .part.

    Attributes:
        came: the bytes that are here.
    """

    def __init__(self, reason: str, came: int) -> None:
        super().__init__(reason)
        self.came = came


class NotProvenYet(MavftpfsError):
    """All bytes are in the .part, but some are of an earlier run and nothing proves them now."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A file to fetch. name: for people; size: as listed; mtime: seconds UTC, None if unknown.

    part: where it lies until it is whole. keep_old: a local file of that name may be the beginning of this
    one; if it is not, it is renamed to NAME.~1~.
    """

    remote: bytes
    name: str
    size: int
    mtime: int | None
    local: Path
    part: Path
    keep_old: bool = False

    @property
    def here(self) -> bool:
        """Whether a local file has its name and its size."""
        return _size(self.local) == self.size

    @property
    def begun(self) -> int:
        """Bytes from which the fetch can go on: of the .part, or of a local file that may be the
        beginning."""
        part = _size(self.part)
        if 0 < part <= self.size:
            return part
        old = _size(self.local) if self.keep_old else 0
        return old if 0 < old < self.size else 0


def _size(path: Path) -> int:
    """Return the size of a local file; -1 where none is."""
    try:
        return path.stat().st_size if path.is_file() else -1
    except OSError:
        return -1


@dataclass(frozen=True, slots=True)
class Fetched:
    """A file that is here. resumed: bytes that were here before; was_here: the whole file was here under its
    name; kept: the new name of another file that had its name.
    """

    wanted: Wanted
    size: int
    resumed: int
    proof: Proof
    was_here: bool = False
    kept: Path | None = None

    @property
    def kept_words(self) -> str:
        """The words about the other file, if there was one."""
        return "" if self.kept is None else f"; another one of that name is kept as {self.kept.name}"


def part_of(local: Path, finals: Collection[Path] = ()) -> Path:
    """Return where a file lies until it is whole. finals: the final names of all files of the run."""
    part = local.with_name(local.name + PART_SUFFIX)
    return part if part not in finals else local.with_name(f"{local.name}.mavftpfs{PART_SUFFIX}")


@contextmanager
def local_disk(place: Path) -> Iterator[None]:
    """Turn an error of the local disk into one of ours, which says so in a line."""
    try:
        yield
    except OSError as exc:
        full = exc.errno in (errno.ENOSPC, errno.EDQUOT)
        raise (LocalDiskFull if full else UsageError)(f"{place}: {exc.strerror}") from exc


class Part:
    """A .part, locked against another program that fetches the same file."""

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
            if os.lstat(self.path).st_ino != os.fstat(fd).st_ino:
                raise FileNotFoundError
        except BaseException as exc:
            os.close(fd)
            if isinstance(exc, BlockingIOError | FileNotFoundError):  # it has, or just finished the file
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

    def commit(self, mtime: int | None, *, keep_old: bool) -> Path | None:
        """Give the file its name, once it is on the disk; return the new name of another file that had it.
        mtime: None for the present time."""
        kept: Path | None = None
        os.fsync(self._file.fileno())
        if mtime is not None:
            os.utime(self.path, (mtime, mtime))
        if keep_old and self.local.exists() and not self._begins_like(self.local):
            kept = self.local.rename(_free_name(self.local))
        self.path.replace(self.local)
        return kept

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
        """Leave it for the next run, unless it is empty or got its name."""
        if self.size == 0:
            self.drop()
        self._file.close()


def _free_name(local: Path) -> Path:
    """Return NAME.~1~, or the first such name that is free, as cp --backup makes them."""
    number = 1
    while (place := local.with_name(f"{local.name}.~{number}~")).exists():
        number += 1
    return place


Take = Callable[[bytes | memoryview], Awaitable[None]]
"""Takes the next bytes of a file."""


@dataclass(frozen=True, slots=True)
class Fetcher:
    """Fetches files of one session, one after the other."""

    session: Session
    progress: Progress
    verify: Verify = "auto"

    async def fetch(self, wanted: Wanted) -> Fetched:
        """Fetch a file. If the vehicle is lost for a while, go on when it is heard again.

        Raises:
            DataUnproven: size or checksum disagreed twice. StillGrowing, NotProvenYet: its .part stays.
            UsageError: the local disk does not take it. VehicleLost: it was not heard again within
            connect_timeout. Else as Files.open and OpenFile.read.
        """
        for _ in range(MAX_RETURNS):
            try:
                return await self._fetch(wanted)
            except (VehicleLost, RequestTimeout) as exc:
                if not await self.session.lost():
                    raise
                if not await self.session.returned():
                    raise VehicleLost("the vehicle is silent") from exc
        raise VehicleLost(f"the vehicle was lost {MAX_RETURNS} times")

    async def write_to(self, remote: bytes, take: Take) -> None:
        """Hand a file's bytes on, and prove them.

        Raises:
            IsADirectory. DataUnproven, StillGrowing: it is not what the vehicle has. Else as `fetch`.
        """
        name = name_text(remote)
        if (await self.session.files.stat(remote)).kind is EntryKind.DIRECTORY:
            raise IsADirectory(f"{name} is a directory")
        size, crc = await self._copy(remote, take, 0, 0)
        await self._prove(remote, name, size, crc, resumed=False)

    async def _fetch(self, wanted: Wanted) -> Fetched:
        if wanted.local.is_dir():
            raise UsageError(f"{wanted.local} is a directory")
        with local_disk(wanted.local):
            proof = await self._prove_here(wanted) if wanted.here else None
            if proof is not None:
                return Fetched(wanted, wanted.size, wanted.size, proof, was_here=True)
            if wanted.keep_old:  # logs keep their directories
                wanted.local.parent.mkdir(parents=True, exist_ok=True)
            part = Part(wanted.part, wanted.local)
            try:
                begun = wanted.begun
                if part.size != begun:
                    part.cut(0)
                    if begun:
                        await trio.to_thread.run_sync(shutil.copyfile, wanted.local, part.path)
                return await self._fetch_and_commit(wanted, part)
            except DataUnproven:
                part.drop()
                raise
            finally:
                part.close()

    async def _prove_here(self, wanted: Wanted) -> Proof | None:
        """Return how a local file of the same size was proven to be this one; None if it is another one, or
        that is not known. A log counts as the same by its size; any other file needs the same time, too."""
        if is_snapshot(self.session.on_vehicle(wanted.remote)):
            return None
        answer = NOT_ASKED
        self.progress.begin(wanted.name, wanted.size, wanted.size)
        if proof_needed(self.verify, resumed=False, size=wanted.size):
            self.progress.check()
            answer = await ask_crc32(self.session, wanted.remote)
        if answer.crc is not None:
            return BY_CRC32 if answer.crc == await local_crc32(wanted.local) else None
        if wanted.keep_old:
            return Proof("size", answer.lacking, answer.later)
        same_time = int(wanted.local.stat().st_mtime) == wanted.mtime
        return Proof("size and time", answer.lacking, answer.later) if same_time else None

    async def _fetch_and_commit(self, wanted: Wanted, part: Part) -> Fetched:
        resumed = part.size
        try:
            size, proof = await self._attempt(wanted, part)
        except DataUnproven:
            await self.session.files.refresh()
            part.cut(0)
            resumed = 0
            size, proof = await self._attempt(wanted, part)
        kept = await trio.to_thread.run_sync(lambda: part.commit(wanted.mtime, keep_old=wanted.keep_old))
        return Fetched(wanted, size, resumed, proof, kept=kept)

    async def _attempt(self, wanted: Wanted, part: Part) -> tuple[int, Proof]:
        """Fetch what is missing, and prove the whole; returns its size, and how it was proven."""
        here = size = part.size
        self.progress.begin(wanted.name, wanted.size, here)
        crc = await local_crc32(part.path) if here else 0

        async def take(data: bytes | memoryview) -> None:
            part.append(data)

        if here == 0 or here < wanted.size:
            size, crc = await self._copy(wanted.remote, take, here, crc)
        self.progress.check()
        return size, await self._prove(wanted.remote, wanted.name, size, crc, resumed=here > 0)

    async def _copy(self, remote: bytes, take: Take, offset: int, crc: int) -> tuple[int, int]:
        """Hand on a file from `offset` on. crc: that of the bytes before. Returns its size and CRC32."""
        amount = LEAST_READ
        async with reading(self.session.files, remote) as file:
            if offset > file.size:
                raise DataUnproven(f"{name_text(remote)} has shrunk from {offset} to {file.size} bytes")
            while offset < file.size:
                began = trio.current_time()
                data = await file.read(offset, amount)
                if not data:
                    raise DataUnproven(f"{name_text(remote)} ended at {offset} of {file.size} bytes")
                amount = next_read_size(amount, trio.current_time() - began)
                await take(data)
                crc = crc32(data, crc)
                offset += len(data)
                self.progress.at(offset)
            return file.size, crc

    async def _prove(self, remote: bytes, name: str, size: int, crc: int, *, resumed: bool) -> Proof:
        """Compare with the vehicle's checksum if that is wanted and can be had; return what was proven.

        Raises:
            DataUnproven: they differ, or a file that was resumed has to be fetched again from the beginning.
            StillGrowing, NotProvenYet.
        """
        if is_snapshot(self.session.on_vehicle(remote)):
            if resumed:
                raise DataUnproven(f"{name} is made anew at each opening, so it cannot be resumed")
            return GENERATED
        answer = NOT_ASKED
        if proof_needed(self.verify, resumed=resumed, size=size):
            answer = await ask_crc32(self.session, remote)
        if answer.crc == crc:
            return BY_CRC32
        await self._require_size(remote, name, size)
        if answer.crc is not None:
            raise DataUnproven(
                f"{name}: {size} bytes came with CRC32 {crc:08x}, the vehicle has {answer.crc:08x}"
            )
        if not resumed:
            return replace(BY_SIZE, lacking=answer.lacking, later=answer.later)
        if not answer.later:
            raise DataUnproven(f"{name} was resumed, and there is no checksum: {answer.lacking}")
        raise NotProvenYet(f"all of {name} is here, as {PART_SUFFIX}, but not proven: {answer.lacking}")

    async def _require_size(self, remote: bytes, name: str, size: int) -> None:
        """Ask for the size again, because no checksum proves that the file is whole.

        Raises:
            StillGrowing: it has become larger. DataUnproven: it has become smaller.
        """
        now = await self.session.size_now(remote)
        if now > size:
            raise StillGrowing(f"{name} is still growing: only its first {readable_size(size)} came", size)
        if now < size:
            raise DataUnproven(f"{name} has shrunk from {size} to {now} bytes")
