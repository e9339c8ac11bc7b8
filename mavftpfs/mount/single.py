"""The mount of one vehicle: composition root. Layer: mount.

Order matters. The kernel mount appears only after the vehicle has answered. At the end the kernel mount goes
first; then pending changes are uploaded, or saved; then the server's session is closed.
"""

from __future__ import annotations

import gc
import os
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from functools import partial
from typing import Any

import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.client.connect import Attached, attached
from mavftpfs.client.mountpoint import is_dead, timeout_note, unmount
from mavftpfs.client.mounts import mounts_on
from mavftpfs.client.undelivered import recovered_directory
from mavftpfs.mount.daemon import Report
from mavftpfs.mount.drain import drain_or_keep
from mavftpfs.mount.fileserver import FileServer, Served
from mavftpfs.mount.handles import InodeTable
from mavftpfs.mount.invalidator import Invalidator
from mavftpfs.mount.kernel import FuseLoop, kernel_mount, presentation
from mavftpfs.mount.life import Life, MountRequest, State
from mavftpfs.mount.operations import Operations
from mavftpfs.mount.options import fuse_words
from mavftpfs.shared.errors import ExitCode, LinkClosed, MountFailed

ASKING_TIME = 2.0
"""Seconds for other mounts to report their vehicle."""

Attach = Callable[[Callable[[bytes], None]], AbstractAsyncContextManager[Attached]]
"""Connects to the vehicle. Its argument is called for paths whose bytes changed."""


def run_mount(request: MountRequest, report: Report) -> int:
    """Mount and serve until unmounted; return the exit code."""

    def attach(invalidate: Callable[[bytes], None]) -> AbstractAsyncContextManager[Attached]:
        return attached(
            request.spec,
            request.options,
            invalidate=invalidate,
            sinks=request.sinks,
            writing=True,
            rescue_for=request.source,
        )

    return trio.run(SingleMount(request, attach, report).run)


class SingleMount(Life):
    """The mount of one vehicle."""

    def __init__(self, request: MountRequest, attach: Attach, report: Report) -> None:
        super().__init__(request, report)
        self._attach = attach
        self._loop = FuseLoop()
        self._status: Callable[[], Mapping[str, Any]] = dict
        self._attached: Attached | None = None
        self._files: FileServer | None = None

    async def serve(self, nursery: trio.Nursery) -> None:
        """See Life.serve."""
        inodes = InodeTable()
        invalidator = Invalidator(inodes)
        async with self._attach(invalidator.on_changed) as vehicle, self._drained(vehicle.tree):
            self._attached = vehicle
            nursery.start_soon(vehicle.watcher.run)
            operations = Operations(
                vehicle.tree,
                presentation(self.request.options),
                inodes=inodes,
                refresh=invalidator.forget_attributes,
                space=vehicle.space,
                told=self.identity,
            )
            self._status = lambda: {**vehicle.status(), "kernel": operations.counts()}
            self._files = FileServer(Served(vehicle.tree, operations, invalidator, self.facts))
            words = fuse_words(self.request.options, self.request.source)
            others = await self._others(vehicle)
            if is_dead(self.request.mountpoint):  # below a mount of all vehicles: programs got ENOTCONN
                unmount(self.request.mountpoint, lazy=True)
            with kernel_mount(operations, self.request.mountpoint, words, busy=lambda: invalidator.busy):
                try:
                    self.enter(State.MOUNTED)
                    await self.start_control(nursery, self._files)
                    await self._answer(
                        invalidator, lambda: _together(vehicle.notice(), timeout_note(), others)
                    )
                finally:
                    invalidator.end()

    async def _others(self, vehicle: Attached) -> str:
        """Return a note that names the user's other mounts of this vehicle, or ""."""
        own = vehicle.status()["vehicle"]
        places = []
        with trio.move_on_after(ASKING_TIME), suppress(LinkClosed):  # a mount may have been stopped
            for status in await trio.to_thread.run_sync(mounts_on, self.request.spec, abandon_on_cancel=True):
                theirs = status.get("vehicle", {})
                if all(theirs.get(key) == own[key] for key in ("system", "component")):
                    places.append(status["mountpoint"])
        if not places:
            return ""
        return (
            f"this vehicle is mounted on {' and '.join(places)}, too; a change through one mount may show in "
            f"the other one 20 s later; to have only one, run: mavftpfs umount {places[0]}"
        )

    @asynccontextmanager
    async def _drained(self, tree: Tree) -> AsyncIterator[None]:
        """Upload the changes of the body, or save them, once the kernel mount is gone."""
        try:
            yield
        finally:
            try:
                if self._files is not None:
                    await self._files.close()
            finally:
                if self.state is not State.STARTING:
                    await drain_or_keep(
                        tree, self.request.source, partial(self.note_end, ExitCode.UNDELIVERED)
                    )

    async def _answer(self, invalidator: Invalidator, notice: Callable[[], str]) -> None:
        async with trio.open_nursery() as nursery:
            nursery.start_soon(invalidator.run)
            gc.collect()
            gc.freeze()  # otherwise a full collection would go through all imported modules during a transfer
            # Move old files only now, because after a failed mount nobody would read where they are.
            self.tell_mounted(notice())
            await self._loop.run()
            self.leave()
            nursery.cancel_scope.cancel()

    async def unmount(self, *, lazy: bool) -> None:
        """See Life.unmount."""
        if self.state is State.MOUNTED:
            users = [] if self._files is None or lazy else self._files.users
            if users:
                raise MountFailed(
                    f"{self.request.mountpoint} is in use by process {' and '.join(map(str, users))}; "
                    "let it end, and try again"
                )
            action = partial(unmount, self.request.mountpoint, lazy=lazy)
            await trio.to_thread.run_sync(action, abandon_on_cancel=True)
            self.leave()

    def leave(self) -> None:
        """See Life.leave."""
        if self.state is State.MOUNTED:
            self.enter(State.LEAVING)
            self._loop.stop()

    def hurry(self) -> None:
        """See Life.hurry."""
        if self._attached is not None:
            self._attached.connection.store.hurry()
        if self._files is not None:
            self._files.hurry()
        self.stop()

    def identity(self) -> dict[str, Any]:
        """See Life.identity; with the vehicle."""
        vehicle = self._status().get("vehicle", {})
        return {
            **super().identity(),
            "vehicle": {name: vehicle.get(name) for name in ("system", "component")},
        }

    def status(self) -> Mapping[str, Any]:
        """See Life.status."""
        client = self.request.options
        return {
            "root": os.fsdecode(client.root),
            "read_only": client.read_only,
            "recovered": str(recovered_directory()),
            **self._status(),
        }


def _together(*lines: str) -> str:
    """Return several notes as one line."""
    return "; ".join(filter(None, lines))
