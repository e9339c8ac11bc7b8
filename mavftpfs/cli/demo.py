"""`mavftpfs demo`: a short tour with a simulated drone behind a bad radio. Layer: cli.

The tour runs the same commands as a user (`mavftpfs sim`, `mavftpfs SOURCE MOUNTPOINT`, ls, cat, cp, sed,
diff, `mavftpfs status`), each as its own process, in one temporary directory. Even after Ctrl-C or an error,
no process, mount or file is left behind. The exit code is 0 only if every byte that arrived equals the one on
the vehicle's card.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rich.console import Console
from rich.panel import Panel

from mavftpfs.client import control
from mavftpfs.client.mountpoint import mounts
from mavftpfs.client.mounts import status_of
from mavftpfs.mount.daemon import signals_held

HOST = "127.0.0.1"
PROFILE = "px4"
RADIO = ("--rate", "40000", "--delay", "0.05", "--jitter", "0.01", "--loss", "0.08", "--seed", "1")
RADIO_WORDS = "40 kB/s, 100 ms there and back, 8 of 100 packets lost in each direction"

LOG_SIZE = 300_000
STEP_TIMEOUT = 60.0
"""Seconds after which any step of the tour counts as failed."""
END_TIMEOUT = 3.0
"""Seconds for a process to end."""

PROGRAM = (sys.executable, "-m", "mavftpfs")

LOG = "fs/microsd/log/2026-11-20/10_32_15.ulg"
SCRIPT = "fs/microsd/etc/extras.txt"
SCRIPT_TEXT = """\
# Run by the autopilot at every start
mavlink start -d /dev/ttyS1 -b 57600
camera_trigger start
param set COM_DISARM_LAND 2
"""
EDIT = ("57600", "115200")


class DemoFailed(Exception):
    """The tour cannot go on; the text is one line for a person."""


class Step(NamedTuple):
    """A command of the tour. words: as a user would type them. why: the explanation before it, or "".

    is_right: returns whether the command's output proves that the bytes are right.
    """

    why: str
    words: tuple[str, ...]
    is_right: Callable[[str], bool] | None = None


def steps(source: str) -> list[Step]:
    """Return the commands of the tour; source: of the simulated drone."""
    return [
        Step(
            "The drone is switched on. Now we mount it, over UDP, as a telemetry radio would hand it to us:",
            ("mavftpfs", source, "drone"),
        ),
        Step("It looks like any other directory:", ("ls", "-l", f"drone/{Path(LOG).parent}")),
        Step("Reading a file needs nothing special either:", ("cat", f"drone/{SCRIPT}"), SCRIPT_TEXT.__eq__),
        Step(
            "Copying a flight log over the bad radio. Lost packets are requested again while the rest flows:",
            ("cp", f"drone/{LOG}", "flight.ulg"),
        ),
        Step(
            "",
            ("md5sum", f"card/{LOG}", "flight.ulg"),
            lambda sums: len({line.split()[0] for line in sums.splitlines()}) == 1,
        ),
        Step(
            "How the drone, the radio and all transfers are doing, at any time:",
            ("mavftpfs", "status", "drone"),
        ),
        Step(
            "Changing a file is as simple. When the program has closed it, the whole new file is on the "
            "drone's card and was compared with what was written:",
            ("sed", "-i", "s/{}/{}/".format(*EDIT), f"drone/{SCRIPT}"),
        ),
        Step("", ("cat", f"card/{SCRIPT}"), SCRIPT_TEXT.replace(*EDIT).__eq__),
        Step(
            "And the whole drone compared with its card (silence means: no difference):",
            ("diff", "-r", "card", "drone"),
            "".__eq__,
        ),
        Step("Done. Unmounting:", ("mavftpfs", "umount", "drone")),
    ]


def take(step: Step, console: Console, folder: Path) -> bool:
    """Show and run a command in the temporary directory, and show its output. Return whether the bytes that
    it compares are right."""
    if step.why:
        console.print(f"\n{step.why}")
    console.print(f"[bold green]$[/] [bold]{' '.join(step.words)}[/]", highlight=False)
    program, *rest = step.words
    with running([*PROGRAM, *rest] if program == "mavftpfs" else step.words, folder) as child:
        try:
            output, _ = child.communicate(timeout=STEP_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise DemoFailed(f"{program} did not end within {STEP_TIMEOUT:.0f} s") from None
    text = output.decode(errors="replace")
    if text.strip():
        console.print(text.rstrip(), highlight=False, markup=False)
    if child.returncode:
        raise DemoFailed(f"{program} ended with {child.returncode}")
    if step.is_right is None:
        return True
    right = step.is_right(text)
    console.print("[bold green]Right, byte for byte.[/]" if right else "[bold red]It differs.[/]")
    return right


@contextmanager
def running(
    words: Sequence[str], folder: Path, *, output: int | BinaryIO = subprocess.PIPE, apart: bool = False
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command in the temporary directory, and end it with the body, gently first.

    The wait for its end is short, because a reader inside a mount ends only when the mount answers, and
    another step ends the mount. apart: Ctrl-C reaches only the tour, which then ends everything in order.
    """
    child = None
    state = {"XDG_STATE_HOME": str(folder / "state")}  # the files that a mount keeps go with the directory
    try:
        with signals_held():
            child = subprocess.Popen(
                words,
                cwd=folder,
                env={**os.environ, **state},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=apart,
            )
        yield child
    finally:
        if child is not None:
            for end_it in (child.terminate, child.kill):
                if child.poll() is None:
                    end_it()
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(END_TIMEOUT)


@contextmanager
def vehicle(arguments: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run `mavftpfs sim ARGUMENTS` beside the tour."""
    with (
        (folder / "vehicle.log").open("wb") as log,
        running([*PROGRAM, "sim", *arguments], folder, output=log, apart=True) as process,
    ):
        yield process


def free_port() -> int:
    """Return a UDP port of the loopback that is free at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((HOST, 0))
        port: int = sock.getsockname()[1]
        return port


def fill_card(card: Path) -> None:
    """Write the vehicle's files: two flight logs, a start script, a note."""
    rng = random.Random(1)
    (card / LOG).parent.mkdir(parents=True)
    (card / SCRIPT).parent.mkdir(parents=True)
    (card / LOG).write_bytes(b"ULog\x01\x12\x35\x01" + rng.randbytes(LOG_SIZE - 8))
    (card / LOG).with_name("10_21_03.ulg").write_bytes(rng.randbytes(18_251))
    (card / SCRIPT).write_text(SCRIPT_TEXT)
    for path in card.rglob("*"):
        os.utime(path, (1795170735, 1795170735))


def introduce(console: Console) -> None:
    """Introduce the tour."""
    console.print(
        Panel(
            "A drone keeps its flight logs, scripts and settings on a memory card. Over the air the only way "
            "to them is a request-and-answer protocol (MAVLink FTP): 239 bytes at a time, over whatever "
            "radio there is. [bold]mavftpfs makes the drone a directory[/], so that every program you know "
            "can work with it.\n\n"
            f"This tour simulates a drone behind a bad radio ({RADIO_WORDS}), mounts it, reads it, "
            "edits it, and checks every byte. It needs no hardware and leaves nothing behind.",
            title="mavftpfs",
            border_style="cyan",
        )
    )


def release(path: Path) -> None:
    """End a mount that was not unmounted, and discard pending changes, because the drone is only
    simulated."""
    if str(path) not in mounts():
        return
    with suppress(control.ControlError, ProcessLookupError):
        os.kill(int(status_of(str(path))["pid"]), signal.SIGKILL)
    subprocess.run(["fusermount3", "-uz", path], capture_output=True, check=False)


def conclude(console: Console, good: bool) -> int:
    """Print the verdict and the way to a real vehicle; return the exit code."""
    program = "mavftpfs" if shutil.which("mavftpfs") else os.path.relpath(sys.argv[0])
    verdict = (
        "[bold green]Every byte was right.[/]" if good else "[bold red]Something differed: this is a bug.[/]"
    )
    console.print(
        Panel(
            f"{verdict} The drone is unmounted and everything is cleaned up.\n\n"
            "With a real one:\n"
            "  mkdir -p ~/drone\n"
            f"  {program} udpin:0.0.0.0:14550 ~/drone        [dim]# Wi-Fi, or a router[/]\n"
            f"  {program} /dev/ttyACM0 ~/drone               [dim]# USB cable[/]\n"
            f"  {program} /dev/ttyUSB0,57600 ~/drone         [dim]# telemetry radio[/]",
            border_style="green" if good else "red",
        ),
        highlight=False,
    )
    return 0 if good else 1


def take_tour(console: Console, folder: Path, stack: ExitStack) -> bool:
    """Take all steps; return whether all bytes were right. `stack` ends everything that was started."""
    card, drone, port = folder / "card", folder / "drone", free_port()
    card.mkdir()
    drone.mkdir()
    fill_card(card)
    introduce(console)
    link = f"udpout:{HOST}:{port}"
    stack.enter_context(vehicle([str(card), "--profile", PROFILE, "--link", link, *RADIO], folder))
    stack.callback(release, drone)
    try:
        verdicts = [take(step, console, folder) for step in steps(f"udpin:{HOST}:{port}")]
        return all(verdicts)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # another Ctrl-C must not stop the cleaning up


def demo(args: argparse.Namespace) -> int:
    """Run the demo and return its exit code: 0 only if all comparisons agreed."""
    console = Console()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    # The kernel's table and the mount's socket name the place by its real path.
    folder = Path(tempfile.mkdtemp(prefix="mavftpfs-demo-")).resolve()
    try:
        with ExitStack() as stack:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            good = take_tour(console, folder, stack)
    except (DemoFailed, control.ControlError) as error:
        console.print(f"[red]mavftpfs demo: {error}[/]", highlight=False)
        return 1
    except KeyboardInterrupt:
        console.print("\nStopped; everything is cleaned up.")
        return 130
    return conclude(console, good)
