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
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

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


@dataclass
class Tour:
    """State that the steps share. `proofs`: one entry for each comparison."""

    console: Console
    folder: Path
    proofs: list[bool] = field(default_factory=list)

    @property
    def card(self) -> Path:
        """The content of the vehicle's memory card."""
        return self.folder / "card"

    @property
    def drone(self) -> Path:
        """The directory where the vehicle is mounted."""
        return self.folder / "drone"

    def say(self, text: str) -> None:
        """Explain."""
        self.console.print(f"\n{text}")

    def command(self, *words: str) -> str:
        """Show and run a command in the temporary directory, and show and return its output."""
        self.console.print(f"[bold green]$[/] [bold]{' '.join(words)}[/]", highlight=False)
        program, *rest = words
        argv = [*PROGRAM, *rest] if program == "mavftpfs" else words
        with running(argv, self.folder) as child:
            try:
                output, _ = child.communicate(timeout=STEP_TIMEOUT)
            except subprocess.TimeoutExpired:
                raise DemoFailed(f"{words[0]} did not end within {STEP_TIMEOUT:.0f} s") from None
        text = output.decode(errors="replace")
        if text.strip():
            self.console.print(text.rstrip(), highlight=False, markup=False)
        if child.returncode:
            raise DemoFailed(f"{words[0]} ended with {child.returncode}")
        return text

    def verdict(self, same: bool) -> None:
        """Record a comparison, and print its result."""
        self.proofs.append(same)
        self.console.print("[bold green]Right, byte for byte.[/]" if same else "[bold red]It differs.[/]")


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


def introduce(tour: Tour) -> None:
    """Introduce the tour."""
    tour.console.print(
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


def mount(tour: Tour, stack: ExitStack) -> None:
    """Start the vehicle and mount it."""
    port = free_port()
    link = f"udpout:{HOST}:{port}"
    stack.enter_context(vehicle([str(tour.card), "--profile", PROFILE, "--link", link, *RADIO], tour.folder))
    stack.callback(release, tour.drone)
    tour.say("The drone is switched on. Now we mount it, over UDP, as a telemetry radio would hand it to us:")
    tour.command("mavftpfs", f"udpin:{HOST}:{port}", "drone")


def release(path: Path) -> None:
    """End a mount that was not unmounted, and discard pending changes, because the drone is only
    simulated."""
    if str(path) not in mounts():
        return
    with suppress(control.ControlError, ProcessLookupError):
        os.kill(int(status_of(str(path))["pid"]), signal.SIGKILL)
    subprocess.run(["fusermount3", "-uz", path], capture_output=True, check=False)


def look_around(tour: Tour) -> None:
    """Run ls and cat."""
    tour.say("It looks like any other directory:")
    tour.command("ls", "-l", f"drone/{Path(LOG).parent}")
    tour.say("Reading a file needs nothing special either:")
    text = tour.command("cat", f"drone/{SCRIPT}")
    tour.proofs.append(text == SCRIPT_TEXT)


def copy_log(tour: Tour) -> None:
    """Copy a log, then compare checksums."""
    tour.say(
        "Copying a flight log over the bad radio. Lost packets are requested again while the rest flows:"
    )
    tour.command("cp", f"drone/{LOG}", "flight.ulg")
    sums = tour.command("md5sum", f"card/{LOG}", "flight.ulg")
    tour.verdict(len({line.split()[0] for line in sums.splitlines()}) == 1)


def edit_script(tour: Tour) -> None:
    """Change a file on the drone with an ordinary program, and look at the card."""
    tour.say(
        "Changing a file is as simple. When the program has closed it, the whole new file is on the drone's "
        "card and was compared with what was written:"
    )
    old, new = EDIT
    tour.command("sed", "-i", f"s/{old}/{new}/", f"drone/{SCRIPT}")
    tour.verdict(tour.command("cat", f"card/{SCRIPT}") == SCRIPT_TEXT.replace(old, new))


def show_status(tour: Tour) -> None:
    """Show the mount's report about the drone and the radio."""
    tour.say("How the drone, the radio and all transfers are doing, at any time:")
    tour.command("mavftpfs", "status", "drone")


def compare_all(tour: Tour) -> None:
    """Compare the whole mount with the card, by diff."""
    tour.say("And the whole drone compared with its card (silence means: no difference):")
    tour.proofs.append(tour.command("diff", "-r", "card", "drone") == "")


def conclude(tour: Tour) -> int:
    """Print the verdict and the way to a real vehicle; return the exit code."""
    good = len(tour.proofs) == 4 and all(tour.proofs)
    program = "mavftpfs" if shutil.which("mavftpfs") else os.path.relpath(sys.argv[0])
    verdict = (
        "[bold green]Every byte was right.[/]" if good else "[bold red]Something differed: this is a bug.[/]"
    )
    tour.console.print(
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


def take_tour(tour: Tour, stack: ExitStack) -> None:
    """Take all steps; `stack` ends everything that was started."""
    tour.card.mkdir()
    tour.drone.mkdir()
    fill_card(tour.card)
    introduce(tour)
    mount(tour, stack)
    try:
        look_around(tour)
        copy_log(tour)
        show_status(tour)
        edit_script(tour)
        compare_all(tour)
        tour.say("Done. Unmounting:")
        tour.command("mavftpfs", "umount", "drone")
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # another Ctrl-C must not stop the cleaning up


def demo(args: argparse.Namespace) -> int:
    """Run the demo and return its exit code: 0 only if all comparisons agreed."""
    console = Console()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    # The kernel's table and the mount's socket name the place by its real path.
    tour = Tour(console, Path(tempfile.mkdtemp(prefix="mavftpfs-demo-")).resolve())
    try:
        with ExitStack() as stack:
            stack.callback(shutil.rmtree, tour.folder, ignore_errors=True)
            take_tour(tour, stack)
    except (DemoFailed, control.ControlError) as error:
        console.print(f"[red]mavftpfs demo: {error}[/]", highlight=False)
        return 1
    except KeyboardInterrupt:
        console.print("\nStopped; everything is cleaned up.")
        return 130
    return conclude(tour)
