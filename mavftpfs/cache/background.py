"""Delivers while nobody waits for it. Layer: cache.

Uploads begin while the program still writes; one that cannot begin is tried again after a pause, and when the
link is back. What a close could not deliver is tried again, too, ever more seldom, until the vehicle has it
or refuses it: a link that fails and returns between two looks at its heartbeats is no news to anybody. Nor is
room on a card that was full: it is asked again after minutes, and then hours.

What was sent in place, or of a new file, is delivered when its program writes nothing more for a while: by
the next write its name may be another file's, which is only seen of what was delivered (`base.require_same`).
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import PASSING, Deliverer
from mavftpfs.cache.nodes import Attempt, Node
from mavftpfs.cache.plan import Plan
from mavftpfs.cache.sending import FULL
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.cache")

START_AT = 64 * 1024
"""A background upload begins when so many bytes wait; fewer wait for the close."""

START_PAUSE = 5.0
"""Seconds after which one that could not begin is tried again."""

FIRST_PAUSE, LONGEST_PAUSE = 2.0, 30.0
"""Seconds between two attempts to deliver what nobody has open."""

REST = 2.0
"""Seconds without a write after which what was sent of a file that stays open is delivered."""

ROOM_PAUSES = (120.0, 3600.0)
"""The same for what the card had no room for: most of a file may travel before that shows again."""


class Background:
    """Needs the context's nursery; without one nothing is delivered before it is asked for."""

    def __init__(
        self,
        context: Context,
        deliverer: Deliverer,
        throttle: Throttle,
        *,
        mend: Callable[[], Awaitable[None]],
    ) -> None:
        """`mend()` gives torn names their files (Cleaner)."""
        self._context = context
        self._mend = mend
        self._deliverer = deliverer
        self._throttle = throttle
        self._pause = FIRST_PAUSE
        self._redelivering = self._awaits_room = False
        deliverer.on_undelivered = self.redeliver
        deliverer.replacer.on_torn = self.redeliver

    def kick(self, node: Node) -> None:
        """The draft got more: send it, or begin to, if that can be done beside the program."""
        if node.attempt is not None and not node.overtaken:
            if not node.attempt.ended:
                node.attempt.sending.growing = node.quiet.is_set()  # nobody writes to one being delivered
                node.attempt.upload.wake()
        elif self._context.nursery is not None and (self._may_start(node) or node.overtaken):
            node.starting = True
            self._context.nursery.start_soon(self._start, node)

    def on_cut(self, node: Node) -> None:
        """The draft was cut: what is on its way in place stays away, unless that is the way still."""
        if node.attempt is None or node.attempt.plan is not Plan.IN_PLACE:
            return
        assert node.draft is not None
        with suppress(MavftpfsError):
            if self._deliverer.plan(node) is Plan.IN_PLACE:
                return
        node.draft.give_way()

    def settle(self, node: Node) -> None:
        """Nobody has the file open: forget it, if the vehicle has it; what still sends it is called off."""
        if node.needless and node.attempt is not None and self._context.nursery is not None:
            self._context.nursery.start_soon(self._call_off, node)
        self._context.nodes.maybe_forget(node)

    async def link_back(self) -> None:
        """What failed, or was refused, may work now."""
        self._pause = FIRST_PAUSE
        await self._mend()
        for node in self._context.nodes:
            node.start_after = float("-inf")
            self.kick(node)
        await self._deliver_closed(lambda node: True)

    def redeliver(self) -> None:
        """Something was not delivered, or left a name without a file: try again by and by."""
        nursery = self._context.nursery
        if nursery is not None and not self._redelivering:
            self._redelivering = True
            self._pause = FIRST_PAUSE
            nursery.start_soon(self._redeliver)
        if nursery is not None and not self._awaits_room and self._any(_lacked_room):
            self._awaits_room = True
            nursery.start_soon(self._await_room)

    # --- inside

    def _may_start(self, node: Node) -> bool:
        context, draft = self._context, node.draft
        if draft is None or not node.background or node.starting or not _may_pass(node):
            return False
        if context.clock() < node.start_after:
            return False
        blocked = context.armed and not context.options.write_armed
        return draft.unacked >= START_AT and node.undelivered and not blocked

    async def _start(self, node: Node) -> None:
        """Begin an upload while the program still writes, or end one that may not go on."""
        try:
            async with node.lock:
                if node.overtaken:
                    await self._deliverer.abandon(node)
                elif node.attempt is None and node.undelivered:
                    node.background = await self._deliverer.begin_locked(node)
                    self.on_cut(node)  # it may have been, meanwhile
                    if node.overtaken:
                        await self._deliverer.abandon(node)
                    else:
                        self.kick(node)
                        self._watch(node)
        except MavftpfsError as error:
            node.start_after = self._context.clock() + START_PAUSE
            log.info("%r is not sent just now: %s", node.path, error)
        finally:
            node.starting = False
            self._throttle.let_go()
        self._context.nodes.maybe_forget(node)

    def _watch(self, node: Node) -> None:
        """An upload began: see that it does not go on after a rest, if that may be in another file."""
        attempt, nursery = node.attempt, self._context.nursery
        if attempt is None or nursery is None or not self._context.directories.tells_times:
            return
        goes_on = self._context.writer.traits.wo_truncates is False
        if attempt.plan is Plan.IN_PLACE or (attempt.plan is Plan.NEW and goes_on):
            nursery.start_soon(self._rest, node, attempt)

    async def _rest(self, node: Node, attempt: Attempt) -> None:
        pause = REST
        while node.attempt is attempt and node.writers:
            if (rest := node.written_at + REST - self._context.clock()) > 0.0:
                pause = REST
                await trio.sleep(rest)
            else:
                if attempt.sending.unacked < FULL:
                    await self._deliver_resting(node, attempt)
                await trio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    async def _deliver_resting(self, node: Node, attempt: Attempt) -> None:
        """Deliver a file unless its program goes on, which does not wait for that, or did so meanwhile."""
        with trio.CancelScope() as scope:
            node.resting = scope
            try:
                async with node.lock:
                    if not node.doomed and node.attempt is attempt and self._goes_on(node, attempt):
                        await self._deliverer.deliver_locked(node)
            except MavftpfsError as error:
                log.debug("%r is not delivered while its program rests: %s", node.path, error)
            finally:
                node.resting = None

    def _goes_on(self, node: Node, attempt: Attempt) -> bool:
        """Return whether an attempt is still the way of a file: one that was emptied stays so here."""
        if node.draft is None or not node.undelivered:
            return False
        with suppress(MavftpfsError):
            return attempt.fits(self._deliverer.plan(node), node.draft)
        return False

    async def _call_off(self, node: Node) -> None:
        async with node.lock:
            if node.needless:
                await self._deliverer.abandon(node)
        self._context.nodes.maybe_forget(node)

    async def _redeliver(self) -> None:
        try:
            while self._context.torn or self._any(_may_pass):
                pause, self._pause = self._pause, min(2 * self._pause, LONGEST_PAUSE)
                await trio.sleep(pause)
                await self._mend()
                await self._deliver_closed(_may_pass)
        finally:
            self._redelivering = False

    async def _await_room(self) -> None:
        pause, longest = ROOM_PAUSES
        try:
            while self._any(_lacked_room):
                await trio.sleep(pause)
                pause = min(2 * pause, longest)
                await self._deliver_closed(_lacked_room)
        finally:
            self._awaits_room = False

    def _any(self, which: Callable[[Node], bool]) -> bool:
        return any(node.undelivered and which(node) for node in self._context.nodes)

    def _is_left_to_us(self, node: Node) -> bool:
        return node.undelivered and (not node.writers or node.path in self._context.torn)

    async def _deliver_closed(self, which: Callable[[Node], bool]) -> None:
        """Try once what nobody writes any more, and what left a name without a file."""
        for node in self._context.nodes:
            wanted = partial(self._is_left_to_us, node)
            if not wanted() or not which(node):
                continue
            try:
                await self._deliverer.deliver(node, wanted=wanted)
            except MavftpfsError as error:
                log.debug("%r is still not delivered: %s", node.path, error)
            else:
                self._context.nodes.maybe_forget(node)


def _may_pass(node: Node) -> bool:
    """Return whether what kept a file from being delivered, if anything did, may be over by itself."""
    return node.error is None or isinstance(node.error, PASSING)


def _lacked_room(node: Node) -> bool:
    """Return whether a file is not delivered because it did not fit: others may be removed."""
    return node.error is not None and errno_for(node.error) == errno.ENOSPC
