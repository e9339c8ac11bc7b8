"""mkdir, rmdir, unlink and rename on the vehicle, by the rules of rename(2) and its kin. Layer: cache.

Servers check little: some remove files by rmdir, or move into directories by rename (servers.md 9). So types
and targets are looked up in listings first. A change holds its paths alone (`pathlocks`). A rename first
delivers the pending changes of what it moves.

When a file loses its name, the vehicle has it no more. Programs that have it open go on with what was written
here; to read any other byte of it is ESTALE.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext, suppress

import trio

from mavftpfs.cache import delivery, looking, reading, uploads
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import Event, File, Replaces
from mavftpfs.cache.temporary import fits_rename, require_not_ours
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    FileBusy,
    FileChanged,
    InvalidMove,
    IsADirectory,
    MavftpfsError,
    NotADirectory,
    NotFound,
    NotSupported,
    OutcomeUnknown,
)
from mavftpfs.shared.model import DirEntry, EntryKind, require_listable, wire_path

RECENT = 2.0
"""Seconds for which a listing is recent enough to change a name by. So the removal of many files does not
list their directory before each."""


async def mkdir(card: Card, path: bytes) -> None:
    """See Tree.mkdir."""
    card.require_changeable()
    require_not_ours(path)
    require_listable(path)
    async with card.paths.hold(path):
        if await card.shown_entry(path) is not None:
            raise AlreadyExists(f"{path!r} exists")
        await card.names.require_new(path)
        await card.names.make_directory(path)


async def rmdir(card: Card, path: bytes) -> None:
    """See Tree.rmdir."""
    card.require_changeable()
    async with card.paths.hold(path):
        entry = await card.shown_entry(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        if entry.kind is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{path!r} is not a directory")
        await _require_empty(card, path)
        await card.names.remove_directory(path)
    card.forget_time(path)


async def unlink(card: Card, path: bytes) -> None:
    """See Tree.unlink. A file that the vehicle never had needs no request, so a cut link and a flight do not
    keep a program from removing it."""
    require_not_ours(path)
    if not _is_only_here(card, card.find(path)):
        card.require_changeable()
    async with _preempting(card, path), card.paths.hold(path):
        await _unlink(card, path)
    card.forget_time(path)


async def rename(card: Card, old: bytes, new: bytes, *, noreplace: bool) -> None:
    """See Tree.rename."""
    card.require_changeable()
    require_not_ours(old)
    require_not_ours(new)
    require_listable(new)
    if new.startswith(old + b"/"):
        raise InvalidMove(f"{old!r} cannot become a part of itself")
    if old != new:
        await _deliver_below(card, old)
    preempting = nullcontext() if noreplace or old == new else _preempting(card, new)
    async with preempting, card.paths.hold(old, new):
        await _rename(card, old, new, noreplace=noreplace)


@asynccontextmanager
async def _preempting(card: Card, path: bytes) -> AsyncIterator[None]:
    """Preempt the file of a path, if it is open or not delivered, for a body that takes its name away.

    Raises:
        FileBusy: see File.preempt.
    """
    file = card.find(path)
    try:
        async with nullcontext() if file is None else file.preempt(card.options.op_deadline):
            yield
    finally:
        if file is not None:
            card.maybe_forget(file)


@asynccontextmanager
async def _moving(card: Card, *paths: bytes) -> AsyncIterator[None]:
    """For a body that moves the first path to the second. If its outcome is unknown, what was known of these
    names, and of those below, is forgotten. Files of these names that are not delivered are STALE, because
    their names may have other files."""
    try:
        yield
    except OutcomeUnknown:
        for path in paths:
            for file in list(card.files_below(path)):
                if file.undelivered:
                    card.names.settle(file)
                    file.blocks.end(FileChanged(f"it is not known what became of {path!r}"))
                    file.on(Event.REPLACED)
                else:
                    reading.lose_base(card, file)
        raise


async def _require_empty(card: Card, path: bytes) -> None:
    """Check by a new listing that a directory is empty, and that no program has a new file in it."""
    if any(file in card.live for file in card.files_below(path)):
        raise DirectoryNotEmpty(f"{path!r} is not empty")
    await card.names.require_empty(path)


# --- inside: unlinking


def _is_only_here(card: Card, file: File | None) -> bool:
    """Return whether the vehicle never had a file of this mount, nor may have a part of it under its name, as
    a card that cannot rename may."""
    if file is None or not file.is_local or card.store.traits.rename_works is False:
        return False
    in_place = file.has_part or (file.attempt is not None and file.attempt.in_place)
    return file.base is None and file.unsure is None and not in_place


async def _unlink(card: Card, path: bytes) -> None:
    file = card.find(path)
    if file is not None and _is_only_here(card, file):
        with suppress(MavftpfsError):  # its temporary file is removed later then
            await uploads.abandon(card, file)
        card.forget_broken(path)
        card.lose_name(file)
        return
    card.require_changeable()
    if file is not None:
        await looking.look(card, file)
        await uploads.abandon(card, file)
    entry = await card.directories.ask_entry(path, within=RECENT)
    there = entry is not None and entry.kind is EntryKind.FILE
    if file is not None and file.is_local:
        # A file of others under its name is not to be removed, if it holds something.
        ours = file.replaces is not Replaces.NOTHING
        there &= ours or (entry is not None and not entry.size)
    elif entry is None:
        card.forget_broken(path)
        raise NotFound(f"{path!r} does not exist")
    elif not there:
        raise IsADirectory(f"{path!r} is a directory")
    else:
        card.require_idle(path)
    await card.names.purge(path)
    card.forget_broken(path)
    if there:
        await card.names.remove_if_there(path)
    if file is not None:
        card.lose_name(file)


# --- inside: renaming


async def _deliver_below(card: Card, path: bytes) -> None:
    """Deliver what is about to get another name. Raises FileBusy if that takes too long."""
    with trio.move_on_after(card.options.op_deadline) as scope:
        for file in list(card.files_below(path)):
            await delivery.deliver(card, file)
            card.maybe_forget(file)
    if scope.cancelled_caught:
        raise FileBusy(f"{path!r} is still being delivered")


async def _rename(card: Card, old: bytes, new: bytes, *, noreplace: bool) -> None:
    wire_path(new)
    displaced = None if noreplace or old == new else card.find(new)
    if displaced is not None:
        await looking.look(card, displaced)
    listed = await card.directories.ask_entry(new, within=RECENT)
    target = listed or await card.shown_entry(new)
    source = await card.shown_entry(old)
    if source is None:
        raise NotFound(f"{old!r} does not exist")
    if target is None:
        await card.names.require_new(new)
    elif noreplace:
        raise AlreadyExists(f"{new!r} exists")
    if old == new:
        return
    if target is not None and target.kind is EntryKind.DIRECTORY:
        if source.kind is EntryKind.FILE:
            raise IsADirectory(f"{new!r} is a directory")
        await _require_empty(card, new)
    elif target is not None and source.kind is EntryKind.DIRECTORY:
        raise NotADirectory(f"{new!r} is not a directory")
    if not fits_rename(old, new):
        raise CrossDevice(f"{old!r} and {new!r} do not fit one request together")
    for path in (old, new):
        if card.find(path) not in card.live:
            card.require_idle(path)
    await _move(card, old, new, listed)
    if source.kind is EntryKind.DIRECTORY:
        card.directories.forget(old)
    _follow(card, old, new)
    for path in (old, new):
        card.forget_broken(path)
    card.repair.follow_rename(old, new)


async def _move(card: Card, old: bytes, new: bytes, listed: DirEntry | None) -> None:
    """Rename on the vehicle. listed: what it has at `new`, which is replaced."""
    displaced = card.find(new)
    for file in list(card.files_below(old)):
        await uploads.abandon(card, file)
        if file.unsure is not None:
            raise FileBusy(f"{file.path!r}: it is not known yet what the vehicle has there")
        if file.is_local and file.base is None:
            raise FileBusy(f"{file.path!r} is being written, and not on the vehicle yet")
    if displaced is not None:
        await uploads.abandon(card, displaced)
    await card.names.purge(old)
    try:
        async with _moving(card, old, new):
            if listed is not None and listed.kind is EntryKind.FILE:
                if displaced is not None:
                    displaced.blocks.close_reader()
                await card.names.move_over(old, new)
            else:
                if listed is not None:
                    await card.names.remove_directory(new)
                await card.names.rename(old, new)
    except NotSupported as error:
        raise CrossDevice(str(error)) from error


def _follow(card: Card, old: bytes, new: bytes) -> None:
    """Give what this mount knows of a file or directory its new name."""
    displaced, moved = card.find(new), card.root.find(old)
    if displaced is not None:
        card.lose_name(displaced)
    (source, old_name), (target, new_name) = card.root.home(old), card.root.home(new)
    source.times.move(old_name, target.times, new_name)
    if moved is not None:
        moved.move(target, new_name)
    source.prune()
    target.prune()
    for file in card.files_below(new):
        file.blocks.close_reader()  # the next read opens the file under its new name
        if card.store.in_doubt():  # others may have removed it, and the new name have the file of before
            file.blocks.drop()
            file.in_kernel = False
            card.tell_changed(file.path)
        if file.content.spooled is not None:
            file.content.spooled.name = file.path
