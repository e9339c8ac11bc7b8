"""Delivers drafts: sends each one, verifies it, and renames it into place. Layer: cache.

`deliver` returns when the vehicle has the file, verified (promise 2), or when none is wanted any more. Else
it raises the reason. Undelivered bytes stay held, and the next call goes on with them. During a delivery no
program writes the file (`Node.lock`), so the verified bytes are the sent bytes. `push` begins the upload
while a program still writes.

There is one way to the card: the whole file is sent under a reserved name, verified there, and renamed into
place. In doubt it is then compared once more. A card that cannot rename gets the file under its own name.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import inf

import trio

from mavftpfs.cache import base
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft, Event, State
from mavftpfs.cache.looking import look
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Attempt, Node
from mavftpfs.cache.recovery import describe
from mavftpfs.cache.reserved import Kind
from mavftpfs.cache.throttle import Throttle
from mavftpfs.cache.together import together
from mavftpfs.cache.verify import Verifier
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileBusy,
    FileChanged,
    FtpNak,
    LinkError,
    MavftpfsError,
    NoSpace,
    NotSupported,
    NotVerified,
    OutcomeUnknown,
    RemoteProtocolError,
    RequestTimeout,
    SessionBusy,
    SessionLost,
    SpoolFailed,
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

START_AT = 64 * 1024
"""A background upload begins when so many bytes wait; fewer wait for the close. Before the first file of such
a size is sent, it is found out whether the card can rename. A smaller one is sent twice if it cannot, once in
a mount: finding out costs four requests on every card."""

START_PAUSE = 5.0
"""Seconds after which an upload that could not begin is tried again."""

LOOK_AGAIN, IN_FLIGHT = 2.0, 60.0
"""Seconds after which it is tried again to find out what has a name; the second if only a checksum is
lacking, which is asked for after the flight."""

PASSING = (RequestTimeout, LinkError, SessionBusy, SessionLost, NotVerified, Armed)
"""Errors after which the upload goes on where it stopped."""


def may_pass(node: Node) -> bool:
    """Return whether trying a delivery again may help: none failed yet, or its error may pass."""
    return node.error is None or isinstance(node.error, PASSING)


class Deliverer:
    """Brings files to the vehicle."""

    def __init__(self, context: Context, names: Names, throttle: Throttle) -> None:
        self._context = context
        self._names = names
        self._throttle = throttle
        self.verifier = Verifier(context, names)
        self.parts: list[bytes] = []
        """What broken files left on the card: their temporary files, or parts under their own names."""

    async def deliver(self, node: Node, *, wanted: Callable[[], bool] | None = None) -> None:
        """Bring a node's file to the vehicle, and verify it, if it is to be delivered at all. `wanted` is
        asked before each round; a round that began is finished.

        Raises:
            The reason why not: as VehicleStore; VerificationFailed, NotSupported, FileChanged, AlreadyExists,
            NoSpace, SpoolFailed, RemoteProtocolError, WriteFailed.
        """
        try:
            while (node.undelivered or node.attempt is not None) and (wanted is None or wanted()):
                async with node.lock:
                    if node.claims:  # the name or the content goes first: the lock is fair
                        continue
                    # If a claim cancels it, also while it waits for its path, the loop goes on.
                    with trio.CancelScope() as node.delivery:
                        await self._deliver(node)
                        break
            node.require_not_broken()
        finally:
            if node.undelivered:  # also if the caller was cancelled
                self._context.retry_later()

    async def _deliver(self, node: Node) -> None:
        try:
            async with self._context.paths.steady(node, lasting=True):
                draft = node.draft
                if draft is None or not node.undelivered:
                    await self.abandon(node)
                else:
                    await self._deliver_draft(node, draft)
        finally:
            node.delivery = None
            self._throttle.waiting.unpark_all()

    async def _deliver_draft(self, node: Node, draft: Draft) -> None:
        try:
            self._context.require_disarmed()
            await self._try(node, draft)
            node.error, node.start_after = None, float("-inf")
        except MavftpfsError as error:
            self._note_failure(node, draft, error)
            raise

    async def push(self, node: Node) -> None:
        """Begin to send a draft that changed, or go on, while the program writes. The caller has the node's
        lock."""
        context, attempt, draft = self._context, node.attempt, node.draft
        if draft is None or not node.undelivered:
            return
        context.touch(node.path)
        if attempt is not None and attempt.sending is draft.sending:
            if not attempt.sending.overtaken:
                attempt.sending.growing = True
                attempt.upload.wake()
                return
            node.start_after = float("inf")  # a program that changed sent bytes will do so again
        due = context.clock() >= node.start_after and not context.blocked and not node.claims
        if not due or draft.base_limit or draft.unacked < START_AT or not may_pass(node):
            return  # of a file that only changes every byte is sent again: that waits for the close
        if node.unsure is not None:
            return  # the next delivery looks first
        try:
            with trio.CancelScope() as node.delivery:
                async with context.paths.steady(node, lasting=True):
                    attempt = await self._attempt(node, draft)
                    attempt.sending.growing = True
                    attempt.upload.wake()
        except MavftpfsError as error:
            node.start_after = context.clock() + START_PAUSE
            level = logging.DEBUG if isinstance(error, Armed) else logging.INFO  # one line for all files
            log.log(level, "%r is not sent just now: %s", node.path, error)
        finally:
            node.delivery = None
            self._throttle.waiting.unpark_all()

    async def abandon(self, node: Node) -> None:
        """Give up the present attempt. What it left under reserved names is removed now, else after the next
        listing. The caller has the node's lock, or holds its path alone."""
        attempt, node.attempt = node.attempt, None
        if attempt is None:
            return
        try:
            try:
                await attempt.upload.end()
            finally:
                if node.draft is not None and node.draft.sending is attempt.sending:
                    node.draft.end_attempt()
            if not attempt.in_place and attempt.upload.may_exist:
                await self._names.discard(attempt.path)
        finally:
            self._context.own.release(attempt.path)

    async def break_off(self, node: Node, error: MavftpfsError) -> None:
        """Break a file, because a program was told that a write failed after others had been taken.

        Nothing of the file is placed, and the vehicle's file, if there is one, has the name again. The part
        that was written is kept for the recovery directory. The caller has the node's lock, and the draft is
        neither delivered nor stale.
        """
        context, draft, path, attempt = self._context, node.draft, node.path, node.attempt
        assert draft is not None
        draft.on(Event.FAILED)
        node.attempt, node.error = None, error
        self._names.settle(node)
        if attempt is not None and not attempt.in_place and attempt.upload.may_exist:
            self.parts.append(attempt.path)
        if draft.base is None and draft.sent_in_place:
            self.parts.append(path)
        context.nodes.on_broken(node)
        context.times.forget(path)
        context.files.on_changed(path)
        context.files.forget_pages(path)
        context.retry_later()
        self._throttle.waiting.unpark_all()
        log.warning(
            "a write to %r failed (%s): the vehicle does not get this version; copy the file again (umount "
            "moves the part that was written to a recovery directory; `mavftpfs recover` lists it)",
            path,
            error,
        )
        self._persist(node, draft)
        draft.content.leave_budget()
        self._forget_oldest_parts()
        if attempt is not None:
            await attempt.upload.end()

    def _forget_oldest_parts(self) -> None:
        """Forget the oldest broken files if they hold more than the spool may, beside the spool."""
        broken, most = self._context.nodes.broken, self._context.spool.spool_max
        held = {path: 0 if node.draft is None else node.draft.held.total for path, node in broken.items()}
        for path in list(broken)[:-1]:
            if sum(held.values()) > most:
                log.warning(
                    "the part of %r is removed here: parts of later failed writes need its room", path
                )
                self._context.nodes.forget_broken(path)
                del held[path]

    async def remove_parts(self, path: bytes | None = None) -> None:
        """Remove from the card what broken files left there. path: only of this one.

        If the vehicle refuses, the part stays on the card, and the log names it.

        Raises:
            As VehicleStore, but no FtpNak: what is left is tried again later.
        """
        for part in [part for part in self.parts if path in (None, part)]:
            try:
                await self._names.remove_if_there(part)
            except FtpNak as nak:
                log.info("%r stays on the card: %s", part, nak)
            if part in self.parts:  # else another call was faster
                self.parts.remove(part)
            self._context.own.release(part)

    async def withdraw(self, node: Node) -> bool | None:
        """Take back the undelivered bytes of a file: nothing of it is sent from now on.

        The file that has the name on the vehicle keeps it. Programs that have our file open keep it without a
        name. Returns whether the vehicle has all of it; None if that is not known, or if another handle
        writes it, too.
        """
        with suppress(FileBusy):  # else it is just getting its name
            async with node.claim(self._context.options.op_deadline):
                return await self._withdraw(node)
        return None

    async def _withdraw(self, node: Node) -> bool | None:
        """Take back a file whose lock the caller holds; see `withdraw`."""
        context = self._context
        async with context.paths.steady(node, lasting=True):
            draft = node.draft
            if draft is None or not (node.undelivered or node.broken):
                return not node.removed
            if node.writers > 1 and not node.broken:
                return None
            # Where a part was delivered meanwhile, the vehicle has neither the old file nor the new one.
            there: bool | None = None if node.delivered_since_open else False
            if node.broken:
                return await self._withdraw_broken(node, draft, there)
            try:
                await self.look(node)
                if not node.undelivered:
                    return True
                await self.abandon(node)
                if draft.base is not None:
                    there = None if draft.sent_in_place else there
                elif draft.sent_in_place or await self._is_empty_in_place(node.path):
                    await self._names.remove_if_there(node.path)  # it is a part of ours
            except MavftpfsError as error:
                log.info("%r is taken back, but nobody knows what has its name: %s", node.path, error)
                there = None
            finally:
                context.nodes.unnamed(node)
            context.times.forget(node.path)
            context.files.on_changed(node.path)
            context.files.forget_pages(node.path)
            return there

    async def _withdraw_broken(self, node: Node, draft: Draft, there: bool | None) -> bool | None:
        """Forget a broken file; arguments and result as in `withdraw`."""
        if self._context.nodes.broken.get(node.path) is node:
            self._context.nodes.forget_broken(node.path)
        with suppress(MavftpfsError):
            await self.remove_parts()
        emptied = draft.sent_in_place and draft.base is not None
        return None if emptied or node.path in self.parts else there

    # --- one delivery

    def _require_deliverable(self, draft: Draft) -> None:
        """Check that a draft may replace what it lies over.

        Raises:
            FileChanged: the base is another file now. NotSupported: it cannot be replaced safely.
        """
        if draft.state is State.STALE:
            raise FileChanged("others replaced the file on the vehicle while it was changed here")
        in_place = self._context.store.traits.rename_works is False
        if in_place and draft.base is not None and not (self._context.options.inplace or draft.sent_in_place):
            raise NotSupported("this server cannot rename, so a file cannot be replaced safely; see inplace")

    async def _try(self, node: Node, draft: Draft) -> None:
        """Deliver. Try once more if the card has other bytes than were sent, or if it proved unable to
        rename."""
        mismatches, store = 0, self._context.store
        while True:
            in_place = store.traits.rename_works is False
            try:
                await self.look(node)
                if draft.state is not State.CLEAN:
                    await self._send(node, draft)
                return
            except VerificationFailed as error:
                mismatches += 1
                await self.abandon(node)
                if mismatches == MISMATCHES:
                    raise
                log.warning("%s; sending it again", error)
                await trio.sleep(RESEND_PAUSE)
            except MavftpfsError as error:
                unsent = in_place and not draft.sent_in_place  # others may take the name meanwhile
                if unsent or not isinstance(error, PASSING) or not draft.size:
                    await self.abandon(node)
                if in_place or store.traits.rename_works is not False:
                    raise
                log.debug("%r: %s; trying another way", node.path, error)

    async def look(self, node: Node) -> None:
        """If the placing of a file was interrupted, find out what has its name, and give a missing name its
        file. The caller holds the node's lock.

        Raises:
            As looking.look.
        """
        unsure, draft = node.unsure, node.draft
        if unsure is None or draft is None:
            return
        if await look(self._context, self._names, node):
            if draft.changes == unsure.changes:
                self._on_delivered(node, draft, unsure.sent.crc32)
            else:
                draft.base = unsure.sent

    async def look_at_all(self) -> float:
        """Look at all files whose placing was interrupted, unless a delivery or a change of the name does;
        return in how many seconds that is to be done again, infinite if it is not."""
        again = inf
        for node in self._context.nodes:
            if node.unsure is None:
                continue
            if node.lock.locked():
                again = min(again, LOOK_AGAIN)
                continue
            try:
                async with node.lock:
                    await self.look(node)
            except MavftpfsError as error:
                log.info("what has the name %r is not known yet: %s", node.path, error)
                again = min(again, IN_FLIGHT if isinstance(error, Armed) else LOOK_AGAIN)
            else:
                self._context.nodes.maybe_forget(node)
        return again

    # --- sending

    async def _send(self, node: Node, draft: Draft) -> None:
        """Send the whole file, compare it, and rename it into place."""
        self._require_deliverable(draft)  # before anything is fetched for it
        if not draft.whole:
            try:
                await base.fetch(self._context, node, draft)
            except FileChanged:
                draft.lose_base()
                raise
        attempt = await self._attempt(node, draft)
        attempt.sending.growing = False
        await attempt.upload.finish()
        if attempt.sending.unacked:
            raise RemoteProtocolError(f"{attempt.path!r} was said to be finished, and was not")
        await self._context.store.wait_out(attempt.path)
        crc32 = await self._compare_and_look(node, draft, attempt)
        with self._context.store.finishing():
            node.attempt = None
            draft.end_attempt()
            await attempt.upload.end()
            if not attempt.in_place:
                await self._place(node, draft, attempt, crc32)
        if not attempt.in_place:
            await self._compare_again(node, draft, attempt, crc32)
            self._names.settle(node)
        self._on_delivered(node, draft, crc32)

    async def _attempt(self, node: Node, draft: Draft) -> Attempt:
        """Return the attempt under way if it still fits, else a new one."""
        context, attempt, path = self._context, node.attempt, node.path
        traits = context.store.traits
        self._require_deliverable(draft)
        if attempt is not None and attempt.fits(draft, in_place=traits.rename_works is False):
            return attempt
        if attempt is not None:
            await self.abandon(node)
        # With `inplace` the card may have no room for both files, so it is found out before any file.
        overwrites = context.options.inplace and draft.base is not None
        if traits.rename_works is None and (draft.size >= START_AT or overwrites):
            await self._names.learn_rename_works(path)
            self._require_deliverable(draft)
        in_place = traits.rename_works is False  # then it is sent under its own name
        begun_at = context.clock()
        if in_place:
            await self._require_untouched(node, draft)
            await context.store.wait_out(path)
        else:
            path = context.own.need(node.path, Kind.NEW)
        try:
            sending = draft.begin(in_place=in_place, progress=partial(self._throttle.on_acked, draft))
            upload = context.store.open_upload(path, sending)
        except MavftpfsError:
            draft.end_attempt()
            context.own.on_gone(path)
            raise
        attempt = node.attempt = Attempt(path, in_place, sending, upload, begun_at)
        if in_place:
            context.directories.put(path, DirEntry(b"", EntryKind.FILE))
        return attempt

    async def _compare_and_look(self, node: Node, draft: Draft, attempt: Attempt) -> int | None:
        """Compare what was sent, and check what has the name; return the CRC32 if it was compared.

        Requests that the server answers at once go out together. A long checksum goes alone, because requests
        behind it would be repeated meanwhile. The name is checked after it: others may take the name while it
        is computed.

        Raises:
            As Verifier.check and _require_untouched.
        """
        # A second CreateFile may have emptied the file, and later writes hide that from its size.
        doubted = self._context.store.in_doubt(attempt.begun_at) or attempt.upload.made_twice
        compare = partial(self.verifier.check, attempt.path, draft, doubted=doubted)
        look = partial(self._require_untouched, node, draft)
        if draft.size <= SHORT:
            crc32 = await together(compare, look)
        else:
            crc32 = await compare()
            await look()
        return crc32

    async def _require_untouched(self, node: Node, draft: Draft) -> None:
        """Check that others left the name alone: a new file's is free, and a base of which a part stays is
        still the same.

        Raises:
            AlreadyExists. FileChanged: the draft is stale from now on. Else as Names.is_free and
            Verifier.is_same.
        """
        path = node.path
        if draft.base is not None and draft.base_limit and not draft.sent_in_place:
            if not await self.verifier.is_same(path, draft.base):
                draft.lose_base()
                raise FileChanged(f"others changed {path!r} on the vehicle while it was changed here")
        elif draft.base is None and not draft.sent_in_place:
            free = await self._names.is_free(path) or await self._is_empty_in_place(path)
            if not free:
                raise AlreadyExists(f"{path!r} was made by somebody else in the meantime")

    async def _is_empty_in_place(self, path: bytes) -> bool:
        """Return whether files are sent under their own names, and an empty one is there: a CreateFile of
        ours that was not answered may have made it, and else there is nothing to lose."""
        return self._context.store.traits.rename_works is False and await self._names.size(path) == 0

    async def _place(self, node: Node, draft: Draft, attempt: Attempt, crc32: int | None) -> None:
        """Rename what was sent and verified into place. crc32: as the vehicle told it, if it did.

        Raises:
            As Names.place.
        """
        self._context.directories.put(attempt.path, DirEntry(b"", EntryKind.FILE, draft.size))
        try:
            await self._names.place(node, attempt.path, Known(draft.size, crc32=crc32))
        except OutcomeUnknown:
            raise
        except MavftpfsError:
            await self._names.discard(attempt.path)
            raise

    async def _compare_again(self, node: Node, draft: Draft, attempt: Attempt, crc32: int | None) -> None:
        """Compare a file once more, under its own name, where the ACK of its rename is not proof enough.

        A late duplicate of its CreateFile may have emptied it after it was compared. A late duplicate of an
        earlier rename may have taken it away. A server may ACK a rename and do something else: it is believed
        once it was seen to rename. If this is interrupted, the file stays unsure.

        Raises:
            VerificationFailed: it is not there, so it is sent again, whatever has the name. Else as
            Verifier.check.
        """
        store, path = self._context.store, node.path
        doubted, unproven = store.in_doubt(attempt.begun_at), store.traits.rename_works is None
        try:
            if doubted or (unproven and crc32 is not None):
                await self.verifier.check(path, draft, doubted=doubted)
            elif (unproven or attempt.upload.made_twice) and await self._names.size(path) != draft.size:
                raise VerificationFailed(f"{path!r} is not what was sent: it is gone, or was emptied")
        except VerificationFailed:
            draft.not_confirmed()
            if unproven:
                await self._names.learn_rename_works(path)
            raise
        store.traits.rename_works = True

    # --- after

    def _on_delivered(self, node: Node, draft: Draft, crc32: int | None) -> None:
        """Note that the vehicle has the draft: update listings, blocks and checksums."""
        context = self._context
        context.directories.put(node.path, DirEntry(b"", EntryKind.FILE, draft.size))
        if crc32 is None and draft.size <= context.options.verify_max:
            crc32 = draft.crc32()
        draft.delivered(crc32)
        context.nodes.forget_broken(node.path)
        node.generation += 1
        node.delivered_since_open = True
        node.proven_at = context.clock()
        context.files.on_changed(node.path)

    def _note_failure(self, node: Node, draft: Draft, error: MavftpfsError) -> None:
        """Remember the error for the next close, and make the bytes survive a loss of power."""
        known, node.error = node.error, error
        level = logging.DEBUG if isinstance(error, Armed) or str(known) == str(error) else logging.WARNING
        log.log(level, "%r is not delivered: %s", node.path, error)  # once: each close tries again
        if node.draft is draft:
            self._persist(node, draft)

    def _persist(self, node: Node, draft: Draft) -> None:
        """Hold the bytes of a file, and what is known of it, where they outlive this process."""
        try:
            draft.content.persist(describe(node.path, draft, node.error, self._context.wall))
        except (NoSpace, SpoolFailed, OSError) as trouble:
            log.warning("%r may be lost when this mount ends: %s", node.path, trouble)
