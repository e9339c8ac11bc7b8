"""Vehicles and other components on a link, found by their heartbeats alone. Layer: client.

A scan and a mount of all vehicles listen in this way. A program with a connection to a vehicle learns of the
others there (`session.vehicle.Vehicle.heard`).
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from math import inf

import trio

from mavftpfs.client.connect import connect_options
from mavftpfs.link.base import Link, plain_nursery
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_TYPE_ONBOARD_CONTROLLER,
    OWN_COMPONENT,
    Address,
    Heartbeat,
)
from mavftpfs.session.connection import HEARTBEAT_PERIOD, nobody, signing_now
from mavftpfs.session.driver import QUIET
from mavftpfs.shared.errors import VehicleLost
from mavftpfs.shared.options import Options


class Listener:
    """Hears heartbeats on a link. Made by `listening`.

    Attributes:
        heard: the last heartbeat of each component.
        first: set when a first heartbeat was received.
    """

    def __init__(self, link: Link, options: Options, on_heard: Callable[[Heartbeat], None]) -> None:
        self.heard: dict[Address, Heartbeat] = {}
        self.first = trio.Event()
        self._link = link
        self._on_heard = on_heard
        own = Address(options.source_system, OWN_COMPONENT) if link.seat is None else link.seat.own
        key = connect_options(options).key
        self._framer = Framer(own, stream=link.is_stream, signing_key=key, signing_clock=signing_now)
        self._framer.link_id = 0 if link.seat is None else link.seat.number

    def nobody(self, timeout: float) -> VehicleLost:
        """Return the error for no heartbeat within `timeout` seconds."""
        return nobody(self._link, timeout, self.heard, self._framer.stats)

    async def run(self) -> None:
        """Listen until cancelled.

        Raises:
            LinkClosed: the link was closed.
        """
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self._beat)
            while True:
                await self._take()

    async def _beat(self) -> None:
        """Send heartbeats, because some bridges answer only a client that speaks."""
        while True:
            beat = self._framer.encode_heartbeat(MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID)
            self._link.send([beat])
            await trio.sleep(HEARTBEAT_PERIOD)

    async def _take(self) -> None:
        """Take the next bytes that arrive, or the frames at the end of a stream that fell silent."""
        messages = []
        with trio.move_on_after(QUIET if self._framer.waiting else inf) as scope:
            for data, _ in await self._link.receive():
                if data:
                    messages += self._framer.feed(data)
                else:
                    self._framer.reset()
        if scope.cancelled_caught:
            messages = self._framer.on_silence()
        for message in messages:
            if isinstance(message, Heartbeat):
                self.heard[message.source] = message
                self.first.set()
                self._on_heard(message)


@asynccontextmanager
async def listening(
    link: Link, options: Options, on_heard: Callable[[Heartbeat], None] = lambda heartbeat: None
) -> AsyncIterator[Listener]:
    """Listen during the body. on_heard: called with each heartbeat."""
    listener = Listener(link, options, on_heard)
    async with plain_nursery() as nursery:
        nursery.start_soon(listener.run)
        yield listener
