"""Downloads one file, resumes after an interruption, and verifies it. Layer: client.

The bytes go into NAME.part, which gets its name only when the file is whole. If an earlier run left a .part,
the download resumes it, and then the vehicle's CRC32 of the whole file must agree.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import trio

from mavftpfs.client.compare import (
    GENERATED,
    Comparison,
    Content,
    Match,
    Verify,
    compare,
    local_crc32,
    wants_checksum,
)
from mavftpfs.client.files import READ_SIZE, Session, reading
from mavftpfs.client.progress import Progress
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import (
    DataUnproven,
    IsADirectory,
    MavftpfsError,
    RequestTimeout,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from mavftpfs.shared.readable import name_text, readable_size

LEAST_READ, LARGEST_READ = 2048, 128 * 1024
"""Bytes of one read."""
QUICK, SLOW = 0.25, 1.0
"""Seconds of one read: after a shorter one the next read is larger, after a longer one it is smaller."""

EARLIEST = 946_684_800
"""2000-01-01 UTC: an earlier time is meaningless."""


def known_time(mtime: int) -> int | None:
    """Return a listed time, None if it is meaningless."""
    return mtime if mtime >= EARLIEST else None


def next_read_size(size: int, took: float) -> int:
    """Return the size of the next read, after `size` bytes took so many seconds.

    After each read the bytes are safe in the .part, and the screen shows them. So on a radio a read should
    take about a second.
    """
    if took < QUICK:
        return min(size * 2, LARGEST_READ)
    return max(int(size * QUICK / took), LEAST_READ) if took > SLOW else size


PART_SUFFIX = ".part"


class LocalTrouble(UsageError):
    """The local disk is full, or gone."""


class StillGrowing(MavftpfsError):
    """The vehicle is writing the file; the downloaded bytes stay as its .part.

    Attributes:
        came: number of downloaded bytes.
    """

    def __init__(self, reason: str, came: int) -> None:
        super().__init__(reason)
        self.came = came


class NotProvenYet(MavftpfsError):
    """The .part is complete, but some bytes are from an earlier run, and nothing verifies them now."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A file to download. name: for people; size: as listed; mtime: seconds UTC, None if unknown.

    keep_old: a local file of that name may be the beginning of this one; otherwise it is renamed to
    NAME.~1~. growing: the vehicle still writes the file, so its present bytes stay a .part.
    """

    remote: bytes
    name: str
    size: int
    mtime: int | None
    local: Path
    keep_old: bool = False
    growing: bool = False

    @property
    def part(self) -> Path:
        """The local file for the bytes until all have arrived."""
        return self.local.with_name(self.local.name + PART_SUFFIX)

    @property
    def here(self) -> bool:
        """Whether a local file has its name and its size."""
        return _size(self.local) == self.size

    @property
    def begun(self) -> int:
        """Bytes from which the download can resume: of the .part, or of a local file that may be the
        beginning."""
        part = _size(self.part)
        if 0 < part <= self.size:
            return part
        old = _size(self.local) if self.keep_old else 0
        return old if 0 < old < self.size else 0


def _still_growing(name: str, came: int) -> StillGrowing:
    return StillGrowing(f"{name} is still growing: only its first {readable_size(came)} are here", came)


def _size(path: Path) -> int:
    """Return the size of a local file; -1 if there is none."""
    try:
        return path.stat().st_size if path.is_file() else -1
    except OSError:
        return -1


@dataclass(frozen=True, slots=True)
class Fetched:
    """A downloaded file. resumed: bytes from an earlier run; was_here: the whole file was here under its
    name; kept: the new name of another file that had its name.
    """

    wanted: Wanted
    size: int
    resumed: int
    verified: Comparison
    was_here: bool = False
    kept: Path | None = None

    @property
    def proven(self) -> bool:
        """Whether its checksum was compared, or is not required."""
        return not (self.verified.lacking and self.verified.later)

    @property
    def kept_words(self) -> str:
        """The words about the other file, if there was one."""
        return "" if self.kept is None else f"; another one of that name is kept as {self.kept.name}"


@contextmanager
def local_disk(place: Path) -> Iterator[None]:
    """Turn an error of the local disk into a UsageError with a line for people."""
    try:
        yield
    except OSError as exc:
        full = exc.errno in (errno.ENOSPC, errno.EDQUOT)
        raise (LocalTrouble if full else UsageError)(f"{place}: {exc.strerror}") from exc


class Part:
    """A .part, locked against another program that downloads the same file."""

    def __init__(self, path: Path, local: Path) -> None:
        """Open and lock it. Raises: UsageError: the path is not a file, or is in use. OSError."""
        self.local = local
        self.path = path
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        fd = os.open(self.path, flags, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise UsageError(f"{self.path} is not a file; remove or rename it")
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.lstat(self.path).st_ino != os.fstat(fd).st_ino:
                raise FileNotFoundError
        except BaseException as exc:
            os.close(fd)
            if isinstance(exc, BlockingIOError | FileNotFoundError):  # the other program has, or finished, it
                raise UsageError(f"{self.path} is being written by another program") from None
            raise
        self._file = os.fdopen(fd, "r+b")

    @property
    def size(self) -> int:
        """The number of bytes in the .part."""
        return os.fstat(self._file.fileno()).st_size

    def cut(self, size: int) -> None:
        """Keep the first `size` bytes only."""
        self._file.truncate(size)

    def append(self, data: bytes | memoryview) -> None:
        """Append bytes, and write them to the file at once, so that a kill loses nothing."""
        self._file.seek(0, os.SEEK_END)
        self._file.write(data)
        self._file.flush()

    def commit(self, mtime: int | None, *, keep_old: bool) -> Path | None:
        """Sync the .part to the disk, and give it its final name; return the new name of another file that
        had that name. mtime: None for the present time."""
        kept: Path | None = None
        os.fsync(self._file.fileno())
        if mtime is not None:
            os.utime(self.path, (mtime, mtime))
        if keep_old and self.local.exists() and not self._begins_like(self.local):
            kept = self.local.rename(_free_name(self.local))
        self.path.replace(self.local)
        return kept

    def _begins_like(self, old: Path) -> bool:
        """Return whether another file equals the beginning of this one."""
        self._file.seek(0)
        with old.open("rb") as other:
            while theirs := other.read(READ_SIZE):
                if self._file.read(len(theirs)) != theirs:
                    return False
        return True

    def drop(self) -> None:
        """Remove the .part."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the .part. It stays for the next run, unless it is empty or has its final name."""
        if self.size == 0:
            self.drop()
        self._file.close()


def _free_name(local: Path) -> Path:
    """Return NAME.~1~, or the first such name that is free, in the style of cp --backup."""
    number = 1
    while (place := local.with_name(f"{local.name}.~{number}~")).exists():
        number += 1
    return place


Take = Callable[[bytes | memoryview], Awaitable[None]]
"""Takes the next bytes of a file."""


@dataclass(frozen=True, slots=True)
class Fetcher:
    """Downloads files of one session, one after the other."""

    session: Session
    progress: Progress
    verify: Verify = "auto"

    async def fetch(self, wanted: Wanted) -> Fetched:
        """Download a file. If the vehicle is lost meanwhile, wait for it, and resume.

        Raises:
            DataUnproven: size or checksum differed twice. StillGrowing, NotProvenYet: the .part stays.
                UsageError: the local disk refuses the file. VehicleLost: the vehicle stayed silent for
                connect_timeout. Otherwise as Files.open and File.read.
        """
        while True:
            try:
                with local_disk(wanted.local):
                    return await self._fetch(wanted)
            except (VehicleLost, RequestTimeout) as exc:
                if not await self.session.lost():
                    raise
                if not await self.session.returned():
                    raise VehicleLost("the vehicle is silent") from exc

    async def write_to(self, remote: bytes, take: Take) -> None:
        """Pass the bytes of a file on, and verify them.

        Raises:
            IsADirectory. DataUnproven, StillGrowing: the vehicle's file differs. Otherwise as `fetch`.
        """
        name = name_text(remote)
        if (await self.session.files.stat(remote)).kind is EntryKind.DIRECTORY:
            raise IsADirectory(f"{name} is a directory")
        content = await self._copy(remote, take, Content(0, 0))
        await self._verify(remote, name, content, resumed=False)

    async def _fetch(self, wanted: Wanted) -> Fetched:
        if wanted.local.is_dir():
            raise UsageError(f"{wanted.local} is a directory")
        if wanted.local.name.endswith(PART_SUFFIX):
            raise UsageError(
                f"{wanted.local} would be taken for an unfinished download; get it alone, with another name: "
                f"--to NAME"
            )
        verified = await self._compare_here(wanted) if wanted.here else None
        if verified is not None:
            return Fetched(wanted, wanted.size, wanted.size, verified, was_here=True)
        if wanted.keep_old:  # a log keeps its directory
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

    async def _compare_here(self, wanted: Wanted) -> Comparison | None:
        """Compare a local file of the right size; return None if the file must be downloaded.

        Without a checksum, the size is enough for a log, and another file needs the same time, too.
        """
        checksum = wants_checksum(self.verify, wanted.size)
        self.progress.begin(wanted.name, wanted.size, wanted.size)
        if checksum:
            self.progress.check()
        found = await compare(self.session, wanted.remote, wanted.local, size=wanted.size, checksum=checksum)
        if found is GENERATED or found.match is Match.DIFFERS:
            return None
        if found.match is Match.SAME or wanted.keep_old:
            return found
        same_time = int(wanted.local.stat().st_mtime) == wanted.mtime
        return replace(found, how="size and time") if same_time else None

    async def _fetch_and_commit(self, wanted: Wanted, part: Part) -> Fetched:
        resumed = part.size
        try:
            size, verified = await self._attempt(wanted, part)
        except DataUnproven:
            await self.session.files.refresh()
            part.cut(0)
            resumed = 0
            size, verified = await self._attempt(wanted, part)
        kept = await trio.to_thread.run_sync(lambda: part.commit(wanted.mtime, keep_old=wanted.keep_old))
        return Fetched(wanted, size, resumed, verified, kept=kept)

    async def _attempt(self, wanted: Wanted, part: Part) -> tuple[int, Comparison]:
        """Download the missing bytes, and verify the whole; return its size, and how it was verified."""
        here = part.size
        self.progress.begin(wanted.name, wanted.size, here)
        content = Content(here, await local_crc32(part.path) if here else 0)

        async def take(data: bytes | memoryview) -> None:
            part.append(data)

        if here == 0 or here < wanted.size:
            content = await self._copy(wanted.remote, take, content)
        if wanted.growing:
            raise _still_growing(wanted.name, content.size)
        self.progress.check()
        return content.size, await self._verify(wanted.remote, wanted.name, content, resumed=here > 0)

    async def _copy(self, remote: bytes, take: Take, here: Content) -> Content:
        """Pass on the bytes of a file behind the local ones; return all local bytes after that."""
        amount = LEAST_READ
        offset, crc = here
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
            return Content(file.size, crc)

    async def _verify(self, remote: bytes, name: str, content: Content, *, resumed: bool) -> Comparison:
        """Compare the downloaded bytes with the vehicle's file; return how they were verified.

        Raises:
            DataUnproven: the bytes differ, or a resumed file must be downloaded again from the beginning.
            StillGrowing, NotProvenYet.
        """
        checksum = wants_checksum(self.verify, content.size, resumed=resumed)
        found = await compare(self.session, remote, content, size=content.size, checksum=checksum)
        if found is GENERATED and resumed:
            raise DataUnproven(f"{name} is generated at each opening, so it cannot be resumed")
        if found is GENERATED or found.match is Match.SAME:
            return found
        await self._require_size(remote, name, content.size)
        if found.match is Match.DIFFERS:
            raise DataUnproven(f"{name}: {found.how}")
        if not resumed:
            return found
        if not found.later:
            raise DataUnproven(f"{name} was resumed, and there is no checksum: {found.lacking}")
        raise NotProvenYet(f"all of {name} is here, as {PART_SUFFIX}, but not verified: {found.lacking}")

    async def _require_size(self, remote: bytes, name: str, size: int) -> None:
        """Ask for the size again, because no checksum shows that the file is whole.

        Raises:
            StillGrowing: the file has become larger. DataUnproven: the file has become smaller.
        """
        now = await self.session.size_now(remote)
        if now > size:
            raise _still_growing(name, size)
        if now < size:
            raise DataUnproven(f"{name} has shrunk from {size} to {now} bytes")
