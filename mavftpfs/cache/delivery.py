"""Brings drafts to the vehicle, and knows that they are there. Layer: cache.

`deliver` returns when the vehicle has the file, checked (promise 2), or raises why not; what was not
delivered stays held, and the next call goes on. While it runs the file is not written (`Node.quiet`), so
what is verified is what was sent. Uploads begin earlier, in the background, where that is of use.

One way leads to the card: the whole file is sent under a reserved name, verified there, and renamed into
place (`draft`, `replace`). Only cards that cannot rename get it under its own name.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import astuple

import trio

from mavftpfs.cache import base
from mavftpfs.cache.cleaner import Cleaner
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import SENDING, Draft, Event, Plan, State, choose
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Attempt, Node
from mavftpfs.cache.recovery import describe
from mavftpfs.cache.replace import Replacer
from mavftpfs.cache.throttle import Throttle
from mavftpfs.cache.verify import Verifier
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FtpNak,
    LinkError,
    MavftpfsError,
    NoSpace,
    OutcomeUnknown,
    PathTooLong,
    RemoteProtocolError,
    RequestTimeout,
    SessionBusy,
    SpoolFailed,
    VerificationFailed,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split

log = logging.getLogger("mavftpfs.cache")

MAX_STEPS = 8
"""Steps of one delivery: each but the last learnt something of the server or fetched the base."""

MISMATCHES = 2
"""After so many copies that are not what was sent the delivery fails."""

FINISHES = 3
"""How often an upload is asked to end because the source had more."""

PASSING = (RequestTimeout, LinkError, SessionBusy, Armed)
"""Errors after which the upload goes on where it stopped."""


class Deliverer:
    """Executes plans.

    Attributes:
        on_undelivered: called when a delivery ended without success.
    """

    def __init__(
        self,
        context: Context,
        names: Names,
        replacer: Replacer,
        cleaner: Cleaner,
        throttle: Throttle,
    ) -> None:
        self._context = context
        self._names = names
        self._replacer = replacer
        self._cleaner = cleaner
        self._throttle = throttle
        self.verifier = Verifier(context, names)
        self.delivered = 0
        self.on_undelivered: Callable[[], None] = lambda: None

    async def deliver(self, node: Node, *, wanted: Callable[[], bool] = lambda: True) -> None:
        """Have the vehicle hold the node's file, checked, as long as that is `wanted`.

        Raises:
            The reason why not: as WriteStore; VerificationFailed, NotSupported, FileTooLarge, FileChanged.
        """
        while wanted():
            await node.spared.wait()
            async with self._context.paths.steady(lambda: node.path, lasting=True), node.lock:
                if node.removed or not node.undelivered:
                    await self.abandon(node)
                    return
                with node.delivering() as scope:
                    await self._deliver_or_note(node)
                if not scope.cancelled_caught:
                    return

    async def begin(self, node: Node) -> bool:
        """Begin to send a draft that may still grow; return False if that has to wait for a close.

        Raises:
            As deliver.
        """
        await node.spared.wait()
        async with self._context.paths.steady(lambda: node.path, lasting=True), node.lock:
            if node.removed or not node.undelivered:
                return True
            with node.delivering():
                plan = self._plan(node)
                if plan is Plan.FIND_OUT:
                    await self._find_out(node)
                    plan = self._plan(node)
                if plan not in SENDING:
                    return False
                await self._attempt(node, plan)
        return True

    async def abandon(self, node: Node) -> None:
        """Give up the present attempt; what it left under reserved names goes now or at the next listing. The
        caller has the node's lock, or holds its path alone."""
        attempt, node.attempt = node.attempt, None
        if attempt is None:
            return
        if node.draft is not None and node.draft.sending is attempt.sending:
            node.draft.give_up()
        try:
            await attempt.upload.abort()
            if attempt.plan is Plan.REPLACE:
                await self._replacer.remove(node.path, *attempt.names)
        finally:
            self._release(attempt)

    # --- one delivery

    async def _deliver_or_note(self, node: Node) -> None:
        node.quiet = trio.Event()
        try:
            if node.path not in self._context.own.torn:  # else its name lacks a file until this is done
                self._context.require_disarmed()
            await self._deliver(node)
            node.error = None
            node.background = True
        except MavftpfsError as error:
            self._note_failure(node, error)
            raise
        finally:
            node.quiet.set()
            self._throttle.let_go()
            if node.undelivered:  # also if who waited for it gave up
                self.on_undelivered()

    async def _deliver(self, node: Node) -> None:
        mismatches = 0
        for _ in range(MAX_STEPS):
            plan = self._plan(node)
            if plan is Plan.NOTHING:
                return
            known = astuple(self._context.writer.traits)
            try:
                await self._step(node, plan)
            except VerificationFailed as error:
                mismatches += 1
                await self.abandon(node)
                if mismatches == MISMATCHES or isinstance(error.__cause__, Armed):  # none can be checked
                    raise
                log.warning("%s; sending it again", error)
            except MavftpfsError as error:
                resumable = isinstance(error, PASSING) and _draft(node).size > 0
                if not resumable:
                    await self.abandon(node)
                learnt = astuple(self._context.writer.traits) != known
                if not learnt or isinstance(error, LinkError | Armed):
                    raise
                log.debug("%r: %s; trying another way", node.path, error)
        raise VerificationFailed(f"no way of writing {node.path!r} led to an end")

    def _plan(self, node: Node) -> Plan:
        draft = _draft(node)
        if node.path in self._context.own.torn and draft.state is State.DIRTY:
            return Plan.MEND  # it was written again before its name had a file
        return choose(draft, self._context.writer.traits, inplace=self._context.options.inplace)

    async def _step(self, node: Node, plan: Plan) -> None:
        if plan in SENDING:
            await self._send(node, plan)
        elif plan is Plan.FIND_OUT:
            await self._find_out(node)
        elif plan is Plan.FETCH:
            await base.fetch(self._context, node)
        else:
            await self._mend(node)

    async def _find_out(self, node: Node) -> None:
        """See on an empty file of our own whether the card can rename.

        Raises:
            As WriteStore.create_empty and rename.
        """
        context = self._context
        context.namer.fresh(node.path)  # raises PathTooLong, before anything is sent
        try:
            first, second = context.namer.pair(node.path)
        except PathTooLong:
            context.writer.traits.rename_works = True  # it shows when the file is to get its name
            return
        context.own.live |= {first, second}
        left = first
        try:
            await context.writer.create_empty(first)
            left = await self._try_to_rename(first, second)
        finally:
            context.own.live -= {first, second}
            context.dentries.expire(split(first)[0])
        await self._replacer.remove(node.path, left)

    async def _try_to_rename(self, first: bytes, second: bytes) -> bytes:
        """Return the name that the file has then. One refusal may be of that moment only."""
        try:
            await self._names.rename(first, second)
        except FtpNak:
            try:
                await self._names.rename(first, second)
            except FtpNak as nak:
                if not await self._names.cannot_rename(first, second, nak):
                    raise
                return first
        return second

    async def _mend(self, node: Node) -> None:
        """The renames of this file were interrupted: have them completed or undone, and look what came of it.

        Raises:
            As Directories.ask and Verifier.check.
        """
        draft, own = _draft(node), self._context.own
        await self._cleaner.mend(node)
        there = await self._names.ask(node.path) is not None
        own.torn.pop(node.path, None)
        if draft.state is not State.TORN:
            return
        try:
            crc32 = await self.verifier.check(node.path, draft, doubted=True) if there else None
        except VerificationFailed:
            there = False
        if there:
            self._on_delivered(node, crc32)
        else:
            draft.on(Event.REFUSED)

    # --- sending

    async def _send(self, node: Node, plan: Plan) -> None:
        attempt = await self._attempt(node, plan)
        await self._finish(attempt)
        draft, writer = _draft(node), self._context.writer
        doubted = attempt.sending.rewritten or writer.in_doubt() or writer.doubted_since(attempt.begun_at)
        crc32 = await self.verifier.check(attempt.path, draft, doubted=doubted)
        if plan is Plan.REPLACE:
            await self._require_expected(node)
            await self._commit(node, attempt)
        else:
            node.attempt = None
            await attempt.upload.abort()
        self._on_delivered(node, crc32)

    async def _attempt(self, node: Node, plan: Plan) -> Attempt:
        """Return the attempt under way if it still fits, else a new one."""
        attempt = node.attempt
        if attempt is not None and attempt.plan is plan and not attempt.sending.overtaken:
            return attempt
        await self.abandon(node)
        draft, context = _draft(node), self._context
        path, places = node.path, None
        if plan is Plan.OVERWRITE or isinstance(node.error, AlreadyExists):  # which all of it was sent for
            await self._require_expected(node)
        if plan is Plan.OVERWRITE:
            pass
        elif draft.base is None:
            path = context.namer.fresh(node.path)
            context.own.live.add(path)
        else:
            places = context.namer.places(node.path)
            path = places.new
            context.own.live |= places.all
        begun_at = context.clock()
        try:
            if places is not None:
                await self._replacer.write_sidecar(places, node.path)
            sending = draft.begin(in_place=plan is Plan.OVERWRITE)
            sending.progress = self._throttle.on_acked
            upload = await context.writer.open_upload(path, sending)
        except BaseException:
            draft.give_up()
            context.own.live -= {path} if places is None else places.all
            raise
        node.attempt = Attempt(plan, path, sending, upload, begun_at, places)
        if plan is Plan.OVERWRITE:
            context.dentries.put(path, DirEntry(b"", EntryKind.FILE))
        return node.attempt

    async def _require_expected(self, node: Node) -> None:
        """Check that a new file's name is free, or that the file of which a part stays is still the same.

        Raises:
            AlreadyExists, FileChanged. Else as Names.is_free and base.require_same.
        """
        draft = _draft(node)
        if draft.base_limit:
            await base.require_same(self._context, node, self.verifier)
        elif draft.base is None and not draft.begun and not await self._names.is_free(node.path):
            raise AlreadyExists(f"{node.path!r} was made by somebody else in the meantime")

    async def _finish(self, attempt: Attempt) -> None:
        attempt.sending.growing = False
        for _ in range(FINISHES):
            attempt.upload.wake()
            await attempt.upload.finish()
            if not attempt.sending.unacked:
                return
        raise RemoteProtocolError(f"{attempt.path!r} was said to be finished, and was not")

    async def _commit(self, node: Node, attempt: Attempt) -> None:
        """Rename what was sent and verified into place.

        Raises:
            As Replacer. VerificationFailed: it is not what it was any more.
        """
        draft, context = _draft(node), self._context
        node.attempt = None
        try:
            await attempt.upload.abort()
        except BaseException:  # nobody waits any more: all of it is sent again
            draft.give_up()
            context.own.leave(attempt.names, node.path)
            self._release(attempt)
            raise
        context.dentries.put(attempt.path, DirEntry(b"", EntryKind.FILE, draft.size))
        draft.commit()
        try:
            if attempt.places is None:
                await self._replacer.place(attempt.path, node.path)
            else:
                await self._replacer.replace(attempt.path, node.path, attempt.places)
            if attempt.upload.resent and await self.verifier.size(node.path) != draft.size:
                draft.interrupted(ours=True)
                raise VerificationFailed(f"{node.path!r} was emptied by a request that came twice")
        except BaseException as error:
            await self._on_not_placed(node, attempt, error)
            raise
        finally:
            self._release(attempt)

    async def _on_not_placed(self, node: Node, attempt: Attempt, error: BaseException) -> None:
        draft = _draft(node)
        if draft.state is not State.COMMITTING:
            return
        unknown = isinstance(error, OutcomeUnknown) or not isinstance(error, MavftpfsError)
        if unknown or node.path in self._context.own.torn:
            draft.interrupted()
            return
        draft.on(Event.REFUSED)
        await self._replacer.remove(node.path, *attempt.names)

    # --- after

    def _release(self, attempt: Attempt) -> None:
        """What is left under the attempt's names is for the next listing to clean up."""
        self._context.own.live -= {attempt.path} if attempt.places is None else attempt.places.all

    def _on_delivered(self, node: Node, crc32: int | None) -> None:
        """The vehicle has it: listings, blocks and checksums follow."""
        context, draft = self._context, _draft(node)
        context.dentries.put(node.path, DirEntry(b"", EntryKind.FILE, draft.size), proven=True)
        if crc32 is None and draft.size <= context.options.verify_max:
            crc32 = draft.crc32()
        draft.delivered(crc32)
        node.generation += 1
        node.known_at = context.clock()
        node.close_base()
        context.files.on_written(node.path)
        self.delivered += 1

    def _note_failure(self, node: Node, error: MavftpfsError) -> None:
        """Latch the error, and keep the bytes where the end of this process does not lose them."""
        known, node.error = node.error, error
        draft, content = node.draft, node.content
        level = logging.DEBUG if isinstance(error, Armed) or str(known) == str(error) else logging.WARNING
        log.log(level, "%r is not delivered: %s", node.path, error)  # once: each close tries again
        if draft is None or content is None:
            return
        try:
            content.persist(describe(node, draft, self._context.wall))
        except (NoSpace, SpoolFailed, OSError) as trouble:
            log.warning("%r is kept in memory only: %s", node.path, trouble)


def _draft(node: Node) -> Draft:
    assert node.draft is not None
    return node.draft
