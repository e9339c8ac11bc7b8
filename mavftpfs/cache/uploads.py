"""Sending files: the attempts that are under way, and what they leave on the card. Layer: cache.

A file is sent as a whole to a temporary file beside it; on a card that cannot rename, under its own name.
`push` begins an attempt while a program still writes, and bytes that are appended meanwhile join it.
`need_attempt` returns to the delivery the attempt that is under way, or begins a new one.
"""

from __future__ import annotations

import logging
from functools import partial

import trio

from mavftpfs.cache import verify
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import Attempt, File, Replaces
from mavftpfs.cache.temporary import Kind
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileChanged,
    FtpNak,
    LinkError,
    MavftpfsError,
    NotSupported,
    NotVerified,
    RequestTimeout,
    SessionBusy,
    SessionLost,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split
from mavftpfs.shared.sending import SendBuffer

log = logging.getLogger("mavftpfs.cache")

START_AT = 64 * 1024
"""A background upload begins when so many bytes wait; fewer wait for the close. Before the first file of such
a size is sent, it is found out whether the card can rename. A smaller one is sent twice if it cannot, once in
a mount: finding out costs four requests on every card."""

START_PAUSE = 5.0
"""Seconds after which an upload that could not begin is tried again."""

PASSING = (RequestTimeout, LinkError, SessionBusy, SessionLost, NotVerified, Armed)
"""Errors after which the upload goes on where it stopped. OutcomeUnknown is a RequestTimeout."""


def may_pass(file: File) -> bool:
    """Return whether trying a delivery again may help: none failed yet, or its error may pass."""
    return file.error is None or isinstance(file.error, PASSING)


def require_deliverable(card: Card, file: File) -> None:
    """Check that a file may replace what the vehicle has under its name.

    Raises:
        FileChanged: the vehicle has another file there now. NotSupported: that cannot be replaced safely.
    """
    file.require_not_stale()
    empties = card.store.traits.rename_works is False and file.base is not None and not file.lies_in_place
    if empties and not card.options.inplace:
        raise NotSupported("this server cannot rename, so a file cannot be replaced safely; see inplace")


async def push(card: Card, file: File) -> None:
    """Begin to send a file that changed, or go on, while the program writes. The caller has the file's
    lock."""
    attempt = file.attempt
    if not file.undelivered:
        return
    card.touch(file)
    if attempt is not None:
        if not attempt.sending.invalidated:
            attempt.sending.growing = True
            attempt.upload.wake()
            return
        file.start_after = float("inf")  # a program that changed sent bytes will do so again
    due = card.clock() >= file.start_after and not card.blocked and not file.preempting
    if not due or file.unacked < START_AT or not may_pass(file) or file.unsure:
        return
    if file.replaces is Replaces.BASE:  # a program changes a part, and every byte is sent: at the close
        return
    try:
        with trio.CancelScope() as file.delivery:
            async with card.paths.steady(file, lasting=True):
                attempt = await need_attempt(card, file)
                attempt.sending.growing = True
                attempt.upload.wake()
    except MavftpfsError as error:
        file.start_after = card.clock() + START_PAUSE
        level = logging.DEBUG if isinstance(error, Armed) else logging.INFO  # one line for all files
        log.log(level, "%r is not sent just now: %s", file.path, error)
    finally:
        file.delivery = None
        card.throttle.waiting.unpark_all()


async def need_attempt(card: Card, file: File) -> Attempt:
    """Return the attempt that is under way if it still fits, else a new one.

    Raises:
        As require_deliverable and require_untouched; otherwise as VehicleStore.open_upload.
    """
    attempt, traits = file.attempt, card.store.traits
    require_deliverable(card, file)
    if attempt is not None and attempt.fits(in_place=traits.rename_works is False):
        return attempt
    if attempt is not None:
        await abandon(card, file)
    # With `inplace` the card may have no room for both files, so this is learnt before any file is sent.
    overwrites = card.options.inplace and file.base is not None
    if traits.rename_works is None and (file.size >= START_AT or overwrites):
        await card.names.learn_rename_works(file.path)
        require_deliverable(card, file)
    return await _begin(card, file, in_place=traits.rename_works is False)


async def _begin(card: Card, file: File, *, in_place: bool) -> Attempt:
    """Begin to send a whole file. in_place: under its own name, because the card cannot rename."""
    begun_at = card.clock()
    if in_place:
        await require_untouched(card, file)
        path = file.path
        await card.store.wait_out(path)
    else:
        path = card.own.need(file.path, Kind.NEW)
    sending = SendBuffer(file.content.get, file.size, partial(card.throttle.on_acked, file))
    try:
        upload = card.store.open_upload(path, sending)
    except MavftpfsError:
        card.own.on_gone(path)
        raise
    file.attempt = Attempt(path, in_place, sending, upload, begun_at)
    return file.attempt


async def abandon(card: Card, file: File) -> None:
    """Cancel the attempt that is under way. Its temporary file is removed now, else by the repair. The caller
    has the file's lock, or holds its path alone: a delivery needs both."""
    attempt = file.attempt
    if attempt is None:
        return
    forget_attempt(card, file, attempt)
    try:
        await attempt.upload.end()
    finally:
        if attempt.in_place or not attempt.upload.may_exist:
            card.own.on_gone(attempt.path)
        else:
            await card.names.discard(attempt.path)


async def leave_to_repair(card: Card, attempt: Attempt) -> None:
    """End an attempt that its file forgot, without waiting for a request: `repair` removes its temporary
    file."""
    try:
        await attempt.upload.end()
    finally:
        card.own.release(attempt.path)
        if not attempt.in_place and attempt.upload.may_exist:
            card.repair.list_later(split(attempt.path)[0])


def forget_attempt(card: Card, file: File, attempt: Attempt) -> None:
    """Note that an attempt ended without success, and have its upload send no more bytes. Those under the
    file's own name belong to the file."""
    if file.lies_in_place:
        # The next listing shows a part, or still the old file. Neither is larger than this, or others would
        # seem to write it.
        most = max(attempt.sending.size, 0 if file.base is None else file.base.size)
        card.directories.put(attempt.path, DirEntry(b"", EntryKind.FILE, most))
        card.directories.expire(split(attempt.path)[0])
        file.has_part = True
    attempt.sending.on_changed(0, 0)  # the upload may be about to read bytes that the file forgets next
    file.attempt = None


async def require_untouched(card: Card, file: File) -> None:
    """Check that others left the name alone, as far as that matters (`File.replaces`).

    Raises:
        AlreadyExists. FileChanged: others changed the base. Otherwise as Names.is_free and is_same.
    """
    path, base = file.path, file.base
    if file.replaces is Replaces.NOTHING and not await _is_free(card, path):
        raise AlreadyExists(f"{path!r} was made by somebody else in the meantime")
    if file.replaces is Replaces.BASE and base is not None and not await verify.is_same(card, path, base):
        raise FileChanged(f"others changed {path!r} on the vehicle while it was changed here")


async def _is_free(card: Card, path: bytes) -> bool:
    return await card.names.is_free(path) or await is_empty_in_place(card, path)


async def is_empty_in_place(card: Card, path: bytes) -> bool:
    """Return whether files are sent under their own names, and an empty one is there: a CreateFile of this
    mount that was not answered may have made it, and otherwise there is nothing to lose."""
    return card.store.traits.rename_works is False and await card.names.size(path) == 0


async def remove_parts(card: Card, path: bytes | None = None) -> None:
    """Remove from the card the parts of broken files that lie under their own names. path: only of this one.

    Raises:
        As VehicleStore, but no FtpNak: what is left is tried again later.
    """
    for file in card.parts:
        if path in (None, file.path):
            async with file.lock:
                await remove_part(card, file)


async def remove_part(card: Card, file: File) -> None:
    """As remove_parts, of one file. The caller has its lock.

    If the vehicle refuses, or if the part may be another client's file, it stays on the card, and the log
    names it.
    """
    if file not in card.parts:  # another call was faster
        return
    try:
        if await _is_part(card, file):
            await card.names.remove_if_there(file.path)
        else:
            log.warning("%r stays on the card: it may be a part of a failed copy, or another file", file.path)
    except FtpNak as nak:
        log.info("%r stays on the card: %s", file.path, nak)
    file.has_part = False


async def _is_part(card: Card, file: File) -> bool:
    """Return whether the vehicle's file of this name is, or may be, the beginning of a broken file.

    Others may have put a file of theirs there while the link was cut.
    """
    size = await card.names.size(file.path)
    if not size:
        return True
    if size > file.size:
        return False
    return await card.store.crc32(file.path, size=size) == file.content.crc32(size)
