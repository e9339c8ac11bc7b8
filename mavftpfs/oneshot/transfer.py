"""Fetching files and directories, to disk or stdout, and putting local ones. Layer: top; prints nothing.

A file counts as put when fsync says that it is on the card, checked; until then progress is what the vehicle
has acknowledged.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.compose import plain_nursery
from mavftpfs.oneshot.fetch import (
    NO_CHECKSUM,
    Complain,
    Fetched,
    Fetcher,
    LocalDiskFull,
    Verify,
    Wanted,
    known_time,
    local_disk,
    named,
    part_of,
    proof_needed,
)
from mavftpfs.oneshot.files import READ_SIZE, File, Session, is_directory
from mavftpfs.oneshot.names import emptied, make_directory
from mavftpfs.oneshot.progress import Progress
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import (
    CrossDevice,
    DataUnproven,
    IsADirectory,
    LinkError,
    MavftpfsError,
    NotADirectory,
    NotDelivered,
    UsageError,
)
from mavftpfs.shared.model import EntryKind, is_snapshot, join, split
from mavftpfs.shared.readable import name_text

Tell = Callable[[Fetched], None]


@dataclass(slots=True)
class Got:
    """How far a run came. planned: files that were found; failed: what was complained of."""

    planned: int = 0
    done: int = 0
    failed: int = 0


@dataclass(slots=True)
class _Getter:
    session: Session
    recursive: bool
    complain: Complain
    got: Got
    keep_going: bool
    found: list[tuple[bytes, Path, Stat]] = field(default_factory=list)

    def failed(self, path: bytes, error: MavftpfsError) -> None:
        """Say it and go on, or end where only one thing was asked for."""
        if not self.keep_going or isinstance(error, LinkError | LocalDiskFull):
            raise error
        self.got.failed += 1
        self.complain(named(path, error))

    async def plan(self, path: bytes, place: Path) -> None:
        """Collect the files of a path, and make the directories for them."""
        try:
            found = await self.session.files.stat(path)
            if found.kind is EntryKind.DIRECTORY and not self.recursive:
                raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
        except MavftpfsError as exc:
            self.failed(path, exc)
            return
        pending = [(path, place, found)]
        while pending:
            remote, local, stat = pending.pop()
            if stat.kind is EntryKind.FILE:
                self.found.append((remote, local, stat))
                continue
            try:
                with local_disk(local):
                    local.mkdir(parents=True, exist_ok=True)
                entries = await self.session.files.list(remote)
            except MavftpfsError as exc:
                self.failed(remote, exc)
                continue
            self.keep_going = True
            for name, below in reversed(entries):
                pending.append((join(remote, name), local / os.fsdecode(name), below))

    def wanted(self) -> list[Wanted]:
        """Return what was found, as Fetcher takes it."""
        finals = {local for _, local, _ in self.found}
        return [
            Wanted(
                remote, local, name_text(remote), stat.size, known_time(stat.mtime), part_of(local, finals)
            )
            for remote, local, stat in self.found
        ]


async def get_paths(
    fetcher: Fetcher,
    paths: Sequence[bytes],
    local: Path,
    tell: Tell,
    complain: Complain,
    got: Got,
    *,
    recursive: bool,
) -> None:
    """Fetch files, and with `recursive` directories, to `local` (a directory, or a new name for one file).

    Of several things the others go on when one fails, which `complain` is told; `got` counts them.

    Raises:
        As Fetcher.fetch where only one file is asked for; LinkError, and a full local disk, always.
    """
    getter = _Getter(fetcher.session, recursive, complain, got, keep_going=len(paths) > 1)
    for path in paths:
        await getter.plan(path, local_name(local, path, single=len(paths) == 1))
    all_wanted = getter.wanted()
    got.planned = len(all_wanted)
    fetcher.progress.plan(got.planned, sum(wanted.size for wanted in all_wanted))
    for wanted in all_wanted:
        try:
            fetched = await fetcher.fetch(wanted)
        except MavftpfsError as exc:
            getter.failed(wanted.remote, exc)
        else:
            got.done += 1
            tell(fetched)
        fetcher.progress.end(wanted.size)


def local_name(local: Path, path: bytes, *, single: bool) -> Path:
    """Return where a remote path goes: into a directory, or under the new name of a single thing."""
    name = os.fsdecode(split(path)[1])
    return local / name if local.is_dir() or not single else local


# -- to stdout ------------------------------------------------------------------------------------


async def cat_paths(
    session: Session, paths: Sequence[bytes], out: BinaryIO, verify: Verify, complain: Complain, got: Got
) -> None:
    """Write files one behind the other to `out`, and prove what was written.

    Raises:
        As get_paths. DataUnproven: what was written is not what the vehicle has.
    """
    got.planned = len(paths)
    for path in paths:
        try:
            await _cat(session, path, out, verify)
            got.done += 1
        except MavftpfsError as exc:
            if len(paths) == 1 or isinstance(exc, LinkError):
                raise
            got.failed += 1
            complain(named(path, exc))


async def _cat(session: Session, path: bytes, out: BinaryIO, verify: Verify) -> None:
    if (await session.files.stat(path)).kind is EntryKind.DIRECTORY:
        raise IsADirectory(f"{name_text(path)} is a directory")
    file = await session.files.open(path)
    crc = offset = 0
    try:
        while offset < file.size:
            data = await file.read(offset, READ_SIZE)
            if not data:
                raise DataUnproven(f"{name_text(path)} ended at {offset} of {file.size} bytes")
            crc = crc32(data, crc)
            offset += len(data)
            # In a thread: who reads may take its time, and the vehicle is to hear of us meanwhile.
            await trio.to_thread.run_sync(_write, out, bytes(data), abandon_on_cancel=True)
    finally:
        file.close()
    if is_snapshot(session.on_vehicle(path)) or not proof_needed(verify, resumed=False, size=offset):
        return
    try:
        theirs = await session.files.crc32(path)
    except NO_CHECKSUM:
        return
    if theirs != crc:
        raise DataUnproven(
            f"{name_text(path)}: what was written has CRC32 {crc:08x}, the vehicle's file {theirs:08x}"
        )


def _write(out: BinaryIO, data: bytes) -> None:
    out.write(data)
    out.flush()


WITHDRAWAL_TIME = 10.0
"""Seconds to take back what a mount was given."""

ASK_PERIOD = 0.25
"""Seconds between two looks at how much the vehicle has acknowledged."""


@dataclass(frozen=True, slots=True)
class Sent:
    """One file that is on the vehicle. size in bytes."""

    remote: bytes
    size: int


@dataclass(slots=True)
class Put:
    """How far a run came. at_work: the file that is on its way, None before and after."""

    planned: int = 0
    done: int = 0
    at_work: bytes | None = None


@dataclass(frozen=True, slots=True)
class Piece:
    """Something local to be put. below: its path below the target, without a slash before it; b"" = there.
    size: bytes, 0 for a directory."""

    local: Path
    below: bytes
    is_directory: bool
    size: int = 0


def collect(local: Path, *, recursive: bool) -> list[Piece]:
    """Return a file, or a directory with all below, parents first.

    Raises:
        UsageError: it is not there or not readable, is neither file nor directory, or a directory without
            `recursive`. Symbolic links to files count as files; cards have no links.
    """
    if not local.is_dir():
        return [_piece(local, b"")]
    if not recursive:
        raise UsageError(f"{local} is a directory; put it with -r")
    pieces = [Piece(local, b"", True)]

    def fail(error: OSError) -> None:
        raise UsageError(f"{error.filename}: {error.strerror}") from error

    for folder, directories, files in os.walk(local, onerror=fail):
        directories.sort()
        for name in sorted([*directories, *files]):
            path = Path(folder, name)
            pieces.append(_piece(path, os.fsencode(path.relative_to(local))))
    return pieces


def _piece(local: Path, below: bytes) -> Piece:
    if local.is_symlink() and local.is_dir():
        raise UsageError(f"{local} is a link to a directory; a card cannot hold links")
    if local.is_dir():
        return Piece(local, below, True)
    if not local.exists():
        raise UsageError(f"{local} is not there")
    if not local.is_file():
        raise UsageError(f"{local} is neither a file nor a directory")
    return Piece(local, below, False, local.stat().st_size)


async def put_paths(
    session: Session,
    batches: Sequence[tuple[Path, Sequence[Piece]]],
    path: bytes,
    progress: Progress,
    tell: Callable[[Sent], None],
    put: Put,
) -> None:
    """Put what `collect` found to `path`: an existing directory, or a new name for one thing.

    `put` counts, also for a run that is ended.

    Raises:
        NotADirectory: several things, and `path` is no directory. UsageError: of what is local.
        NotDelivered: a file did not get to the vehicle; what was told before is there.
    """
    into = await is_directory(session.files, path)
    if not into and len(batches) > 1:
        raise NotADirectory(f"{name_text(path)} is no directory, so only one thing can be put there")
    files = [piece for _, pieces in batches for piece in pieces if not piece.is_directory]
    put.planned = len(files)
    progress.plan(len(files), sum(piece.size for piece in files))
    putter = _Putter(session, progress, tell, put)
    for local, pieces in batches:
        place = join(path, os.fsencode(local.absolute().name)) if into else path
        for piece in pieces:
            await putter.put(piece, join(place, piece.below) if piece.below else place)


@dataclass(slots=True)
class _Putter:
    session: Session
    progress: Progress
    tell: Callable[[Sent], None]
    counts: Put

    async def put(self, piece: Piece, remote: bytes) -> None:
        """Put one thing.

        Raises:
            UsageError, NotDelivered.
        """
        if piece.is_directory:
            await make_directory(self.session.files, remote, may_exist=True)
            return
        self.counts.at_work = remote
        try:
            with piece.local.open("rb") as source:
                self.progress.begin(name_text(remote), piece.size)
                size = await self._send(source, remote)
        except OSError as exc:
            raise UsageError(f"{piece.local}: {exc.strerror}") from exc
        except MavftpfsError as exc:
            done = f"; {self.counts.done} file(s) before it are there" if self.counts.done else ""
            raise NotDelivered(f"{name_text(remote)} was not delivered: {exc}{done}") from exc
        self.counts.at_work = None
        self.counts.done += 1
        self.progress.end(piece.size)
        self.tell(Sent(remote, size))

    async def _send(self, source: BinaryIO, remote: bytes) -> int:
        if self.session.mountpoint is not None:
            try:
                return await self._send_beside(source, remote)
            except CrossDevice:  # this server cannot rename
                source.seek(0)
        file = await emptied(self.session.files, remote)
        try:
            async with _watched(self.session, remote, self.progress):
                return await _copy(source, file)
        finally:
            file.close()

    async def _send_beside(self, source: BinaryIO, remote: bytes) -> int:
        """Write a new file beside and rename it: of a put that was interrupted a mount would go on to deliver
        what it was given."""
        files = self.session.files
        beside = join(split(remote)[0], b".put-" + secrets.token_hex(4).encode())
        file = await files.create(beside, exclusive=True)
        try:
            async with _watched(self.session, beside, self.progress):
                size = await _copy(source, file)
            file.close()
            await files.rename(beside, remote)
        except BaseException:
            with trio.move_on_after(WITHDRAWAL_TIME) as patience, suppress(MavftpfsError):
                patience.shield = True
                await files.unlink(beside)  # while it is open: closing delivers what has a name
            file.close()
            raise
        return size


async def _copy(source: BinaryIO, file: File) -> int:
    offset = 0
    while data := source.read(READ_SIZE):
        offset += await file.write(offset, data)
    await file.fsync()
    return offset


@asynccontextmanager
async def _watched(session: Session, path: bytes, progress: Progress) -> AsyncIterator[None]:
    """Tell progress what the vehicle has acknowledged of a file while the body sends it."""
    name = session.on_vehicle(path).decode(errors="replace")

    async def watch() -> None:
        while True:
            await trio.sleep(ASK_PERIOD)
            for facts in await session.transfers():
                if facts["path"] == name:
                    _show(facts["size"] - facts["bytes_left"], progress)

    async with plain_nursery() as nursery:
        nursery.start_soon(watch)
        yield


def _show(acknowledged: int, progress: Progress) -> None:
    if acknowledged >= progress.size:
        progress.at(progress.size)
        progress.check()
    else:
        progress.at(acknowledged)
