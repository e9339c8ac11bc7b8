"""Putting local files on the vehicle. Layer: top; prints nothing.

A file counts as put when fsync says that it is on the card, checked; until then progress is what the vehicle
has acknowledged.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import trio

from mavftpfs.exits import NotDelivered
from mavftpfs.oneshot.files import READ_SIZE, File, Session, is_directory
from mavftpfs.oneshot.names import emptied, make_directory
from mavftpfs.oneshot.progress import Progress
from mavftpfs.shared.errors import CrossDevice, MavftpfsError, NotADirectory, UsageError
from mavftpfs.shared.model import join, split
from mavftpfs.shared.readable import name_text

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

    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        nursery.start_soon(watch)
        try:
            yield
        except Exception as error:  # raised again outside of the nursery, which would wrap it in a group
            failure = error
        nursery.cancel_scope.cancel()
    if failure is not None:
        raise failure


def _show(acknowledged: int, progress: Progress) -> None:
    if acknowledged >= progress.size:
        progress.at(progress.size)
        progress.check()
    else:
        progress.at(acknowledged)
