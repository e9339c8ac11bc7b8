"""Commands that change a vehicle without a kernel mount: put, rm, mkdir, rmdir, mv. Layer: top; silent.

They go through the same tree as a mount, so that a file counts as put when the vehicle provably has it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from mavftpfs.cache.tree import OpenFile, Stat, Tree
from mavftpfs.exits import NotDelivered
from mavftpfs.oneshot import READ_SIZE, Target
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    IsADirectory,
    MavftpfsError,
    NotADirectory,
    NotFound,
    UsageError,
)
from mavftpfs.shared.model import ROOT, EntryKind, join, split
from mavftpfs.shared.readable import name_text

if TYPE_CHECKING:  # rich is slow to import and not needed here
    from mavftpfs.report import Meter


@dataclass(frozen=True, slots=True)
class Sent:
    """One file that is on the vehicle. size in bytes."""

    remote: bytes
    size: int


@dataclass(frozen=True, slots=True)
class Piece:
    """Something local to be put. below: its path below the target, without a slash before it; b"" = there."""

    local: Path
    below: bytes
    is_directory: bool


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
    return Piece(local, below, False)


async def put_paths(
    target: Target,
    locals_: Sequence[Path],
    path: bytes,
    meter: Meter,
    tell: Callable[[Sent], None],
    *,
    recursive: bool,
) -> None:
    """Put files, and with `recursive` directories, to `path`: an existing directory, or a new name for one.

    Raises:
        UsageError: of what is local; nothing was sent then.
        NotADirectory: several things, and `path` is no directory.
        NotDelivered: a file did not get to the vehicle; what was told before is there.
    """
    batches = [(local, collect(local, recursive=recursive)) for local in locals_]
    async with target.attached(writing=True) as vehicle:
        into = await _is_directory(vehicle.tree, path)
        if not into and len(batches) > 1:
            raise NotADirectory(f"{name_text(path)} is no directory, so only one thing can be put there")
        putter = _Putter(vehicle.tree, meter, tell)
        for local, pieces in batches:
            place = join(path, os.fsencode(local.absolute().name)) if into else path
            for piece in pieces:
                await putter.put(piece, join(place, piece.below) if piece.below else place)


@dataclass(slots=True)
class _Putter:
    """Puts one thing after the other; counts what arrived."""

    tree: Tree
    meter: Meter
    tell: Callable[[Sent], None]
    delivered: int = 0

    async def put(self, piece: Piece, remote: bytes) -> None:
        if piece.is_directory:
            await make_directory(self.tree, remote, may_exist=True)
            return
        try:
            with piece.local.open("rb") as source:
                size = await self._send(source, remote)
        except OSError as exc:
            raise UsageError(f"{piece.local}: {exc.strerror}") from exc
        except MavftpfsError as exc:
            done = f"; {self.delivered} file(s) before it are there" if self.delivered else ""
            raise NotDelivered(f"{name_text(remote)} was not delivered: {exc}{done}") from exc
        self.delivered += 1
        self.tell(Sent(remote, size))

    async def _send(self, source: BinaryIO, remote: bytes) -> int:
        total = os.fstat(source.fileno()).st_size
        advance = self.meter.start(name_text(remote), total)
        file = await _emptied(self.tree, remote)
        try:
            offset = 0
            while data := source.read(READ_SIZE):
                offset += await file.write(offset, data)
                advance(len(data))
            await file.fsync()
        finally:
            file.close()
        return offset


async def _emptied(tree: Tree, remote: bytes) -> OpenFile:
    """Open a file for writing from its start; what is on the vehicle stays until the new one is complete."""
    try:
        return await tree.open(remote, write=True, truncate=True)
    except NotFound:
        return await tree.create(remote, exclusive=False)


async def _is_directory(tree: Tree, path: bytes) -> bool:
    try:
        return (await tree.stat(path)).kind is EntryKind.DIRECTORY
    except NotFound:
        return False


# -- names ----------------------------------------------------------------------------------------


async def make_directory(tree: Tree, path: bytes, *, may_exist: bool) -> None:
    """Make one directory.

    Raises:
        AlreadyExists: the name is taken (by a file, where an existing directory is welcome).
    """
    try:
        await tree.mkdir(path)
    except AlreadyExists:
        if not may_exist or not await _is_directory(tree, path):
            raise


async def make_directories(target: Target, paths: Sequence[bytes], *, parents: bool) -> None:
    """Make directories; with `parents` also those above them, and what is there already is fine.

    Raises:
        As make_directory and Tree.mkdir.
    """
    async with target.attached(writing=True) as vehicle:
        for path in paths:
            for above in ancestors(path) if parents else ():
                if not await _is_directory(vehicle.tree, above):
                    await make_directory(vehicle.tree, above, may_exist=True)
            if not (parents and await _is_directory(vehicle.tree, path)):
                await make_directory(vehicle.tree, path, may_exist=parents)


def ancestors(path: bytes) -> list[bytes]:
    """Return the directories above a path, the topmost first, without the root."""
    found = []
    while (path := split(path)[0]) != ROOT:
        found.append(path)
    return found[::-1]


async def remove_directories(target: Target, paths: Sequence[bytes]) -> None:
    """Remove empty directories.

    Raises:
        As Tree.rmdir.
    """
    async with target.attached(writing=True) as vehicle:
        for path in paths:
            await vehicle.tree.rmdir(path)


async def remove_paths(target: Target, paths: Sequence[bytes], *, recursive: bool) -> None:
    """Remove files, and with `recursive` directories with all below.

    Raises:
        UsageError: the root is named.
        IsADirectory: a directory without `recursive`. Nothing is removed before all paths were looked at.
    """
    if ROOT in paths:
        raise UsageError("the root itself is not removed; name what is in it")
    async with target.attached(writing=True) as vehicle:
        found = [(path, await vehicle.tree.stat(path)) for path in paths]
        for path, stat in found:
            if stat.kind is EntryKind.DIRECTORY and not recursive:
                raise IsADirectory(f"{name_text(path)} is a directory; remove it with -r")
        for path, stat in found:
            await _remove(vehicle.tree, path, stat)


async def _remove(tree: Tree, path: bytes, found: Stat) -> None:
    """Remove a file, or a directory from its leaves upwards."""
    pending = [(path, found.kind, False)]
    while pending:
        here, kind, emptied = pending.pop()
        if kind is EntryKind.FILE:
            await tree.unlink(here)
        elif emptied:
            await tree.rmdir(here)
        else:
            pending.append((here, kind, True))
            for name, below in await tree.list(here):
                pending.append((join(here, name), below.kind, False))


async def move_paths(target: Target, paths: Sequence[bytes], to: bytes) -> None:
    """Move things into the directory `to`, or one thing to that name.

    Raises:
        NotADirectory: several things, and `to` is no directory. Else as Tree.rename.
    """
    async with target.attached(writing=True) as vehicle:
        into = await _is_directory(vehicle.tree, to)
        if not into and len(paths) > 1:
            raise NotADirectory(f"{name_text(to)} is no directory, so only one thing can be moved there")
        for path in paths:
            await _move(vehicle.tree, path, join(to, split(path)[1]) if into else to)


async def _move(tree: Tree, old: bytes, new: bytes) -> None:
    """Rename; where the server cannot, copy (which is verified) and delete, as mv does between disks."""
    try:
        await tree.rename(old, new)
        return
    except CrossDevice:
        found = await tree.stat(old)
    if found.kind is EntryKind.FILE:
        await _copy(tree, old, new)
        await tree.unlink(old)
        return
    await make_directory(tree, new, may_exist=False)
    for name, _ in await tree.list(old):
        await _move(tree, join(old, name), join(new, name))
    await tree.rmdir(old)


async def _copy(tree: Tree, old: bytes, new: bytes) -> None:
    source = await tree.open(old)
    try:
        file = await _emptied(tree, new)
        try:
            offset = 0
            while offset < source.size:
                offset += await file.write(offset, bytes(await source.read(offset, READ_SIZE)))
            await file.fsync()
        finally:
            file.close()
    finally:
        source.close()
