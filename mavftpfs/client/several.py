"""Several vehicles on one link, where SOURCE and the options name none of them. Layer: client.

mavftpfs uses the vehicle whose heartbeat arrives first. That is good enough for reading, if the user learns
of it, but not for a change, because chance decides which vehicle is first. So a command that changes
something listens until each vehicle on the link had time to send a heartbeat, and refuses if there are
several.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import asynccontextmanager
from dataclasses import dataclass

import trio

from mavftpfs.link.base import plain_nursery
from mavftpfs.link.messages import Heartbeat
from mavftpfs.link.peers import names_of, vehicles_in
from mavftpfs.session.connection import HEARD_SOON, Connection
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.options import Options

ON_COMMAND_LINE, IN_PYTHON = "-o target_system=", "target_system="
"""The spellings of the option that names a vehicle."""

_TICK = 0.25
"""Seconds between two checks for another vehicle."""


@dataclass(frozen=True, slots=True)
class Unnamed:
    """The vehicles on a link, of which the user named none.

    place: the link, for people. taken: the system id of the vehicle that is used. heard: returns a heartbeat
    of each component that was heard. listened: returns when each vehicle on the link had time to send a
    heartbeat.
    """

    place: str
    taken: int
    heard: Callable[[], Collection[Heartbeat]]
    listened: Callable[[], Awaitable[None]] = trio.lowlevel.checkpoint

    async def require_one(self, option: str) -> None:
        """Check that the vehicle is the only one on its link.

        Raises:
            UsageError: there are others; the text names all of them, and `option`, which chooses one.
        """
        await self.listened()
        vehicles = vehicles_in(self.heard())
        others = [one for one in vehicles if one.source.system != self.taken]
        if not others:
            return
        systems = sorted({self.taken, *(one.source.system for one in others)})
        raise UsageError(
            f"several vehicles are heard on {self.place}: {names_of(vehicles)}; nothing was changed, because "
            f"none of them was named; choose one with {' or '.join(f'{option}{one}' for one in systems)}"
        )

    def note(self, option: str) -> str:
        """Return a line about the other vehicles that were heard so far, or ""."""
        others = [one for one in vehicles_in(self.heard()) if one.source.system != self.taken]
        if not others:
            return ""
        return (
            f"this is vehicle {self.taken}, which was heard first on {self.place}; also heard: "
            f"{names_of(others)}; to choose one, use {option}{others[0].source.system}"
        )

    @asynccontextmanager
    async def noted(self, tell: Callable[[str], None], option: str) -> AsyncIterator[None]:
        """Print the note as soon as another vehicle is heard, or at the end of the body."""
        told = False

        def look() -> None:
            nonlocal told
            line = "" if told else self.note(option)
            if line:
                told = True
                tell(line)

        async def watch() -> None:
            while not told:
                look()
                await trio.sleep(_TICK)

        try:
            async with plain_nursery() as nursery:
                nursery.start_soon(watch)
                yield
        finally:
            look()


def unnamed_by(connection: Connection, options: Options) -> Unnamed | None:
    """Return the vehicles on the link of a connection, None if the options name one."""
    address = connection.vehicle.address
    if options.target_system or address is None:
        return None

    async def listened() -> None:
        await trio.sleep_until(connection.began_at + HEARD_SOON)

    heard = connection.vehicle.heard
    return Unnamed(connection.link.description, address.system, heard.values, listened)
