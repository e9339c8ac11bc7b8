"""`mavftpfs sim DIR`: a simulated vehicle that serves a directory. Layer: sim (imported by cli only)."""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
from typing import TextIO

import trio

from mavftpfs.shared.errors import UsageError
from mavftpfs.sim.directorytree import DirectoryTree
from mavftpfs.sim.endpoints import Endpoint, client_source, open_endpoint
from mavftpfs.sim.linkmodel import Duplex, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.vehicle import SimVehicle

DEFAULT_LINK = "udpout:127.0.0.1:14550"
DEFAULT_QUEUE = 8192

EPILOG = """\
The link is given as the vehicle sees it: udpout:127.0.0.1:14550 pushes to a ground station on this computer,
as PX4's simulator does; udpin:0.0.0.0:14550 waits to be spoken to; tcpin:127.0.0.1:5760 is what ArduPilot's
simulator does; pty makes a serial port and prints its name. With any of --rate, --mtu, --delay, --jitter,
--loss, --burst-loss, --dup, --corrupt or --reorder, frames go through the model of a bad link.

Signals: SIGUSR1 arms or disarms, SIGUSR2 cuts or mends the link, SIGHUP reboots, SIGINT and SIGTERM end.
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
    parser.add_argument("--armed", action="store_true", help="be armed from the start")
    parser.add_argument(
        "--telemetry", type=_rate, default=0.0, metavar="B/s", help="other messages (default none)"
    )
    _add_model_arguments(parser.add_argument_group("the link"))


def run(args: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM; returns the exit code.

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
        telemetry=args.telemetry,
        armed=args.armed,
    )
    trio.run(_serve, args.link, vehicle, model, sys.stdout)
    return 0


def link_settings(args: argparse.Namespace) -> LinkSettings:
    """Return the model's settings; a link without any flaw is no model's business."""
    return LinkSettings(
        rate=args.rate,
        queue=args.queue,
        mtu=args.mtu,
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
        type=_size,
        default=DEFAULT_QUEUE,
        metavar="B",
        help=f"bytes that wait for the transmitter (default {DEFAULT_QUEUE})",
    )
    group.add_argument("--mtu", type=_size, metavar="B", help="longer frames are lost; without it, none")
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


async def _serve(link_text: str, vehicle: SimVehicle, model: LinkModel | None, out: TextIO) -> None:
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP)
    with trio.open_signal_receiver(*signals) as arriving:
        async with open_endpoint(link_text) as link:
            # The vehicle was built before its link: only now is it known whether it hears a stream.
            vehicle.set_stream(link.is_stream)
            endpoint = Endpoint(vehicle, link, model)
            _say(out, f"mavftpfs {client_source(link)} MOUNTPOINT")
            async with trio.open_nursery() as nursery:
                nursery.start_soon(endpoint.run)
                async for number in arriving:
                    if number in (signal.SIGINT, signal.SIGTERM):
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


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is no {what}")
    return value


def _rate(text: str) -> float:
    return _number(text, 0, 1e12, "rate in bytes per second")


def _positive(text: str) -> float:
    return _number(text, 1, 1e12, "rate in bytes per second (1 or more)")


def _size(text: str) -> int:
    return int(_number(text, 1, 1e9, "number of bytes"))


def _seconds(text: str) -> float:
    return _number(text, 0, 3600, "number of seconds")


def _share(text: str) -> float:
    return _number(text, 0, 1, "share between 0 and 1")
