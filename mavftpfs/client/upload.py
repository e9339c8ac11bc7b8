"""Uploads local files and directories to the vehicle. Layer: client; prints nothing.

A file counts as uploaded when fsync returns, because then it is on the card, verified. Until then progress
counts the bytes that the vehicle has acknowledged.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mavftpfs.client.files import READ_SIZE, File, Session, is_directory, written
from mavftpfs.client.names import emptied, make_directory, require_directory
from mavftpfs.client.progress import Progress
from mavftpfs.shared.errors import (
    LinkError,
    MavftpfsError,
    NotADirectory,
    NotDelivered,
    NotFound,
    RequestTimeout,
    UsageError,
)
from mavftpfs.shared.model import join, normalise
from mavftpfs.shared.readable import name_text, readable

Tell = Callable[[bytes, int, str], None]
"""Called with the path of an uploaded file, its size, and how it was verified."""


def collect(local: Path, *, recursive: bool) -> list[Path]:
    """Return a file, or a directory with everything below, parents first.

    Raises:
        UsageError: the path does not exist or is not readable, is neither file nor directory, or is a
            directory without `recursive`. Symbolic links to files count as files; cards have no links.
    """

    def fail(error: OSError) -> None:
        raise UsageError(f"{error.filename}: {error.strerror}") from error

    found = [local]
    if local.is_dir():
        if not recursive:
            raise UsageError(f"{local} is a directory; put it with -r")
        for folder, directories, files in os.walk(local, onerror=fail):
            directories.sort()
            found += [Path(folder, name) for name in sorted([*directories, *files])]
    for path in found:
        if path.is_symlink() and path.is_dir() and path != local:
            raise UsageError(f"{path} is a link to a directory; a card cannot hold links")
        if not path.exists():
            raise UsageError(f"{path} does not exist")
        if not path.is_file() and not path.is_dir():
            raise UsageError(f"{path} is neither a file nor a directory")
    return found


async def put_paths(
    session: Session,
    batches: Sequence[tuple[Path, Sequence[Path]]],
    path: bytes,
    progress: Progress,
    tell: Tell,
    *,
    into: bool = False,
) -> None:
    """Upload the files of `collect` to `path`: an existing directory, or a new name for one thing.

    `tell`: called for each uploaded file. into: `path` was written with a `/` at its end: a file goes into
    that directory only.

    Raises:
        NotADirectory: several things, or a file with `into`, and `path` is not a directory; NotFound: `path`
        does not exist. UsageError: about local files, or two files would get one name. All these before the
        first request. NotDelivered: a file did not reach the vehicle; the files reported before are there.
    """
    with _naming(session, path, progress):
        inside = await is_directory(session.files, path)
        if not inside and len(batches) > 1:
            raise NotADirectory(f"{name_text(path)} is not a directory, so only one thing can be put there")
        if into and not inside and not batches[0][0].is_dir():
            await require_directory(session.files, path)
    plan = _placed(batches, path, inside=inside)
    sizes = [one.stat().st_size for one in plan.values() if not one.is_dir()]
    progress.plan(len(sizes), sum(sizes))
    for remote, one in plan.items():
        if one.is_dir():
            with _naming(session, remote, progress):
                await make_directory(session.files, remote, may_exist=True)
        else:
            tell(remote, *await put_file(session, one, remote, progress))


def _placed(
    batches: Sequence[tuple[Path, Sequence[Path]]], path: bytes, *, inside: bool
) -> dict[bytes, Path]:
    """Return the path on the vehicle for each local file, parents first; directories of one name become one.

    Raises:
        UsageError: two files would get one name.
    """
    plan: dict[bytes, Path] = {}
    for local, found in batches:
        place = join(path, os.fsencode(local.absolute().name)) if inside else path
        for one in found:
            remote = normalise(join(place, os.fsencode(one.relative_to(local))))
            other = plan.setdefault(remote, one)
            if other != one and not (other.is_dir() and one.is_dir()):
                raise UsageError(f"{other} and {one} would both become {name_text(remote)}; nothing was sent")
    return plan


async def put_file(session: Session, local: Path, remote: bytes, progress: Progress) -> tuple[int, str]:
    """Upload one file, and return its size, and how it was verified.

    Raises:
        UsageError: the file cannot be read. NotFound, NotADirectory: its directory does not exist.
            NotDelivered.
    """
    try:
        with local.open("rb") as source:
            planned = os.fstat(source.fileno()).st_size
            progress.begin(name_text(session.on_vehicle(remote)), planned)
            sent = await _send(session, source, remote, progress)
    except OSError as exc:
        raise UsageError(f"{local}: {exc.strerror}") from exc
    except MavftpfsError as exc:
        told = _undelivered(session, remote, exc, progress)
        if isinstance(exc, NotFound | NotADirectory):
            raise type(exc)(told) from exc
        there = exc.there if isinstance(exc, NotDelivered) else False  # nothing was written yet
        raise NotDelivered(told, there=there) from exc
    progress.end(planned)
    return sent


@contextmanager
def _naming(session: Session, remote: bytes, progress: Progress) -> Iterator[None]:
    """Name the path in the error if the vehicle or the link fails in the body, which writes no file.

    Raises:
        NotDelivered: as for a file that was begun, because scripts should not see a difference.
    """
    try:
        yield
    except (RequestTimeout, LinkError) as exc:
        raise NotDelivered(_undelivered(session, remote, exc, progress), there=False) from exc


def _undelivered(session: Session, remote: bytes, error: MavftpfsError, progress: Progress) -> str:
    """Return the words: which file was not delivered, the reason, and how many were."""
    name = name_text(session.on_vehicle(remote))
    reason = readable(str(error)).removeprefix(f"{name_text(remote)}: ")
    done = f"; {progress.files_done} file(s) before it are there" if progress.files_done else ""
    return f"{name} was not delivered: {reason}{done}"


async def _send(session: Session, source: BinaryIO, remote: bytes, progress: Progress) -> tuple[int, str]:
    file = await emptied(session.files, remote)
    progress.untouched = False
    progress.sending = session.text_of(remote)
    try:
        async with written(file) as writing:
            size = await _copy(source, file)
    finally:
        progress.untouched = writing.there is False
    return size, file.verified


async def _copy(source: BinaryIO, file: File) -> int:
    offset = 0
    while data := source.read(READ_SIZE):
        offset += await file.write(offset, data)
    return offset
