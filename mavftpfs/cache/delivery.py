"""Brings drafts to the vehicle, and knows that they are there. Layer: cache.

`deliver` returns when the vehicle has the file, checked (promise 2), or raises why not; what was not
delivered stays held, and the next call goes on. While it runs the file is not written (`Node.quiet`), so
what is verified is what was sent. Uploads begin earlier, in the background, where that is of use.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import astuple

import trio

from mavftpfs.cache import base, overwritten
from mavftpfs.cache.context import Context
from mavftpfs.cache.dating import Dater
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Attempt, Node
from mavftpfs.cache.plan import SENDING, Plan, Rules, choose
from mavftpfs.cache.probes import Prober
from mavftpfs.cache.recovery import describe
from mavftpfs.cache.remote import FREE_FOR
from mavftpfs.cache.replacing import Present, Replacer
from mavftpfs.cache.sure import Sure, may_have_made
from mavftpfs.cache.throttle import Throttle
from mavftpfs.cache.verify import Verifier
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileChanged,
    LinkError,
    MavftpfsError,
    NoSpace,
    RemoteProtocolError,
    RequestTimeout,
    SessionBusy,
    SpoolFailed,
    VerificationFailed,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split

log = logging.getLogger("mavftpfs.cache")

MAX_STEPS = 8
"""Plans tried in one delivery: each but the last one learnt something of the server or fetched the base."""

FINISHES = 3
PASSING = (RequestTimeout, LinkError, SessionBusy, Armed)
"""Errors after which the upload goes on where it stopped."""


class Deliverer:
    """Executes plans.

    Attributes:
        on_undelivered: called when a delivery ended without success.
    """

    def __init__(self, context: Context, sure: Sure, throttle: Throttle) -> None:
        self._context = context
        self._throttle = throttle
        self._rules = Rules(context.options.rmw_max, inplace=context.options.inplace)
        self.replacer = Replacer(context, sure)
        self.verifier = Verifier(context, sure)
        self._prober = Prober(context)
        self.dater = Dater(context)
        self.delivered = 0
        self.on_undelivered: Callable[[], None] = lambda: None

    async def deliver(self, node: Node, *, wanted: Callable[[], bool] = lambda: True) -> None:
        """Have the vehicle hold the node's file, checked, as long as that is `wanted`.

        Raises:
            The reason why not: as WriteStore; VerificationFailed, NotSupported, FileTooLarge, FileChanged.
        """
        while wanted():
            async with node.lock:
                if not node.doomed and await self.deliver_locked(node):
                    return

    async def deliver_locked(self, node: Node) -> bool:
        """Do the same for who holds the node's lock; return False if it was called off (Node.doomed)."""
        with node.delivering() as scope:
            await self._deliver_or_note(node)
        return not scope.cancelled_caught

    async def _deliver_or_note(self, node: Node) -> None:
        if not node.undelivered:
            await self.abandon(node)  # what was written since it began was taken back
            return
        node.quiet = trio.Event()
        try:
            if node.path not in self._context.torn:  # else its name lacks a file until this is done
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

    async def begin_locked(self, node: Node) -> bool:
        """Prepare to send a draft that may still grow; return False if that has to wait for a close.

        Raises:
            As deliver.
        """
        with node.delivering():
            plan = self.plan(node)
            if plan is Plan.PROBE:
                await self._prober.probe(node.path)
                plan = self.plan(node)
            if plan not in SENDING or plan is Plan.REWRITE:
                return False
            await self._attempt(node, plan)
        return True

    def let_go(self) -> None:
        """A file lost its name: who waits to write it need not wait."""
        self._throttle.let_go()

    def plan(self, node: Node) -> Plan:
        """Return the next step for the node's draft. Raises as plan.choose."""
        return choose(_draft(node), self._context.writer.traits, self._rules)

    async def abandon(self, node: Node) -> None:
        """Give up the present attempt; what it left under reserved names goes now or at the next listing."""
        async with node.firmly():
            attempt, node.attempt = node.attempt, None
            if attempt is not None:
                await self._abandon(node, attempt)

    async def _abandon(self, node: Node, attempt: Attempt) -> None:
        places = attempt.places
        try:
            try:
                await attempt.upload.abort()
            finally:  # also if who waits for it gives up
                self._note_abandoned(node, attempt)
            if places is not None and not attempt.committing:
                await self.replacer.clean(node.path, places, new=attempt.upload.begun)
            elif places is not None and node.path in self._context.torn:
                self.replacer.leave(node.path, places)
        finally:
            if places is not None:
                self.replacer.release(places)

    def _note_abandoned(self, node: Node, attempt: Attempt) -> None:
        if node.draft is not None:
            node.draft.made |= attempt.plan is Plan.NEW and attempt.upload.begun
            node.draft.begin_again()
        if attempt.plan is Plan.NEW and not attempt.upload.begun:
            self._context.dentries.expire(split(node.path)[0], self._context.clock())  # it shows the file
        elif attempt.path == node.path:
            self._context.dentries.note_unsized(node.path, made=attempt.plan is Plan.NEW)

    # --- planning

    async def _deliver(self, node: Node) -> None:
        mismatches = 0
        for _ in range(MAX_STEPS):
            draft = _draft(node)
            if draft.stretched and not draft.fresh and node.attempt is None:
                draft.has_size(await self.verifier.size(node.path))
            plan = self.plan(node)
            if plan is Plan.NOTHING:
                await self.abandon(node)
                return
            known = astuple(self._context.writer.traits)
            try:
                await self._step(node, plan)
            except VerificationFailed as error:
                mismatches += 1
                await self.abandon(node)
                if mismatches > 1 or isinstance(error.__cause__, Armed):  # no second copy can be checked
                    raise
                log.warning("%s; sending it again", error)
            except MavftpfsError as error:
                learnt = astuple(self._context.writer.traits) != known
                restores = draft.ruined and draft.whole and plan is Plan.IN_PLACE
                if not isinstance(error, PASSING):
                    await self.abandon(node)
                if isinstance(error, AlreadyExists) and await self._is_ours(node.path, draft):
                    continue
                if not (learnt or restores) or isinstance(error, LinkError | Armed):
                    raise
                log.debug("%r: %s; trying another way", node.path, error)
        raise VerificationFailed(f"no way of writing {node.path!r} led to an end")

    async def _step(self, node: Node, plan: Plan) -> None:
        if plan in SENDING:
            await self._send(node, plan)
        elif plan is Plan.PROBE:
            await self._prober.probe(node.path)
        elif plan is Plan.FILL:
            await base.fill(self._context, node)
        else:
            await self.abandon(node)
            if plan is Plan.TRUNCATE and not _draft(node).changed.empty:
                await self._cut_first(node, _draft(node))
            else:
                await self._act(node, plan)

    async def _act(self, node: Node, plan: Plan) -> None:
        """Do what takes one request."""
        draft = _draft(node)
        if plan is Plan.CREATE_EMPTY:
            async with node.firmly():
                await self._create_empty(node.path, draft)
        else:
            since = self._context.clock()
            if (size := await self.verifier.size(node.path)) < draft.size:  # it would be filled up with zeros
                raise FileChanged(f"{node.path!r} has {size} bytes on the vehicle now: nothing to cut")
            await base.require_same(self._context, node, since)
            await base.cut(self._context, node, draft.size)
        await self.verifier.check(node.path, draft)
        self._on_delivered(node, draft)

    async def _cut_first(self, node: Node, draft: Draft) -> None:
        """Cut a file of which a part is to be changed, too."""
        await base.require_stays(self._context, node, self.verifier.size)
        await base.cut(self._context, node, draft.size)
        draft.remote_cut(draft.size)

    async def _create_empty(self, path: bytes, draft: Draft) -> None:
        try:
            await self._context.writer.create_empty(path, free_at=self._free_at(path, draft))
        except BaseException as error:  # also if who waits for it gives up
            if may_have_made(error):
                draft.maybe_made = True
                self._context.dentries.expire(split(path)[0], self._context.clock())
            raise
        draft.made = True
        # Whoever takes its name away before it was looked at has to find it there.
        self._context.dentries.note_created(path, DirEntry(split(path)[1], EntryKind.FILE, 0))
        self._context.dentries.note_proven(path, self._context.clock())

    async def _is_ours(self, path: bytes, draft: Draft) -> bool:
        """Return whether a file that appeared is the empty one we may have made; note it if so."""
        self._context.dentries.expire(split(path)[0], self._context.clock())
        draft.made = draft.maybe_made and await self.verifier.size(path) == 0
        return draft.made

    # --- sending

    async def _send(self, node: Node, plan: Plan) -> None:
        attempt = await self._attempt(node, plan)
        draft, told, ended_at = _draft(node), 0, float("inf")
        if not attempt.ended:
            await self._finish(attempt)
            if draft.ruined and attempt.plan is Plan.IN_PLACE:
                raise FileChanged(f"{node.path!r} was emptied on the vehicle while it was changed here")
            ended_at = self._context.clock()
            told = await self.verifier.check_sent(attempt.path, draft, attempt.upload)
        if attempt.places is not None and not attempt.committing:
            await self._require_old(node, draft, attempt)
        async with node.firmly():
            if not attempt.committing:
                attempt.ended = True
                await attempt.upload.abort()
            if attempt.places is not None:
                await self._commit(node, attempt)
                await self.verifier.check_replaced(node.path, draft, attempt.upload, told)
            node.attempt = None
            self._on_delivered(node, draft, ended_at)

    async def _attempt(self, node: Node, plan: Plan) -> Attempt:
        """Return the attempt under way if it still fits, else a new one."""
        draft = _draft(node)
        attempt = node.attempt
        if attempt is not None and attempt.fits(plan, draft):
            return attempt
        await self.abandon(node)
        least, begun_at = 0, self._context.clock()
        if not draft.fresh and not draft.ruined:
            least = await base.require_stays(self._context, node, self.verifier.size)
        elif draft.ruined and not draft.placed:
            await self._require_ruin(node, draft)
        path, places = node.path, None
        if plan is Plan.REPLACE:
            places = self._context.namer.places(node.path)
            path = places.new
        if plan is Plan.REWRITE:
            draft.remote_removed()
        free_at = self._free_at(path, draft) if plan is Plan.NEW else None
        if places is not None:
            self.replacer.reserve(places)
        try:
            if places is not None:
                await self.replacer.write_sidecar(places, node.path)
            await overwritten.fetch_endangered(self._context, node, plan)
            sending = draft.begin(whole=plan is not Plan.IN_PLACE)
            sending.progress = self._throttle.on_acked
            writer = self._context.writer
            if plan is Plan.IN_PLACE:
                upload = await writer.open_upload(path, sending, create=False, least=least)
            else:
                upload = await writer.open_upload(path, sending, create=True, free_at=free_at)
            if plan is Plan.NEW:
                self._context.dentries.note_created(path, DirEntry(split(path)[1], EntryKind.FILE, 0))
            if places is None:
                self._context.dentries.note_unsized(path)
        except BaseException:
            if places is not None:
                self.replacer.release(places)
            raise
        node.attempt = Attempt(plan, path, sending, upload, places, begun_at=begun_at)
        return node.attempt

    def _free_at(self, path: bytes, draft: Draft) -> float | None:
        """Return when a listing last showed the name of a new file to be free, None if it need not be."""
        return None if draft.on_vehicle else self._context.dentries.free_at(path)

    async def _require_ruin(self, node: Node, draft: Draft) -> None:
        """Raise FileChanged (or as Verifier.size) if a file lacks nothing: it is a successor, which stays."""
        with node.looking():
            size = await self.verifier.size(node.path)
        if draft.remote_size is not None and size >= draft.remote_size:
            raise FileChanged(f"{node.path!r} became another file while it was changed here")

    async def _require_old(self, node: Node, draft: Draft, attempt: Attempt) -> None:
        """Check that what a part was changed of did not become another file while all of it was sent.

        Raises:
            As base.require_stays.
        """
        lasted = self._context.clock() - attempt.begun_at
        if lasted > FREE_FOR and not draft.fresh and not draft.ruined:
            await base.require_stays(self._context, node, self.verifier.size)

    async def _finish(self, attempt: Attempt) -> None:
        attempt.sending.growing = False
        for _ in range(FINISHES):
            attempt.upload.wake()
            await attempt.upload.finish()
            if not attempt.sending.unacked or attempt.sending.emptied:
                return
        raise RemoteProtocolError(f"{attempt.path!r} was said to be finished, and was not")

    async def _commit(self, node: Node, attempt: Attempt) -> None:
        """Rename; if that was begun before, find out first how far it came."""
        draft, places = _draft(node), attempt.places
        assert places is not None
        if attempt.committing:
            present = await self.replacer.observe(places, node.path)
            if present.target and not present.new:  # renamed, or tidied up by somebody who took it for litter
                await self.verifier.check_doubted(node.path, draft)
        else:
            present = Present(new=True, old=False, target=True)
        attempt.committing = True
        draft.place()
        try:
            await self.replacer.replace(attempt.path, node.path, places, present)
        except MavftpfsError as error:
            if not isinstance(error, PASSING):
                attempt.committing = node.path in self._context.torn  # else all is where it was
                draft.placed = attempt.committing or isinstance(error, VerificationFailed)
            raise
        self.replacer.release(places)

    # --- after

    def _on_delivered(self, node: Node, draft: Draft, ended_at: float = float("inf")) -> None:
        """The vehicle has it: listings, blocks and checksums follow."""
        context = self._context
        shown = context.dentries.listed_since(node.path, ended_at)
        context.dentries.note_written(node.path, draft.size)
        context.dentries.note_proven(node.path, context.clock())
        draft.delivered()
        base.outdate(context, node)
        self.dater.on_known(node, shown)
        context.on_changed(node.path)
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
