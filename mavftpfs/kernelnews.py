"""Tells the kernel that what it cached of a file is old. Layer: top.

The call runs in a worker thread: the kernel waits in it for pages that are being read, and those reads
are answered by the event loop.
"""

from __future__ import annotations

import errno
import logging
import math
from collections.abc import Callable
from functools import partial

import trio

from mavftpfs.fuse.inodes import InodeTable

log = logging.getLogger("mavftpfs.fuse")


class Invalidator:
    """Invalidates inodes one after the other; `notify(ino, attr_only)` is the kernel's call."""

    def __init__(self, inodes: InodeTable, notify: Callable[[int, bool], None]) -> None:
        self._inodes = inodes
        self._notify = notify
        self._pending: set[int] = set()
        self._wake = trio.Event()
        self._calls: set[object] = set()
        # Without a limit: a call that queued and was cancelled would count as running.
        self._limiter = trio.CapacityLimiter(math.inf)

    @property
    def busy(self) -> bool:
        """Whether a thread is inside the kernel's call at this moment."""
        return bool(self._calls)

    def on_changed(self, path: bytes) -> None:
        """The bytes at `path` are others now: have the kernel drop its pages and attributes."""
        ino = self._inodes.known(path)
        if ino is not None:
            self._pending.add(ino)
            self._wake.set()

    async def run(self) -> None:
        """Work until cancelled."""
        while True:
            await self._wake.wait()
            self._wake = trio.Event()
            pending, self._pending = self._pending, set()
            for ino in pending:
                await self._tell(ino, attr_only=False)

    async def forget_attributes(self, ino: int) -> None:
        """Have the kernel ask for attributes again; back when it has forgotten them."""
        await self._tell(ino, attr_only=True)

    async def _tell(self, ino: int, *, attr_only: bool) -> None:
        await trio.lowlevel.checkpoint_if_cancelled()
        call = object()
        self._calls.add(call)
        action = partial(self._in_thread, call, ino, attr_only)
        await trio.to_thread.run_sync(action, abandon_on_cancel=True, limiter=self._limiter)

    def _in_thread(self, call: object, ino: int, attr_only: bool) -> None:
        try:
            self._notify(ino, attr_only)
        except OSError as exc:
            if exc.errno != errno.ENOENT:  # the kernel forgot it by itself
                log.warning("the kernel refused to drop its cache of inode %d: %s", ino, exc)
        finally:
            self._calls.discard(call)
