"""How a verb gets at the vehicle: by a mount that is up, or by a connection of its own. Layer: top."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import cast

import trio

from mavftpfs.compose import NO_SINKS, Attached, Sinks, attached, no_answer
from mavftpfs.fuse.options import MountOptions
from mavftpfs.link.uri import LinkSpec
from mavftpfs.oneshot.files import Session, Transfers
from mavftpfs.oneshot.mounted import find_mount, open_mount
from mavftpfs.session.vehicle import SILENCE_LIMIT

_TICK = 0.2


@dataclass(frozen=True, slots=True)
class Target:
    """Which vehicle, and how to talk to it. mount: (mountpoint, subtree) if SOURCE was a mountpoint."""

    spec: LinkSpec | None
    options: MountOptions
    sinks: Sinks = NO_SINKS
    mount: tuple[str, bytes] | None = None

    async def mounted(self) -> Session | None:
        """Return the files of the mount that is to be used, None where there is none."""
        if self.mount is not None:
            return await open_mount(*self.mount)
        assert self.spec is not None
        return await find_mount(self.spec, self.options)

    @asynccontextmanager
    async def session(self, *, writing: bool = False) -> AsyncIterator[Session]:
        """Give the vehicle's files for the length of the body.

        Raises:
            LinkClosed, VehicleLost, NoFtp: nobody answers within connect_timeout, with the reason.
        """
        mounted = await self.mounted()
        if mounted is not None:
            yield mounted
            return
        assert self.spec is not None
        deadline = trio.current_time() + self.options.connect_timeout
        # What the verb asks for first takes the place of the first listing that a mount makes.
        up = attached(self.spec, self.options, sinks=self.sinks, list_root=False, writing=writing)
        async with up as vehicle, _answered_by(deadline, vehicle, self.options):
            yield _session_of(vehicle, self.options)


def _session_of(vehicle: Attached, options: MountOptions) -> Session:
    async def transfers() -> Transfers:
        return cast(Sequence[dict[str, object]], vehicle.tree.status().get("transfers", []))

    def silent() -> bool:
        connection = vehicle.connection
        return connection.vehicle.silence(connection.clock()) > SILENCE_LIMIT

    async def returned() -> bool:
        for _ in range(round(options.connect_timeout / _TICK)):
            if not silent():
                return True
            await trio.sleep(_TICK)
        return not silent()

    return Session(vehicle.tree, options.root, transfers, silent=silent, returned=returned)


@asynccontextmanager
async def _answered_by(deadline: float, vehicle: Attached, options: MountOptions) -> AsyncIterator[None]:
    """End the body when no FTP request was answered by the deadline.

    Raises:
        NoFtp: as a mount says it.
    """
    connection = vehicle.connection
    over = trio.CancelScope()

    async def watch() -> None:
        await trio.sleep_until(deadline)
        if connection.engine.stats.replies == 0:
            over.cancel()

    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        nursery.start_soon(watch)
        with over:
            try:
                yield
            except Exception as error:  # raised again outside of the nursery, which would wrap it in a group
                failure = error
        nursery.cancel_scope.cancel()
    if over.cancelled_caught:
        raise no_answer(connection, options)
    if failure is not None:
        raise failure
