"""The arguments of `mavftpfs sim`. Layer: sim; pure.

This is a module of its own, because the help of every command lists the arguments without running a vehicle.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES

DEFAULT_LINK = "udpout:127.0.0.1:14550"
DEFAULT_QUEUE = 8192
_PROFILES_SHOWN = "\n".join(f"  {name:<11}{profile.about}" for name, profile in PROFILES.items())

EPILOG = f"""\
Profiles:
{_PROFILES_SHOWN}

The link is given as the vehicle sees it: udpout:127.0.0.1:14550 pushes to a
ground station on this computer, as PX4's simulator does; udpin:0.0.0.0:14550
waits to be spoken to; tcpin:127.0.0.1:5760 is what ArduPilot's simulator does;
pty makes a serial port and prints the SOURCE for it. With any of --rate, --mtu,
--delay, --jitter, --loss, --burst-loss, --dup, --corrupt or --reorder, frames
go through the model of a bad link.

Signals: SIGUSR1 arms or disarms (kill -USR1 PID), SIGUSR2 cuts or mends the
link, SIGPWR reboots. SIGINT (Ctrl-C), SIGTERM and the end of its terminal end
it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `mavftpfs sim`."""
    parser.description = "Serve a directory as a simulated vehicle would."
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("directory", metavar="DIR", help="directory that is the vehicle's card")
    parser.add_argument(
        "--profile",
        metavar="NAME",
        default="px4",
        choices=sorted(PROFILES),
        help="FTP server to imitate, see below (default: px4)",
    )
    parser.add_argument(
        "--link", default=DEFAULT_LINK, metavar="URL", help=f"link to serve (default: {DEFAULT_LINK})"
    )
    parser.add_argument("--system", type=_system, default=1, metavar="ID", help="system id (default: 1)")
    parser.add_argument(
        "--clamp",
        type=_data_bytes,
        default=MAX_DATA,
        metavar="N",
        help=f"send at most N bytes of a file in a reply, as PX4 may over a radio (default: {MAX_DATA})",
    )
    parser.add_argument("--armed", action="store_true", help="start armed")
    parser.add_argument(
        "--telemetry", type=_rate, default=0.0, metavar="B/s", help="rate of other messages (default: none)"
    )
    _add_model_arguments(parser.add_argument_group("the link"))


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
    group.add_argument(
        "--rate", type=_positive, metavar="B/s", help="rate of the link each way (default: no limit)"
    )
    group.add_argument(
        "--queue",
        type=_bytes,
        default=DEFAULT_QUEUE,
        metavar="B",
        help=f"bytes that may wait for the transmitter (default: {DEFAULT_QUEUE})",
    )
    group.add_argument("--mtu", type=_bytes, metavar="B", help="largest frame that arrives (default: any)")
    group.add_argument(
        "--duplex",
        choices=[d.value for d in Duplex],
        default="full",
        help="half: both directions share the rate (default: full)",
    )
    group.add_argument(
        "--delay", type=_seconds, default=0.0, metavar="S", help="seconds each way (default: 0)"
    )
    group.add_argument(
        "--jitter", type=_seconds, default=0.0, metavar="S", help="seconds on top, at random (default: 0)"
    )
    for name, text in (
        ("--loss", "share of frames lost"),
        ("--burst-loss", "share of frames lost in runs of about 8"),
        ("--dup", "share of frames doubled"),
        ("--corrupt", "share of frames damaged"),
        ("--reorder", "share of frames delayed"),
    ):
        group.add_argument(name, type=_share, default=0.0, metavar="P", help=f"{text}, 0 to 1 (default: 0)")
    group.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of everything random (default: 0)"
    )


def _between(low: float, high: float, what: str) -> Callable[[str], float]:
    """Return a parser of numbers within [low, high]."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what}")
        return value

    return parse


def _data_bytes(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= MAX_DATA:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of bytes from 1 to {MAX_DATA}")
    return int(text)


def _system(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 255:
        raise argparse.ArgumentTypeError(f"{text!r} is not a system id (1 to 255)")
    return int(text)


_rate = _between(0, 1e12, "rate in bytes per second")
_positive = _between(1, 1e12, "rate in bytes per second (1 or more)")
_bytes = _between(1, 1e9, "number of bytes")
_seconds = _between(0, 3600, "number of seconds")
_share = _between(0, 1, "share between 0 and 1")
