"""Tells the kernel that what it cached is old. Layer: mount."""

from __future__ import annotations

import errno
import logging
import math
from collections.abc import Callable, Sequence
from functools import partial

import pyfuse3
import trio

from mavftpfs.mount.handles import InodeTable
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.mount")

MAX_DROPS = 16
"""The most files whose pages the kernel drops at once; each takes a thread."""


class Invalidator:
    """Tells the kernel to drop cached data, by its calls `notify(ino, attr_only)` and `notify_name(parent
    ino, name)`.

    The calls run in a worker thread, because in them the kernel waits for reads and look-ups in progress,
    which the event loop must answer.
    """

    def __init__(
        self,
        inodes: InodeTable,
        notify: Callable[[int, bool], None] = pyfuse3.invalidate_inode,
        notify_name: Callable[[int, bytes], None] = pyfuse3.invalidate_entry,
    ) -> None:
        self._inodes = inodes
        self._notify = notify
        self._notify_name = notify_name
        self._pending: set[int] = set()
        self._wake = trio.Event()
        self._calls: set[object] = set()
        self._ended = False
        self._drops = trio.CapacityLimiter(MAX_DROPS)
        # Without a limit: a call that queued and was cancelled would count as running.
        self._limiter = trio.CapacityLimiter(math.inf)

    @property
    def busy(self) -> bool:
        """Whether a thread is inside the kernel's call at this moment."""
        return bool(self._calls)

    def end(self) -> None:
        """Make no further calls, because the kernel's mount is about to end while commands still close their
        files."""
        self._ended = True

    def on_changed(self, path: bytes) -> None:
        """Make the kernel drop its pages and attributes of a path, because its bytes changed."""
        ino = self._inodes.known(path)
        if ino is not None:
            self._pending.add(ino)
            self._wake.set()

    async def run(self) -> None:
        """Work until cancelled."""
        async with trio.open_nursery() as nursery:
            while True:
                await self._wake.wait()
                self._wake = trio.Event()
                pending, self._pending = self._pending, set()
                for ino in pending:
                    nursery.start_soon(self._drop, ino)

    async def _drop(self, ino: int) -> None:
        """Make the kernel drop a file's pages and attributes. Other files do not wait for this, because one
        of the pages may be in a read from a lost vehicle."""
        async with self._drops:
            await self._tell(ino, attr_only=False)

    async def forget_pages(self, path: bytes) -> None:
        """Make the kernel drop its pages and attributes of a path; return when it has dropped them."""
        ino = self._inodes.known(path)
        if ino is not None:
            await self._tell(ino, attr_only=False)

    async def forget_attributes(self, ino: int) -> None:
        """Make the kernel ask for attributes again; return when it has forgotten them."""
        await self._tell(ino, attr_only=True)

    async def forget_name(self, *paths: bytes) -> None:
        """Make the kernel look names up again; return when it has forgotten them."""
        known = [(self._inodes.known(split(path)[0]), split(path)[1]) for path in paths]
        await self._in_thread(
            [partial(self._notify_name, parent, name) for parent, name in known if parent is not None]
        )

    async def forget_file(self, path: bytes) -> None:
        """Make the kernel drop everything about a path, its name too; return when it has done so."""
        await self.forget_pages(path)
        await self.forget_name(path)

    async def _tell(self, ino: int, *, attr_only: bool) -> None:
        await self._in_thread([partial(self._notify, ino, attr_only)])

    async def _in_thread(self, calls: Sequence[Callable[[], None]]) -> None:
        await trio.lowlevel.checkpoint_if_cancelled()
        if self._ended:
            return
        running = object()
        self._calls.add(running)
        action = partial(self._call, running, calls)
        await trio.to_thread.run_sync(action, abandon_on_cancel=True, limiter=self._limiter)

    def _call(self, running: object, calls: Sequence[Callable[[], None]]) -> None:
        try:
            for call in calls:
                try:
                    call()
                except OSError as exc:
                    if exc.errno != errno.ENOENT:  # the kernel forgot it by itself
                        log.warning("the kernel refused to drop what it cached: %s", exc)
        finally:
            self._calls.discard(running)
