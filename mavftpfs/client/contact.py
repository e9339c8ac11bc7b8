"""The watch's way to vehicles and the files of one: over a link, or by a mount. Layer: client."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import trio

from mavftpfs.client.connect import told_version, with_tree
from mavftpfs.client.files import Session, session_of
from mavftpfs.link.messages import Address, Heartbeat
from mavftpfs.link.peers import vehicles_in
from mavftpfs.link.uri import LinkSpec
from mavftpfs.session.connection import Connection
from mavftpfs.session.vehicle import Standing
from mavftpfs.shared.errors import LinkClosed
from mavftpfs.shared.options import Options


class Heard(NamedTuple):
    """A heartbeat of a vehicle. restarted, refused: since the last heartbeat the vehicle restarted, or
    refused to arm."""

    system: int
    armed: bool
    restarted: bool = False
    refused: bool = False


class Contact(Protocol):
    """A way to vehicles, and to the files of one of them."""

    @property
    def system(self) -> int | None:
        """The vehicle whose files are accessible, None before a vehicle was heard."""

    @property
    def replaced(self) -> bool:
        """Whether another vehicle has that system id now, so that the contact is useless."""

    @property
    def uid(self) -> str | None:
        """The unique id of that vehicle, None while unknown."""

    async def listen(self) -> list[Heard]:
        """Return the heartbeats since the last call.

        Raises:
            LinkError: the contact broke.
        """

    async def identity(self) -> str | None:
        """Return the unique id once the vehicle has reported it; None if it never does."""

    def session(self) -> AbstractAsyncContextManager[Session]:
        """Give that vehicle's files for the length of the body.

        Raises:
            LinkError: the contact has ended; another one leads to the files now.
        """


@dataclass(slots=True)
class LinkContact:
    """A connection of the watch's own. When the connection ends, it closes the server's session.

    is_mounted: returns whether a mount has the vehicle now, which would share its only session.
    """

    connection: Connection
    spec: LinkSpec
    options: Options
    is_mounted: Callable[[], Awaitable[bool]] | None = None
    _seen: dict[Address, Heartbeat] = field(default_factory=dict)
    _restarts: int = 0
    _refusals: int = 0

    @property
    def system(self) -> int | None:
        """See Contact."""
        address = self.connection.vehicle.address
        return None if address is None else address.system

    @property
    def replaced(self) -> bool:
        """See Contact."""
        return self.connection.vehicle.identity.standing is Standing.STRANGER

    @property
    def uid(self) -> str | None:
        """See Contact."""
        version = self.connection.vehicle.version
        return None if version is None else version.board

    async def listen(self) -> list[Heard]:
        """See Contact."""
        await trio.lowlevel.checkpoint()
        vehicle, found = self.connection.vehicle, []
        restarted, self._restarts = vehicle.reboots > self._restarts, vehicle.reboots
        refused, self._refusals = vehicle.refusals > self._refusals, vehicle.refusals
        for heartbeat in vehicles_in(vehicle.heard.values()):
            source = heartbeat.source
            own = source.system == self.system
            new = self._seen.get(source) is not heartbeat or (own and (restarted or refused))
            if new and self.options.target_system in (0, source.system):
                self._seen[source] = heartbeat
                found.append(Heard(source.system, heartbeat.armed, own and restarted, own and refused))
        return found

    async def identity(self) -> str | None:
        """See Contact."""
        await told_version(self.connection)
        return self.uid

    @asynccontextmanager
    async def session(self) -> AsyncIterator[Session]:
        """See Contact."""
        if self.is_mounted is not None and await self.is_mounted():
            raise LinkClosed("a mount has this vehicle now: its files are used")
        async with with_tree(self.connection, self.spec, self.options) as vehicle:
            yield session_of(vehicle, self.options)


@dataclass(slots=True)
class MountContact:
    """A mount that is up. The mount closes the server's session itself when no program uses it."""

    files: Session
    system: int | None = None
    uid: str | None = None
    replaced: bool = False
    _restarts: int = 0
    _refusals: int = 0

    async def listen(self) -> list[Heard]:
        """See Contact."""
        status = await self.files.status()
        vehicle, first = status["vehicle"], self.system is None
        system, self.uid = vehicle["system"], vehicle["uid"]
        restarts, refusals = vehicle["restarts"], vehicle["arming_refused"]
        restarted = not first and restarts > self._restarts
        refused = not first and refusals > self._refusals
        self.system, self._restarts, self._refusals = system, restarts, refusals
        if system is None or status["link"]["state"] not in ("fine", "lossy"):
            return []
        return [Heard(system, vehicle["armed"], restarted, refused)]

    async def identity(self) -> str | None:
        """See Contact."""
        await trio.lowlevel.checkpoint()
        return self.uid

    @asynccontextmanager
    async def session(self) -> AsyncIterator[Session]:
        """See Contact."""
        await trio.lowlevel.checkpoint()
        yield self.files
