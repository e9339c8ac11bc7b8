"""Delivers while nobody waits for it. Layer: cache.

What a close could not deliver is tried again, ever more seldom, until the vehicle has it or refuses it: a
link that fails and returns between two looks at its heartbeats is no news to anybody. Nor is room on a card
that was full: it is asked again after minutes, and then hours.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable
from functools import partial

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer, may_pass
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.repair import Cleaner
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.cache")

PAUSES = (2.0, 30.0)
"""Seconds between two attempts to deliver what nobody has open: at first, and at most."""

ROOM_PAUSES = (120.0, 3600.0)
"""The same for what the card had no room for: most of a file may travel before that shows again."""


class Background:
    """Needs the context's nursery; without one nothing is delivered before it is asked for."""

    def __init__(self, context: Context, deliverer: Deliverer, cleaner: Cleaner) -> None:
        self._context = context
        self._deliverer = deliverer
        self._cleaner = cleaner
        self._retried: set[Callable[[Node], bool]] = set()
        context.retry_later = self.redeliver

    async def link_back(self) -> None:
        """What failed, or was refused, may work now."""
        await self._cleaner.mend_torn()
        for node in self._context.nodes:
            node.start_after = float("-inf")
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
        for which, pauses in ((may_pass, PAUSES), (_lacked_room, ROOM_PAUSES)):
            if nursery is not None and which not in self._retried:
                self._retried.add(which)
                nursery.start_soon(self._retry, which, *pauses)

    # --- inside

    async def _retry(self, which: Callable[[Node], bool], pause: float, longest: float) -> None:
        """Try again, ever more seldom, as long as there are such files."""
        nodes, own = self._context.nodes, self._context.own
        try:
            while (which is may_pass and own.torn) or any(n.undelivered and which(n) for n in nodes):
                await trio.sleep(pause)
                pause = min(2 * pause, longest)
                await self._cleaner.mend_torn()
                await self.deliver_each(lambda node: which(node) and self._is_left_to_us(node))
        finally:
            self._retried.discard(which)

    def _is_left_to_us(self, node: Node) -> bool:
        """Nobody writes it any more, or its name may lack a file."""
        return not node.writers or node.path in self._context.own.torn


def _lacked_room(node: Node) -> bool:
    """Return whether a file is not delivered because it did not fit: others may be removed."""
    return node.error is not None and errno_for(node.error) == errno.ENOSPC
