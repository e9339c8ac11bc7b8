"""Delivers files: sends each one, verifies it, and commits it under its name. Layer: cache.

`deliver` returns when the vehicle has the file, verified (promise 2), or when the file is not wanted.
Otherwise it raises the reason. Bytes that are not delivered stay held, and the next call goes on with them.
During a delivery no program changes the file (`File.lock`), so the verified bytes are the sent bytes.

There is one way to the card (`_send`): fetch the bytes of the old file that stay (`writing.make_whole`), send
the whole file to a temporary file (`uploads.need_attempt`), verify it there, and check that others left the
name alone (`_compare_and_look`), rename it into place (`_commit`). If the ACK of the rename proves too
little, the file is compared under its name (`_compare_again`). A card that cannot rename gets the file under
its own name. If the commit of a file was interrupted (`File.unsure`), a task finds out what has the name
(`looking.until_known`); a delivery that begins before that finds it out itself (`looking.look`).

A delivery that is cancelled or fails keeps its attempt if the error may pass (`uploads.PASSING`), so that the
next delivery sends only the missing bytes. Exception: if the rename fails, the verified temporary file is
removed, and the next delivery sends all of it. A commit that began is finished even if the caller is
cancelled. The comparison after it may be cancelled: then the file stays unsure.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import trio

from mavftpfs.cache import looking, uploads, verify, writing
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import Attempt, Event, File, Replaces, State
from mavftpfs.cache.together import together
from mavftpfs.cache.uploads import PASSING
from mavftpfs.shared.errors import (
    Armed,
    FileBusy,
    FileChanged,
    MavftpfsError,
    OutcomeUnknown,
    RemoteProtocolError,
    VerificationFailed,
)
from mavftpfs.shared.model import DirEntry, EntryKind
from mavftpfs.shared.sameness import Known

log = logging.getLogger("mavftpfs.cache")

MISMATCHES = 2
"""A delivery fails when the file on the card differed from what was sent so many times."""

RESEND_PAUSE = 1.0
"""Seconds before such a file is sent again: the cause may last a moment."""

SHORT = 4096
"""Bytes of the largest file whose checksum the slowest card computes at once."""


async def deliver(card: Card, file: File, *, wanted: Callable[[], bool] | None = None) -> None:
    """Bring a file to the vehicle, and verify it, if it is to be delivered at all. `wanted` is asked before
    each round; a round that began is finished.

    Raises:
        The reason why not: as VehicleStore; VerificationFailed, NotSupported, FileChanged, AlreadyExists,
        NoSpace, SpoolFailed, RemoteProtocolError, WriteFailed.
    """
    try:
        while (file.undelivered or file.attempt is not None) and (wanted is None or wanted()):
            async with file.lock:
                if file.preempting:  # the name or the content goes first: the lock is fair
                    continue
                # If a call preempts it, also while it waits for its path, the loop goes on.
                with trio.CancelScope() as file.delivery:
                    await _deliver_under_its_name(card, file)
                    break
        file.require_not_broken()
    finally:
        if file.undelivered:  # also if the caller was cancelled
            card.retry_later()


async def _deliver_under_its_name(card: Card, file: File) -> None:
    try:
        async with card.paths.steady(file, lasting=True):
            if file.undelivered:
                await _deliver(card, file)
            else:
                await uploads.abandon(card, file)
    finally:
        file.delivery = None
        card.throttle.waiting.unpark_all()


async def _deliver(card: Card, file: File) -> None:
    try:
        card.require_disarmed()
        await _try(card, file)
    except MavftpfsError as error:
        if isinstance(error, FileChanged) and file.state is State.DIRTY and file.replaces is Replaces.BASE:
            file.on(Event.REPLACED)
        _note_failure(card, file, error)
        raise


async def _try(card: Card, file: File) -> None:
    """Deliver. Try once more if the card has other bytes than were sent, or if it proved unable to rename."""
    mismatches, store = 0, card.store
    while file.undelivered:
        in_place = store.traits.rename_works is False
        try:
            await looking.look(card, file)
            if file.undelivered:
                await _send(card, file)
        except VerificationFailed as error:
            mismatches += 1
            await uploads.abandon(card, file)
            if mismatches == MISMATCHES:
                raise
            log.warning("%s; sending it again", error)
            await trio.sleep(RESEND_PAUSE)
        except MavftpfsError as error:
            unsent = in_place and not file.lies_in_place  # others may take the name meanwhile
            if unsent or not isinstance(error, PASSING) or not file.size:
                await uploads.abandon(card, file)
            cannot_rename = not in_place and store.traits.rename_works is False
            if not cannot_rename:  # as this try has shown
                raise
            log.debug("%r: %s; trying another way", file.path, error)


async def _send(card: Card, file: File) -> None:
    """Send the whole file, compare it, and commit it."""
    uploads.require_deliverable(card, file)  # before anything is fetched for it
    await writing.make_whole(card, file)
    attempt = await uploads.need_attempt(card, file)
    attempt.sending.growing = False
    await attempt.upload.finish()
    if attempt.sending.unacked:
        raise RemoteProtocolError(f"{attempt.path!r} was said to be finished, and was not")
    await card.store.wait_out(attempt.path)
    crc32 = await _compare_and_look(card, file, attempt)
    sent = Known(file.size, crc32=crc32)
    try:
        with card.store.finishing():
            file.attempt = None
            await attempt.upload.end()
            if not attempt.in_place:
                await _commit(card, file, attempt, sent)
        if not attempt.in_place:
            await _compare_again(card, file, attempt, sent)
            card.names.settle(file)
    finally:
        if file.unsure is not None:
            card.nursery.start_soon(looking.until_known, card, file)
    card.on_delivered(file, sent)


async def _commit(card: Card, file: File, attempt: Attempt, sent: Known) -> None:
    """Rename what was sent and verified into place.

    Raises:
        As Names.commit.
    """
    card.directories.put(attempt.path, DirEntry(b"", EntryKind.FILE, file.size))
    file.blocks.close_reader()
    try:
        await card.names.commit(file, attempt.path, sent)
    except OutcomeUnknown:
        raise
    except MavftpfsError:
        await card.names.discard(attempt.path)
        raise


async def _compare_and_look(card: Card, file: File, attempt: Attempt) -> int | None:
    """Compare what was sent, and check what has the name; return the CRC32 if it was compared.

    Requests that the server answers at once go out together. A long checksum goes alone, because requests
    behind it would be repeated meanwhile. The name is checked after it: others may take the name while it is
    computed.

    Raises:
        As verify.check and uploads.require_untouched.
    """
    # A second CreateFile may have emptied the file, and later writes hide that from its size.
    doubted = card.store.in_doubt(attempt.begun_at) or attempt.upload.made_twice
    compare = partial(verify.check, card, attempt.path, file, doubted=doubted)
    if file.size <= SHORT:
        return await together(compare, partial(uploads.require_untouched, card, file))
    crc32 = await compare()
    await uploads.require_untouched(card, file)
    return crc32


async def _compare_again(card: Card, file: File, attempt: Attempt, sent: Known) -> None:
    """Compare a file once more, under its own name, where the ACK of its rename is not proof enough.

    A late duplicate of its CreateFile may have emptied it after it was compared. A late duplicate of an
    earlier rename may have taken it away. A server may ACK a rename and do something else: it is believed
    once it was seen to rename.

    Raises:
        VerificationFailed: the file is not there, so it is sent again, whatever has the name. Also as
        verify.check.
    """
    store, path = card.store, file.path
    doubted, unproven = store.in_doubt(attempt.begun_at), store.traits.rename_works is None
    try:
        if doubted or (unproven and sent.crc32 is not None):
            await verify.check(card, path, file, doubted=doubted)
        elif (unproven or attempt.upload.made_twice) and await card.names.size(path) != file.size:
            raise VerificationFailed(f"{path!r} is not what was sent: it is gone, or was emptied")
    except VerificationFailed:
        # The committed file is spoilt, so the next delivery may replace it, whatever it has become.
        file.base, file.content.keeps_base = Known(file.size), False
        if unproven:
            await card.names.learn_rename_works(path)
        raise
    store.traits.rename_works = True


# --- after


def _note_failure(card: Card, file: File, error: MavftpfsError) -> None:
    """Remember the error for the next close, and make the bytes survive a loss of power."""
    known, file.error, file.failed_changes = file.error, error, file.changes
    level = logging.DEBUG if isinstance(error, Armed) or str(known) == str(error) else logging.WARNING
    log.log(level, "%r is not delivered: %s", file.path, error)  # once: each close tries again
    writing.persist(card, file)


# --- taking back


async def withdraw(card: Card, file: File) -> bool | None:
    """Take back the bytes of a file that are not delivered: nothing of it is sent from now on.

    The file that has the name on the vehicle keeps it. Programs that have this file open keep it without a
    name. Returns whether the vehicle has all of it; None if that is not known, or if another handle writes
    it, too: then that handle delivers these bytes with its own.
    """
    with suppress(FileBusy):  # otherwise it is just getting its name
        async with file.preempt(card.options.op_deadline), card.paths.steady(file, lasting=True):
            return await _withdraw(card, file)
    return None


async def _withdraw(card: Card, file: File) -> bool | None:
    if not (file.undelivered or file.broken):
        return file.has_name
    if file.writers > 1 and not file.broken:
        return None
    # Where a part was delivered meanwhile, the vehicle has neither the old file nor the new one.
    there: bool | None = None if file.delivered_since_open else False
    if file.broken:
        return await _withdraw_broken(card, file, there)
    path, in_place = file.path, file.lies_in_place
    try:
        await looking.look(card, file)
        if not file.undelivered:
            return True
        await uploads.abandon(card, file)
        if file.base is not None:
            there = None if in_place else there
        elif in_place or await uploads.is_empty_in_place(card, path):
            await card.names.remove_if_there(path)  # a part that this mount wrote
    except MavftpfsError as error:
        log.info("%r is taken back, but nobody knows what has its name: %s", path, error)
        there = None
    finally:
        card.lose_name(file)
    card.forget_time(path)
    card.tell_changed(path)
    return there


async def _withdraw_broken(card: Card, file: File, there: bool | None) -> bool | None:
    """Forget a broken file; arguments and result as in `withdraw`."""
    with suppress(MavftpfsError):
        await uploads.remove_part(card, file)
    if file in card.broken:
        card.forget_broken(file.path)
    return None if file.has_part else there
