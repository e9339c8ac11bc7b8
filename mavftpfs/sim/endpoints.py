"""`mavftpfs sim DIR`: serves a simulated vehicle over UDP, TCP, a serial port or a pty. Layer: sim.

The vehicle and the model of the link are pure; this module gives them the clock. Without a model, whole
batches of frames are exchanged. With one, each frame goes through the model by itself.
"""

from __future__ import annotations

import argparse
import os
import random
import shlex
import signal
import sys
import tty
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from io import FileIO
from typing import TextIO

import trio

from mavftpfs.link.base import Link, background
from mavftpfs.link.framing import Framer
from mavftpfs.link.opening import open_link
from mavftpfs.link.stream import Opened, StreamLink
from mavftpfs.link.tcp import open_tcp
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.shared.errors import UsageError
from mavftpfs.sim.arguments import link_settings
from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import DirectoryTree
from mavftpfs.sim.vehicle import AUTOPILOT, SimVehicle

_PTY_OUTBOX = 16 * 1024
_FASTEST = 4_000_000
_SLOWEST = 50
"""Baud rates that every serial driver supports."""
_ANSWER_AT = 16
"""The most replies that wait for others before the endpoint sends all of them."""


class Endpoint:
    """One vehicle on one open link, through a model if one is given."""

    def __init__(self, vehicle: SimVehicle, link: Link, model: LinkModel | None = None) -> None:
        self.vehicle = vehicle
        self.link = link
        self.model = model
        self.cut = False
        self._arrived: list[bytes] = []
        self._splitter = Framer(vehicle.address, stream=link.is_stream, on_frame=self._arrived.append)
        self._scope: trio.CancelScope | None = None
        vehicle.on_news = self.kick
        self._set_room()

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            LinkClosed: somebody closed the link.
        """
        while True:
            with trio.CancelScope(deadline=self._next_deadline()) as self._scope:
                pieces = [data for data, _ in await self.link.receive()]
                if b"" in pieces:
                    self._reset()
            if self._scope.cancelled_caught or self.cut:
                pieces = []
            now = trio.current_time()
            if self.model is None:
                self._exchange(pieces, now)
            else:
                self._exchange_through(self.model, pieces, now)

    def kick(self) -> None:
        """Look at the vehicle again, because it was changed from outside."""
        if self._scope is not None:
            self._scope.cancel()

    def _set_room(self) -> None:
        model, link, buffer = self.model, self.link, self.vehicle.profile.tx_buffer
        if model is not None:
            self.vehicle.server.firmware.tx_room = lambda: model.room(Direction.TO_CLIENT)
        elif link.is_stream:
            self.vehicle.server.firmware.tx_room = lambda: buffer - link.backlog

    def _next_deadline(self) -> float:
        due = self.vehicle.next_deadline()
        model = self.model.next_deadline() if self.model is not None else None
        return due if model is None else min(due, model)

    def _reset(self) -> None:
        self.vehicle.framer.reset()
        self._splitter.reset()

    def _exchange(self, pieces: list[bytes], now: float) -> None:
        for piece in pieces:
            self.vehicle.receive(piece, now)
            if self.vehicle.server.firmware.ready >= _ANSWER_AT:
                self._send(
                    self.vehicle.outgoing(now)
                )  # the client handles these while the next ones are served
        self._send(self.vehicle.outgoing(now))

    def _send(self, frames: list[bytes]) -> None:
        if frames and not self.cut:
            self.link.send(frames)

    def _exchange_through(self, model: LinkModel, pieces: list[bytes], now: float) -> None:
        for piece in pieces:
            self._splitter.feed(piece)
        for frame in self._arrived:
            model.push(Direction.TO_VEHICLE, frame, now)
        self._arrived.clear()
        for frame in model.pop(Direction.TO_VEHICLE, now):
            self.vehicle.receive(frame, now)
        for frame in self.vehicle.outgoing(now):
            model.push(Direction.TO_CLIENT, frame, now)
        for frame in model.pop(Direction.TO_CLIENT, now):
            self._send([frame])  # one by one, because a radio loses single frames


def open_endpoint(text: str, rate: float | None = None) -> AbstractAsyncContextManager[Link]:
    """Return an async context manager that opens the vehicle's end of a link.

    text: a SOURCE from the vehicle's view (`udpout:127.0.0.1:14550` pushes to a ground station, as PX4's
    simulator does), or `pty`. A `tcp:` peer may appear later. rate: bytes/s of the link's model; the baud
    rate of a pty reports it to clients, because programs that share the port pace themselves by that.

    Raises:
        UsageError: at once, if the text is wrong.
    """
    if text == "pty":
        return _open_pty(_FASTEST if rate is None else min(_FASTEST, max(_SLOWEST, round(rate * 10))))
    spec = parse_source(text)
    return open_tcp(spec, patient=True) if spec.kind is LinkKind.TCP_OUT else open_link(spec)


def client_source(link: Link) -> str:
    """Return the SOURCE with which a client reaches an endpoint."""
    spec = parse_source(link.description)
    host = "127.0.0.1" if spec.host == "0.0.0.0" else "::1" if spec.host == "::" else spec.host
    match spec.kind:
        case LinkKind.SERIAL:
            return spec.description
        case LinkKind.UDP_OUT:
            kind = LinkKind.UDP_IN
        case LinkKind.UDP_IN:
            kind = LinkKind.UDP_OUT
        case LinkKind.TCP_IN:
            kind = LinkKind.TCP_OUT
        case LinkKind.TCP_OUT:
            kind = LinkKind.TCP_IN
    return LinkSpec(kind, host=host, port=spec.port).description


@asynccontextmanager
async def _open_pty(baud: int) -> AsyncIterator[Link]:
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        # The slave stays open here, so the master stays readable while clients come and go.
        description = f"{os.ttyname(slave)},{baud}"
        pipe = FileIO(master, "r+")
        link = StreamLink(description, _never, pipe, is_serial=True, outbox_limit=_PTY_OUTBOX)
        async with background(link.run, link.aclose):
            yield link
    finally:
        os.close(slave)


async def _never() -> Opened:
    """Open nothing: the pipe of a pty stays."""
    await trio.sleep_forever()


def run(args: argparse.Namespace) -> int:
    """Serve until one of _ENDING arrives; return the exit code.

    Raises:
        UsageError: DIR or an option is wrong.
        LinkClosed: the link cannot be opened.
    """
    rng = random.Random(args.seed)
    profile = replace(PROFILES[args.profile], longest_reply=args.clamp)
    try:
        tree = DirectoryTree(args.directory)
    except OSError as exc:
        raise UsageError(f"cannot serve {args.directory}: {exc.strerror}{_remedy(args, exc)}") from exc
    storage = os.fsdecode(profile.writable_root.strip(b"/"))
    if not os.path.isdir(os.path.join(args.directory, storage)):
        hint = (
            f"nothing can be written: this server takes files only below /{storage}, and DIR has no {storage}"
        )
        print(f"mavftpfs: {hint}", file=sys.stderr)
    settings = link_settings(args)
    model = None if settings == LinkSettings(queue=settings.queue) else LinkModel(rng, settings)
    vehicle = SimVehicle(
        tree,
        profile,
        rng=rng,
        address=AUTOPILOT._replace(system=args.system),
        telemetry=args.telemetry,
        armed=args.armed,
    )
    trio.run(_serve, args.link, vehicle, model, sys.stdout)
    return 0


def _remedy(args: argparse.Namespace, error: OSError) -> str:
    """Return the command that makes a missing card, with the directory for its logs."""
    if not isinstance(error, FileNotFoundError):
        return ""
    place = os.path.join(args.directory, PROFILES[args.profile].log_place)
    return f"; make a card, and put files into it: mkdir -p {shlex.quote(place)}"


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REACTING = (signal.SIGUSR1, signal.SIGUSR2, signal.SIGPWR)


async def _serve(link_text: str, vehicle: SimVehicle, model: LinkModel | None, out: TextIO) -> None:
    with trio.open_signal_receiver(*_ENDING, *_REACTING) as arriving:
        rate = None if model is None else model.settings.rate
        async with open_endpoint(link_text, rate) as link:
            # The vehicle was built before its link, which decides whether it receives a stream.
            vehicle.set_stream(link.is_stream)
            endpoint = Endpoint(vehicle, link, model)
            system = vehicle.address.system
            target = "" if system == AUTOPILOT.system else f" -o target_system={system}"
            _say(out, f"mavftpfs {client_source(link)} MOUNTPOINT{target}")
            async with trio.open_nursery() as nursery:
                nursery.start_soon(endpoint.run)
                async for number in arriving:
                    if number in _ENDING:
                        break
                    _say(out, _react(number, endpoint))
                nursery.cancel_scope.cancel()
    requests = vehicle.server.requests.total()
    _say(out, f"ended after {requests} FTP requests, open sessions: {vehicle.server.open_sessions}")


def _react(number: int, endpoint: Endpoint) -> str:
    vehicle = endpoint.vehicle
    if number == signal.SIGUSR1:
        (vehicle.disarm if vehicle.armed else vehicle.arm)()
        return "armed" if vehicle.armed else "disarmed"
    if number == signal.SIGUSR2:
        endpoint.cut = not endpoint.cut
        return "link cut" if endpoint.cut else "link mended"
    vehicle.reboot(trio.current_time())
    return "rebooted"


def _say(out: TextIO, line: str) -> None:
    print(line, file=out, flush=True)
