"""When a draft may be changed: not while it is delivered, not much faster than the link is. Layer: cache."""

from __future__ import annotations

from functools import partial

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared.errors import FileBusy


class Admission:
    """Lets programs write. Who called may change the draft until its next wait."""

    def __init__(self, context: Context, deliverer: Deliverer, throttle: Throttle) -> None:
        self._context = context
        self._deliverer = deliverer
        self._throttle = throttle

    async def may_write(self, node: Node) -> None:
        """Wait until a delivery under way is over and not too much is un-ACKed.

        Raises:
            Armed. Else as Deliverer.deliver, when too much is un-ACKed.
        """
        idle_since = self._context.clock()
        while True:
            self._context.require_disarmed()
            node.end_rest()
            await node.quiet.wait()
            if not node.quiet.is_set():
                continue  # the next delivery began while we woke up
            if not self._throttle.is_full(node):
                return
            if await self._throttle.wait():
                idle_since = self._context.clock()
                continue
            if node.starting and self._context.clock() - idle_since < self._context.options.op_deadline:
                continue  # an upload is about to begin: to wait for all of it would stop the program
            # It says what is wrong, if anything is.
            await self._deliverer.deliver(node, wanted=partial(self._throttle.is_full, node))
            idle_since = self._context.clock()

    async def may_empty(self, node: Node) -> None:
        """Call off what brings bytes to the vehicle that nobody wants any more: no room is needed, either.

        Raises:
            Armed. FileBusy: it is at a step that is not called off, and that lasts.
        """
        with trio.move_on_after(self._context.options.op_deadline):
            await node.call_off()
            self._context.require_disarmed()
            self._throttle.let_go()
            return
        raise FileBusy(f"{node.path!r} is just getting its place")
