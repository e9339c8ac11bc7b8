"""Changes of files by programs: opening for writing, changing, breaking. Layer: cache.

A change is put into the local spool at once. **A changed file becomes whole**: if a program changes a part of
a file, the rest is fetched from the vehicle once the program pauses, or when it closes the file. So what is
sent, or kept when it cannot be sent, is always a file; and a program that overwrites every byte makes nothing
be fetched.

**A write that was answered with an error breaks its file**: the program knows that its copy failed, so
nothing of it may become the vehicle's file later. The file loses its name, and the name shows the vehicle's
file again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import trio

from mavftpfs.cache import reading, uploads
from mavftpfs.cache.blocks import NEVER
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import Attempt, Event, File
from mavftpfs.cache.temporary import require_writable
from mavftpfs.shared.errors import (
    FileBusy,
    FileChanged,
    IsADirectory,
    MavftpfsError,
    NoSpace,
    NotFound,
    SpoolFailed,
)
from mavftpfs.shared.model import EntryKind, require_listable
from mavftpfs.shared.readable import readable
from mavftpfs.shared.sameness import Known

log = logging.getLogger("mavftpfs.cache")

STEP = 128 * 1024
"""Bytes fetched at once."""

QUIET = 1.0
"""Seconds for which a program makes no change before the rest of its file is fetched."""


# --- opening


async def for_writing(card: Card, path: bytes, *, truncate: bool) -> File:
    """Return the file of a path that exists. truncate: the caller is about to empty it.

    Raises:
        NotFound, IsADirectory, NotSupported, PathTooLong, FileBusy; else as reading.opened.
    """
    file = card.find(path)
    if file is not None and file.is_local:
        return file
    require_writable(path)
    entry = await card.shown_entry(path)
    if entry is None:
        raise NotFound(f"{path!r} does not exist")
    if entry.kind is not EntryKind.FILE:
        raise IsADirectory(f"{path!r} is a directory")
    if not truncate:
        file, _ = await reading.opened(card, path)  # the reply tells the size better than a listing
        try:
            card.require_idle(path)
        except FileBusy:
            card.maybe_forget(file)
            raise
        return file
    # The caller need not empty an empty file, so a size of 0 has to be the vehicle's answer of just now.
    size = entry.size or await card.store.stat_size(path)
    card.require_idle(path)
    file = card.need(path)
    if not file.is_local and (file.base is None or file.base.size != size):
        # Nothing is proven: if the caller cannot empty the file, the next open asks the vehicle.
        file.base = Known(size)
        file.content.on_opened(size)
        file.proven_at = NEVER
        file.in_kernel = False
    return file


async def made(card: Card, path: bytes) -> File | None:
    """Make a file, as far as programs see; return None if there is one.

    Raises:
        NotFound, NotADirectory: its directory. AlreadyExists: another spelling of a file that is there.
        Otherwise as RemoteStore.list_directory.
    """
    require_writable(path)
    require_listable(path)
    file = card.find(path)
    if (file is not None and file.is_local) or await card.shown_entry(path) is not None:
        return None
    await card.names.require_new(path)
    file = card.find(path)
    if file is not None and file.is_local:
        return None
    if file is not None:  # a program has it open, though others removed it
        reading.on_replaced(card, file)
    file = card.need(path)
    file.base = None
    file.content.on_opened(0)
    file.content.spool(card.spool, path)
    file.on(Event.CHANGED)
    card.keep(file)
    card.touch(file)
    return file


# --- changing (the caller has the file's lock)


def write(card: Card, file: File, offset: int, data: bytes | memoryview) -> None:
    """Put bytes into a file.

    Raises:
        NoSpace, SpoolFailed: nothing changed.
    """
    if len(data):
        _change(card, file, partial(file.content.write, offset, data))
        _on_changed(card, file, offset, Event.CHANGED)


def truncate(card: Card, file: File, size: int) -> None:
    """Cut a file, or extend it with zeros.

    Raises:
        NoSpace, SpoolFailed: nothing changed.
    """
    before = file.size
    _change(card, file, partial(file.content.truncate, size))
    _on_changed(card, file, min(before, size), Event.CHANGED if size else Event.EMPTIED)
    if not size:  # what was written before is gone, and so is the error that kept it from the vehicle
        file.changers.clear()
        file.error = None
        if file.has_name:
            card.forget_broken(file.path)


def _change(card: Card, file: File, change: Callable[[], None]) -> None:
    """Change a file's content, from now on in the spool.

    Raises:
        NoSpace, SpoolFailed: nothing changed.
    """
    was_local = file.is_local
    file.content.spool(card.spool, file.path)
    try:
        _with_room(card, change)
    except MavftpfsError:
        if not was_local:  # otherwise later opens would not ask the vehicle
            file.forget_content()
        raise


def _with_room(card: Card, change: Callable[[], None]) -> None:
    """Change a file's content. If there is no room here, the oldest broken files are forgotten first.

    Raises:
        NoSpace, SpoolFailed.
    """
    while True:
        try:
            return change()
        except NoSpace:
            if not card.broken:
                raise
            file = card.broken.pop(0)
            log.warning("the part of %r is removed here, because pending changes need its room", file.path)
            file.forget_content()


def _on_changed(card: Card, file: File, start: int, event: Event) -> None:
    file.on(event)
    file.changes += 1
    file.in_kernel = False
    card.keep(file)
    if file.attempt is not None:
        file.attempt.sending.on_changed(start, file.size)
    if not file.content.whole and file not in card.fetchers:
        card.fetchers.add(file)
        card.nursery.start_soon(_fetch_when_quiet, card, file)


# --- fetching what is missing


async def _fetch_when_quiet(card: Card, file: File) -> None:
    """Fetch the rest of a file once its program pauses. A failure is told by the close, which tries again."""
    try:
        seen = None
        while seen != file.changes:
            seen = file.changes
            await trio.sleep(QUIET)
        if file.content.spooled is not None:  # otherwise it was delivered and closed meanwhile
            with suppress(MavftpfsError):
                await make_whole(card, file)
    finally:
        card.fetchers.discard(file)


async def make_whole(card: Card, file: File) -> None:
    """Fetch the bytes of a file that only the vehicle has.

    Raises:
        NoSpace; else as reading.read.
    """
    if not file.content.whole:
        await card.fetching.run(file, partial(_fetch, card, file))


async def _fetch(card: Card, file: File) -> None:
    """Fetch what is missing.

    Where listings tell no times, the delivery compares checksums before it replaces the old file. That of the
    old file is made of the bytes that are fetched: the whole old file is read once, also the end of a file
    that was cut. A fetch that failed continues where it stopped, so bytes of two versions make a checksum
    that neither has.
    """
    content, base = file.content, file.base
    if base is None:
        return  # others removed it meanwhile, so nothing of it is missing
    if not card.directories.tells_times and base.crc32 is None and base.size <= card.options.verify_max:
        while (at := content.summed[0]) < base.size:
            content.sum_up(await _fetch_step(card, file, at, min(at + STEP, base.size)))
        if file.base == base:
            file.base = replace(base, crc32=content.summed[1])
    while missing := content.missing(0, content.size):
        start, stop = missing[0]
        await _fetch_step(card, file, start, min(start + STEP, stop))


async def _fetch_step(card: Card, file: File, start: int, stop: int) -> bytes | memoryview:
    spooled = file.content.spooled
    data = await reading.read(card, file, start, stop, base=True)
    if len(data) != stop - start or spooled is None or file.content.spooled is not spooled:
        raise FileChanged(f"{file.path!r} became shorter on the vehicle")
    _with_room(card, partial(file.content.fill, start, data))
    return data


# --- breaking


async def break_off(card: Card, file: File, error: MavftpfsError) -> None:
    """Break a file, because a program was told that a write failed after others had been taken.

    No byte of the file is committed, and the vehicle's file, if there is one, has the name again. The part
    that was written is kept for the recovery directory. The caller has the lock, and the file is DIRTY.
    """
    path, attempt = file.path, _detach(card, file)
    file.on(Event.FAILED)
    file.error = error
    card.live.pop(file, None)
    file.leave_tree()
    card.forget_broken(path)
    if file.size or file.has_part:
        card.broken.append(file)
    file.blocks.end(FileChanged(f"a write to {path!r} failed"))
    card.forget_time(path)
    card.tell_changed(path)
    card.retry_later()
    card.throttle.waiting.unpark_all()
    if file in card.broken:
        log.warning(
            "a write to %r failed (%s): the vehicle does not get this version; copy the file again (umount "
            "moves the part that was written to a recovery directory; `mavftpfs recover` lists it)",
            path,
            error,
        )
        persist(card, file)
    if attempt is not None:
        await uploads.leave_to_repair(card, attempt)


async def drop(card: Card, file: File) -> None:
    """Forget the pending changes of a file, because the call that made them failed. Programs that have the
    file open get FileChanged. Nobody has the file's lock.

    The file loses its name before this waits for anything, because the caller may be cancelled.
    """
    path, attempt = file.path, _detach(card, file)
    file.on(Event.DROPPED)
    card.lose_name(file)
    file.forget_content()
    file.content.on_opened(0 if file.base is None else file.base.size)
    card.forget_time(path)
    card.tell_changed(path)
    if attempt is not None:
        await uploads.leave_to_repair(card, attempt)


def _detach(card: Card, file: File) -> Attempt | None:
    """Note that a file is not to be committed; return the attempt to send it, which the caller ends."""
    attempt = file.attempt
    if attempt is not None:
        uploads.forget_attempt(card, file, attempt)
    card.names.settle(file)
    return attempt


def persist(card: Card, file: File) -> None:
    """Hold the bytes of a file, and what is known of it, where they outlive this process."""
    try:
        if file.content.spooled is not None:
            file.content.spooled.persist(describe(file, card.wall))
    except (NoSpace, SpoolFailed, OSError) as trouble:
        log.warning("%r may be lost when this mount ends: %s", file.path, trouble)


def describe(file: File, wall: Callable[[], float]) -> dict[str, object]:
    """Return the description of a spooled file, for people and JSON; `held`: the extents whose bytes are
    here; `broken`: it is what was written before a write failed."""
    return {
        "path": file.path.decode(errors="surrogateescape"),
        "size": file.size,
        "whole": file.content.whole,
        "broken": file.broken,
        "held": list(file.content.held),
        "size_on_vehicle": None if file.base is None else file.base.size,
        "error": None if file.error is None else readable(str(file.error)),
        "at": wall(),
    }
