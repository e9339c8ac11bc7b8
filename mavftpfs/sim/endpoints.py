"""`mavftpfs sim DIR`: serves a simulated vehicle over UDP, TCP, a serial port or a pty. Layer: sim.

The vehicle and the model of the link are pure; here they get the clock. Without a model, whole batches go in
and out. With one, each frame goes through the model by itself.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from io import FileIO
from typing import TextIO

import trio

from mavftpfs.link.base import Link, background
from mavftpfs.link.framing import Framer
from mavftpfs.link.opening import open_link
from mavftpfs.link.stream import StreamLink
from mavftpfs.link.tcp import open_tcp
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.shared.errors import UsageError
from mavftpfs.sim.linkmodel import Direction, Duplex, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import DirectoryTree
from mavftpfs.sim.vehicle import AUTOPILOT, SimVehicle

_PTY_OUTBOX = 16 * 1024
_ANSWER_AT = 16
"""So many replies at most wait for others before all are sent."""


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
        self._set_room()

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            LinkClosed: somebody closed the link.
        """
        while True:
            with trio.CancelScope(deadline=self._next_deadline()) as self._scope:
                pieces = await self.link.receive()
                if not pieces:
                    self._reset()
                self.link.keep_peer()
            if self._scope.cancelled_caught or self.cut:
                pieces = []
            now = trio.current_time()
            if self.model is None:
                self._exchange(pieces, now)
            else:
                self._exchange_through(self.model, pieces, now)

    def kick(self) -> None:
        """Look at the vehicle again: it was changed from outside."""
        if self._scope is not None:
            self._scope.cancel()

    def toggle_cut(self) -> bool:
        """Cut the link, or mend it; return whether it is cut now."""
        self.cut = not self.cut
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
                self._send(self.vehicle.outgoing(now))  # the client works on it while the next is served
        self._send(self.vehicle.outgoing(now))

    def _send(self, frames: list[bytes]) -> None:
        if frames and not self.cut:
            self.link.send_nowait(frames)

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
            self._send([frame])  # one each: a radio's frames are lost one by one


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


@asynccontextmanager
async def _open_pty() -> AsyncIterator[Link]:
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        # The slave stays open here, so the master stays readable while clients come and go.
        description = os.ttyname(slave)
        pipe = FileIO(master, "r+")
        link = StreamLink(description, None, pipe, is_serial=True, outbox_limit=_PTY_OUTBOX)
        async with background(link.run, link.aclose):
            yield link
    finally:
        os.close(slave)


DEFAULT_LINK = "udpout:127.0.0.1:14550"
DEFAULT_QUEUE = 8192

EPILOG = """\
The link is given as the vehicle sees it: udpout:127.0.0.1:14550 pushes to a ground station on this computer,
as PX4's simulator does; udpin:0.0.0.0:14550 waits to be spoken to; tcpin:127.0.0.1:5760 is what ArduPilot's
simulator does; pty makes a serial port and prints its name. With any of --rate, --mtu, --delay, --jitter,
--loss, --burst-loss, --dup, --corrupt or --reorder, frames go through the model of a bad link.

Signals: SIGUSR1 arms or disarms (kill -USR1 PID), SIGUSR2 cuts or mends the link, SIGPWR reboots. It ends by
SIGINT (Ctrl-C), by SIGTERM, and with its terminal.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `mavftpfs sim`."""
    parser.description = "Serve a directory as a simulated vehicle would."
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("directory", metavar="DIR", help="what the vehicle's card holds")
    parser.add_argument(
        "--profile", default="px4", choices=sorted(PROFILES), help="whose FTP server (default px4)"
    )
    parser.add_argument("--link", default=DEFAULT_LINK, metavar="URL", help=f"default {DEFAULT_LINK}")
    parser.add_argument(
        "--system", type=_system, default=AUTOPILOT.system, metavar="ID", help="its system id (default 1)"
    )
    parser.add_argument(
        "--no-storage",
        dest="tells_storage",
        action="store_const",
        const=False,
        help="do not tell the size of the card (default: as the profile does)",
    )
    parser.add_argument("--armed", action="store_true", help="be armed from the start")
    parser.add_argument(
        "--telemetry", type=_rate, default=0.0, metavar="B/s", help="other messages (default none)"
    )
    _add_model_arguments(parser.add_argument_group("the link"))


def run(args: argparse.Namespace) -> int:
    """Serve until one of _ENDING comes; returns the exit code.

    Raises:
        UsageError: DIR or an option is wrong.
        LinkClosed: the link cannot be opened.
    """
    rng = random.Random(args.seed)
    try:
        tree = DirectoryTree(args.directory)
    except OSError as exc:
        raise UsageError(f"cannot serve {args.directory}: {exc.strerror}") from exc
    profile = PROFILES[args.profile]
    storage = os.fsdecode(profile.writable_root.strip(b"/"))
    if not os.path.isdir(os.path.join(args.directory, storage)):
        hint = (
            f"nothing can be written: this server takes files below /{storage} only, and DIR has no {storage}"
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
        tells_storage=args.tells_storage,
    )
    trio.run(_serve, args.link, vehicle, model, sys.stdout)
    return 0


def link_settings(args: argparse.Namespace) -> LinkSettings:
    """Return the model's settings. A link without any flaw needs no model."""
    return LinkSettings(
        rate=args.rate,
        queue=int(args.queue),
        mtu=None if args.mtu is None else int(args.mtu),
        duplex=Duplex(args.duplex),
        delay=args.delay,
        jitter=args.jitter,
        loss=args.loss,
        burst_loss=args.burst_loss,
        duplicate=args.dup,
        reorder=args.reorder,
        corrupt=args.corrupt,
    )


def _add_model_arguments(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--rate", type=_positive, metavar="B/s", help="each way; without it, no limit")
    group.add_argument(
        "--queue",
        type=_bytes,
        default=DEFAULT_QUEUE,
        metavar="B",
        help=f"bytes that wait for the transmitter (default {DEFAULT_QUEUE})",
    )
    group.add_argument("--mtu", type=_bytes, metavar="B", help="longer frames are lost; without it, none")
    group.add_argument(
        "--duplex", choices=[d.value for d in Duplex], default="full", help="half: directions share the rate"
    )
    group.add_argument("--delay", type=_seconds, default=0.0, metavar="S", help="one way, in seconds")
    group.add_argument("--jitter", type=_seconds, default=0.0, metavar="S", help="on top, at random")
    for name, text in (
        ("--loss", "share of frames lost"),
        ("--burst-loss", "share of frames lost in runs of about 8"),
        ("--dup", "share of frames doubled"),
        ("--corrupt", "share of frames damaged"),
        ("--reorder", "share of frames held back"),
    ):
        group.add_argument(name, type=_share, default=0.0, metavar="P", help=f"{text}, 0 to 1")
    group.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default 0)")


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REACTING = (signal.SIGUSR1, signal.SIGUSR2, signal.SIGPWR)


async def _serve(link_text: str, vehicle: SimVehicle, model: LinkModel | None, out: TextIO) -> None:
    with trio.open_signal_receiver(*_ENDING, *_REACTING) as arriving:
        async with open_endpoint(link_text) as link:
            # The vehicle was built before its link. Whether it hears a stream is clear only now.
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
    if number == signal.SIGUSR1:
        return "armed" if endpoint.toggle_armed() else "disarmed"
    if number == signal.SIGUSR2:
        return "link cut" if endpoint.toggle_cut() else "link mended"
    endpoint.vehicle.reboot(trio.current_time())
    endpoint.kick()
    return "rebooted"


def _say(out: TextIO, line: str) -> None:
    print(line, file=out, flush=True)


def _between(low: float, high: float, what: str) -> Callable[[str], float]:
    """Return a parser of numbers within [low, high]."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no {what}")
        return value

    return parse


def _system(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 255:
        raise argparse.ArgumentTypeError(f"{text!r} is no system id (1 to 255)")
    return int(text)


_rate = _between(0, 1e12, "rate in bytes per second")
_positive = _between(1, 1e12, "rate in bytes per second (1 or more)")
_bytes = _between(1, 1e9, "number of bytes")
_seconds = _between(0, 3600, "number of seconds")
_share = _between(0, 1, "share between 0 and 1")
