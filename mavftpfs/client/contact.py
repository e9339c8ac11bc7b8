"""Ways to vehicles that come and go: which ones are heard, and the files of one of them. Layer: client."""

from __future__ import annotations

from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import Protocol

import trio

from mavftpfs.client.connect import told_version, with_tree
from mavftpfs.client.files import Session, session_of
from mavftpfs.client.options import Options
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_COMP_ID_AUTOPILOT1, Address, Heartbeat
from mavftpfs.link.uri import LinkSpec
from mavftpfs.session.connection import Connection
from mavftpfs.session.vehicle import Standing
from mavftpfs.shared.errors import LinkError

TICK = 1.0
"""Seconds between two looks at what was heard. Arming of the vehicle whose files we have is told at once."""
MOUNT_TICK = 0.25
"""Seconds between two questions to a mount: it is to be left within a second of arming."""


class Hearing(Protocol):
    """Is told what is heard; a vehicle is a system id."""

    def heard(self, system: int, *, armed: bool) -> None:
        """A heartbeat came."""

    def refused(self, system: int) -> None:
        """It refused to be armed."""

    def restarted(self, system: int) -> None:
        """It restarted."""

    def replaced(self, system: int) -> None:
        """Another vehicle has its system id now; the contact is of no use any more."""

    def ended(self, error: LinkError) -> None:
        """The contact is of no use any more."""

    def time_passed(self) -> None:
        """Called at intervals, whatever is heard."""


class Contact(Protocol):
    """A way to vehicles."""

    @property
    def system(self) -> int | None:
        """The vehicle whose files can be had, None before one was heard."""

    async def listen(self, hearing: Hearing) -> None:
        """Call `hearing` for all that is heard, until cancelled."""

    async def identity(self) -> str | None:
        """Return the unique id of the vehicle whose files can be had, None if it does not tell it."""

    async def enter(self, stack: AsyncExitStack) -> Session:
        """Return that vehicle's files; they can be had until the stack is left."""


@dataclass(slots=True)
class LinkContact:
    """A connection of our own. Leaving it closes the server's session."""

    connection: Connection
    spec: LinkSpec
    options: Options
    _seen: dict[Address, Heartbeat] = field(default_factory=dict)

    @property
    def system(self) -> int | None:
        """See Contact."""
        address = self.connection.vehicle.address
        return None if address is None else address.system

    async def listen(self, hearing: Hearing) -> None:
        """See Contact."""
        self.connection.subscribe(lambda news: self._on_news(news, hearing))
        while True:
            if self.system is not None and self._replaced:
                hearing.replaced(self.system)
            else:
                self._look(hearing)
            hearing.time_passed()
            await trio.sleep(TICK)

    @property
    def _replaced(self) -> bool:
        return self.connection.vehicle.identity.standing is Standing.STRANGER

    def _on_news(self, news: str, hearing: Hearing) -> None:
        self._look(hearing)
        if self.system is not None and news == "arming refused":
            hearing.refused(self.system)
        if self.system is not None and news == "reboot":
            hearing.restarted(self.system)

    def _look(self, hearing: Hearing) -> None:
        heard = self.connection.vehicle.heard
        for address, heartbeat in heard.items():
            if self._seen.get(address) is heartbeat or not self._is_wanted(heartbeat):
                continue
            self._seen[address] = heartbeat
            main = Address(address.system, MAV_COMP_ID_AUTOPILOT1)
            if address == main or main not in heard:
                hearing.heard(address.system, armed=heartbeat.armed)

    def _is_wanted(self, heartbeat: Heartbeat) -> bool:
        wanted = self.options.target_system in (0, heartbeat.source.system)
        return wanted and heartbeat.autopilot != MAV_AUTOPILOT_INVALID

    async def identity(self) -> str | None:
        """See Contact."""
        version = await told_version(self.connection)
        return None if version is None else version.board

    async def enter(self, stack: AsyncExitStack) -> Session:
        """See Contact."""
        vehicle = await stack.enter_async_context(with_tree(self.connection, self.spec, self.options))
        return session_of(vehicle, self.options)


@dataclass(slots=True)
class MountContact:
    """A mount that is up. It closes the server's session itself when it is not used."""

    session: Session
    system: int | None = None
    _uid: str | None = None
    _restarts: int = 0
    _refusals: int = 0

    async def listen(self, hearing: Hearing) -> None:
        """See Contact."""
        try:
            while True:
                status = await self.session.status()
                vehicle = status["vehicle"]
                if self.system is not None and vehicle["restarts"] > self._restarts:
                    hearing.restarted(self.system)
                if self.system is not None and vehicle.get("arming_refused", 0) > self._refusals:
                    hearing.refused(self.system)
                self.system, self._uid = vehicle["system"], vehicle["uid"]
                self._restarts = vehicle["restarts"]
                self._refusals = vehicle.get("arming_refused", 0)  # an older mount does not tell it
                if self.system is not None and status["link"]["state"] in ("fine", "lossy"):
                    hearing.heard(self.system, armed=vehicle["armed"])
                hearing.time_passed()
                await trio.sleep(MOUNT_TICK)
        except LinkError as exc:
            hearing.ended(exc)

    async def identity(self) -> str | None:
        """See Contact."""
        await trio.lowlevel.checkpoint()
        return self._uid

    async def enter(self, stack: AsyncExitStack) -> Session:
        """See Contact."""
        await trio.lowlevel.checkpoint()
        return self.session
