"""Delivers while nobody waits for it. Layer: cache.

Uploads begin while the program still writes; one that cannot begin is tried again after a pause, and when the
link is back. What a close could not deliver is tried again, too, ever more seldom, until the vehicle has it
or refuses it: a link that fails and returns between two looks at its heartbeats is no news to anybody. Nor is
room on a card that was full: it is asked again after minutes, and then hours.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable
from functools import partial

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import PASSING, Deliverer
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.repair import Cleaner
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import Armed, MavftpfsError

log = logging.getLogger("mavftpfs.cache")

START_AT = 64 * 1024
"""A background upload begins when so many bytes wait; fewer wait for the close."""

START_PAUSE = 5.0
"""Seconds after which one that could not begin is tried again."""

PAUSES = (2.0, 30.0)
"""Seconds between two attempts to deliver what nobody has open: at first, and at most."""

ROOM_PAUSES = (120.0, 3600.0)
"""The same for what the card had no room for: most of a file may travel before that shows again."""


class Background:
    """Needs the context's nursery; without one nothing is delivered before it is asked for."""

    def __init__(self, context: Context, deliverer: Deliverer, throttle: Throttle, cleaner: Cleaner) -> None:
        self._context = context
        self._deliverer = deliverer
        self._throttle = throttle
        self._cleaner = cleaner
        self._retried: set[Callable[[Node], bool]] = set()
        context.retry_later = self.redeliver

    def kick(self, node: Node) -> None:
        """The draft got more: send it, or begin to, if that can be done beside the program."""
        attempt = node.attempt
        if attempt is not None and not attempt.sending.overtaken:
            attempt.sending.growing = node.idle.is_set()  # nobody writes to one being delivered
            attempt.upload.wake()
        elif self._context.nursery is not None and not node.starting:
            if attempt is not None and node.draft is not None and node.draft.size:
                node.start_after = float("inf")  # who changes what was sent does so again
            due = self._context.clock() >= node.start_after and not self._context.blocked
            much = attempt is not None or (node.draft is not None and node.draft.unacked >= START_AT)
            if due and much and node.undelivered and _may_pass(node):
                node.starting = True
                self._context.nursery.start_soon(self._start, node)

    def settle(self, node: Node) -> None:
        """Nobody has the file open: forget it, if the vehicle has it; what still sends it is called off."""
        if node.unneeded and node.attempt is not None and self._context.nursery is not None:
            self._context.nursery.start_soon(self._call_off, node)
        self._context.nodes.maybe_forget(node)

    async def link_back(self) -> None:
        """What failed, or was refused, may work now."""
        await self._cleaner.mend_torn()
        for node in self._context.nodes:
            node.start_after = float("-inf")
            self.kick(node)
        await self.deliver_each(self._is_left_to_us)

    async def deliver_each(self, wanted: Callable[[Node], bool]) -> None:
        """Try once to deliver each file that is wanted, as long as it is; errors are kept with the file."""
        for node in self._context.nodes:
            if not node.undelivered or not wanted(node):
                continue
            try:
                await self._deliverer.deliver(node, wanted=partial(wanted, node))
            except MavftpfsError as error:
                log.debug("%r is still not delivered: %s", node.path, error)
            else:
                self._context.nodes.maybe_forget(node)

    def redeliver(self) -> None:
        """Something was not delivered, or left a name without a file: try again by and by."""
        nursery = self._context.nursery
        for which, pauses in ((_may_pass, PAUSES), (_lacked_room, ROOM_PAUSES)):
            if nursery is not None and which not in self._retried:
                self._retried.add(which)
                nursery.start_soon(self._retry, which, *pauses)

    # --- inside

    async def _start(self, node: Node) -> None:
        """Begin an upload while the program still writes."""
        try:
            if not await self._deliverer.begin(node):
                node.start_after = float("inf")
        except MavftpfsError as error:
            node.start_after = self._context.clock() + START_PAUSE
            level = logging.DEBUG if isinstance(error, Armed) else logging.INFO  # one line is enough for all
            log.log(level, "%r is not sent just now: %s", node.path, error)
        finally:
            node.starting = False
            self._throttle.let_go()
        if node.attempt is not None:
            self.kick(node)
        self._context.nodes.maybe_forget(node)

    async def _call_off(self, node: Node) -> None:
        async with self._context.paths.steady(node, lasting=True), node.lock:
            if node.unneeded:
                await self._deliverer.abandon(node)
        self._context.nodes.maybe_forget(node)

    async def _retry(self, which: Callable[[Node], bool], pause: float, longest: float) -> None:
        """Try again, ever more seldom, as long as there are such files."""
        nodes, own = self._context.nodes, self._context.own
        try:
            while (which is _may_pass and own.torn) or any(n.undelivered and which(n) for n in nodes):
                await trio.sleep(pause)
                pause = min(2 * pause, longest)
                await self._cleaner.mend_torn()
                await self.deliver_each(lambda node: which(node) and self._is_left_to_us(node))
        finally:
            self._retried.discard(which)

    def _is_left_to_us(self, node: Node) -> bool:
        """Nobody writes it any more, or its name may lack a file."""
        return not node.writers or node.path in self._context.own.torn


def _may_pass(node: Node) -> bool:
    """Return whether what kept a file from being delivered, if anything did, may be over by itself."""
    return node.error is None or isinstance(node.error, PASSING)


def _lacked_room(node: Node) -> bool:
    """Return whether a file is not delivered because it did not fit: others may be removed."""
    return node.error is not None and errno_for(node.error) == errno.ENOSPC
