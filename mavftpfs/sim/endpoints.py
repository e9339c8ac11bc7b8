"""Serves a simulated vehicle over a real link: UDP, TCP, a serial port or a pty. Layer: sim.

The vehicle and the model of the link are pure; here they meet the clock. Without a model whole batches go in
and out; with one, each frame takes its own way through it.
"""

from __future__ import annotations

import os
import tty
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager

import trio

from mavftpfs.link.base import Link, background
from mavftpfs.link.framing import Framer
from mavftpfs.link.opening import open_link
from mavftpfs.link.stream import Pipe, StreamLink
from mavftpfs.link.tcp import open_tcp
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.sim.linkmodel import Direction, LinkModel
from mavftpfs.sim.vehicle import SimVehicle

_PTY_OUTBOX = 16 * 1024
_ANSWER_AT = 16
"""Replies that wait at most for others before they are sent."""


class Endpoint:
    """One vehicle on one open link, through a model if one is given."""

    def __init__(self, vehicle: SimVehicle, link: Link, model: LinkModel | None = None) -> None:
        self.vehicle = vehicle
        self.link = link
        self.model = model
        self.cut = False
        self._arrived: list[bytes] = []
        self._splitter = Framer(vehicle.address, stream=link.is_stream)
        self._splitter.on_frame = self._arrived.append
        self._scope: trio.CancelScope | None = None
        self._set_room()

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            LinkClosed: somebody closed the link.
        """
        while True:
            with trio.CancelScope(deadline=self._next_deadline()) as self._scope:
                chunks = await self.link.receive()
                if not chunks:
                    self._reset()
            if self._scope.cancelled_caught:
                chunks = []
            now = trio.current_time()
            if self.model is None:
                self._exchange(chunks, now)
            else:
                self._exchange_through(self.model, chunks, now)

    def kick(self) -> None:
        """Look at the vehicle again: it was changed from outside."""
        if self._scope is not None:
            self._scope.cancel()

    def toggle_cut(self) -> bool:
        """Cut the link, or mend it; return whether it is cut now."""
        self.cut = not self.cut
        if self.model is not None:
            now = trio.current_time()
            self.model.cut(now) if self.cut else self.model.restore(now)
        return self.cut

    def toggle_armed(self) -> bool:
        """Arm or disarm the vehicle; return whether it is armed now."""
        if self.vehicle.armed:
            self.vehicle.disarm()
        else:
            self.vehicle.arm()
        self.kick()
        return self.vehicle.armed

    def _set_room(self) -> None:
        model, link, buffer = self.model, self.link, self.vehicle.profile.tx_buffer
        if model is not None:
            self.vehicle.server.tx_room = lambda: model.room(Direction.TO_CLIENT)
        elif link.is_stream:
            self.vehicle.server.tx_room = lambda: buffer - link.backlog

    def _next_deadline(self) -> float:
        due = self.vehicle.next_deadline()
        model = self.model.next_deadline() if self.model is not None else None
        return due if model is None else min(due, model)

    def _reset(self) -> None:
        self.vehicle.framer.reset()
        self._splitter.reset()

    def _exchange(self, chunks: list[bytes], now: float) -> None:
        for chunk in chunks if not self.cut else ():
            self.vehicle.receive(chunk, now)
            if self.vehicle.server.ready >= _ANSWER_AT:  # the client works on it while the next is served
                self._answer(now)
        self._answer(now)

    def _answer(self, now: float) -> None:
        frames = self.vehicle.outgoing(now)
        if frames and not self.cut:
            self.link.send_nowait(frames)

    def _exchange_through(self, model: LinkModel, chunks: list[bytes], now: float) -> None:
        for chunk in chunks:
            self._splitter.feed(chunk)
        for frame in self._arrived:
            model.push(Direction.TO_VEHICLE, frame, now)
        self._arrived.clear()
        for frame in model.pop(Direction.TO_VEHICLE, now):
            self.vehicle.receive(frame, now)
        for frame in self.vehicle.outgoing(now):
            model.push(Direction.TO_CLIENT, frame, now)
        for frame in model.pop(Direction.TO_CLIENT, now):
            self.link.send_nowait([frame])  # one each: a radio's frames are lost one by one


def open_endpoint(text: str) -> AbstractAsyncContextManager[Link]:
    """Return an async context manager that opens the vehicle's end of a link.

    text: a SOURCE as the vehicle would write it (`udpout:127.0.0.1:14550` pushes to a ground station, as
    PX4's simulator does), or `pty`. A `tcp:` peer may come later.

    Raises:
        UsageError: at once, if the text cannot be understood.
    """
    if text == "pty":
        return _open_pty()
    spec = parse_source(text)
    return open_tcp(spec, patient=True) if spec.kind is LinkKind.TCP_OUT else open_link(spec)


def client_source(link: Link) -> str:
    """Return the SOURCE with which a client reaches an endpoint."""
    spec = parse_source(link.description)
    host = "127.0.0.1" if spec.host == "0.0.0.0" else "::1" if spec.host == "::" else spec.host
    match spec.kind:
        case LinkKind.SERIAL:
            return spec.device
        case LinkKind.UDP_OUT:
            kind = LinkKind.UDP_IN
        case LinkKind.UDP_IN:
            kind = LinkKind.UDP_OUT
        case LinkKind.TCP_IN:
            kind = LinkKind.TCP_OUT
        case LinkKind.TCP_OUT:
            kind = LinkKind.TCP_IN
    return LinkSpec(kind, host=host, port=spec.port).description


class _Descriptor:
    """A bare file descriptor as a Pipe."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


@asynccontextmanager
async def _open_pty() -> AsyncIterator[Link]:
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        # Our own hold on the slave keeps the master readable while clients come and go.
        description = os.ttyname(slave)
        link = StreamLink(description, _never, _Descriptor(master), is_serial=True, outbox_limit=_PTY_OUTBOX)
        async with background(link.run_writer, link.aclose):
            yield link
    finally:
        os.close(slave)


async def _never() -> Pipe:
    raise OSError("a pty has one end")
