"""What changes names on the vehicle: mkdir, rmdir, rm, mv; and crc. Layer: top; prints nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mavftpfs.cache.attributes import Stat
from mavftpfs.oneshot.files import READ_SIZE, File, Files, Session, is_directory
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    IsADirectory,
    NotADirectory,
    NotFound,
    UsageError,
)
from mavftpfs.shared.model import ROOT, EntryKind, join, split
from mavftpfs.shared.readable import name_text


async def checksum_paths(
    session: Session, paths: Sequence[bytes], tell: Callable[[bytes, int], None]
) -> None:
    """Have the vehicle compute CRC32s; `tell(path, crc)` for each.

    Raises:
        IsADirectory. Else as Files.stat and crc32.
    """
    for path in paths:
        if (await session.files.stat(path)).kind is not EntryKind.FILE:
            raise IsADirectory(f"{name_text(path)} is a directory")
        tell(path, await session.files.crc32(path))


async def emptied(files: Files, path: bytes) -> File:
    """Open a file for writing from its start; what is on the vehicle stays until the new one is complete."""
    try:
        return await files.open(path, write=True, truncate=True)
    except NotFound:
        return await files.create(path, exclusive=False)


async def make_directory(files: Files, path: bytes, *, may_exist: bool) -> None:
    """Make one directory.

    Raises:
        AlreadyExists: the name is taken (by a file, where an existing directory is welcome).
    """
    try:
        await files.mkdir(path)
    except AlreadyExists:
        if not may_exist or not await is_directory(files, path):
            raise


async def make_directories(session: Session, paths: Sequence[bytes], *, parents: bool) -> None:
    """Make directories; with `parents` also those above them, and what is there already is fine.

    Raises:
        As make_directory and Files.mkdir.
    """
    files = session.files
    for path in paths:
        for above in ancestors(path) if parents else ():
            if not await is_directory(files, above):
                await make_directory(files, above, may_exist=True)
        if not (parents and await is_directory(files, path)):
            await make_directory(files, path, may_exist=parents)


def ancestors(path: bytes) -> list[bytes]:
    """Return the directories above a path, the topmost first, without the root."""
    found = []
    while (path := split(path)[0]) != ROOT:
        found.append(path)
    return found[::-1]


async def remove_directories(session: Session, paths: Sequence[bytes]) -> None:
    """Remove empty directories.

    Raises:
        As Files.rmdir.
    """
    for path in paths:
        await session.files.rmdir(path)


def refuse_root(paths: Sequence[bytes]) -> None:
    """Check that nobody wants to remove everything.

    Raises:
        UsageError: the root is named.
    """
    if ROOT in paths:
        raise UsageError("the root itself is not removed; name what is in it")


async def remove_paths(session: Session, paths: Sequence[bytes], *, recursive: bool) -> None:
    """Remove files, and with `recursive` directories with all below.

    Raises:
        UsageError: the root is named.
        IsADirectory: a directory without `recursive`. Nothing is removed before all paths were looked at.
    """
    refuse_root(paths)
    found = [(path, await session.files.stat(path)) for path in paths]
    for path, stat in found:
        if stat.kind is EntryKind.DIRECTORY and not recursive:
            raise IsADirectory(f"{name_text(path)} is a directory; remove it with -r")
    for path, stat in found:
        await _remove(session.files, path, stat)


async def _remove(files: Files, path: bytes, found: Stat) -> None:
    """Remove a file, or a directory from its leaves upwards."""
    pending = [(path, found.kind, False)]
    while pending:
        here, kind, emptied_already = pending.pop()
        if kind is EntryKind.FILE:
            await files.unlink(here)
        elif emptied_already:
            await files.rmdir(here)
        else:
            pending.append((here, kind, True))
            for name, below in await files.list(here):
                pending.append((join(here, name), below.kind, False))


async def move_paths(session: Session, paths: Sequence[bytes], to: bytes) -> None:
    """Move things into the directory `to`, or one thing to that name.

    Raises:
        NotADirectory: several things, and `to` is no directory. Else as Files.rename.
    """
    into = await is_directory(session.files, to)
    if not into and len(paths) > 1:
        raise NotADirectory(f"{name_text(to)} is no directory, so only one thing can be moved there")
    for path in paths:
        await _move(session.files, path, join(to, split(path)[1]) if into else to)


async def _move(files: Files, old: bytes, new: bytes) -> None:
    """Rename; where the server cannot, copy (which is verified) and delete, as mv does between disks."""
    try:
        await files.rename(old, new)
        return
    except CrossDevice:
        found = await files.stat(old)
    if found.kind is EntryKind.FILE:
        await _copy(files, old, new)
        await files.unlink(old)
        return
    await make_directory(files, new, may_exist=False)
    for name, _ in await files.list(old):
        await _move(files, join(old, name), join(new, name))
    await files.rmdir(old)


async def _copy(files: Files, old: bytes, new: bytes) -> None:
    source = await files.open(old)
    try:
        file = await emptied(files, new)
        try:
            offset = 0
            while offset < source.size:
                offset += await file.write(offset, bytes(await source.read(offset, READ_SIZE)))
            await file.fsync()
        finally:
            file.close()
    finally:
        source.close()
