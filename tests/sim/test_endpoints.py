"""`mavftpfs sim`: its arguments, its signals, and its output."""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest
import trio

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpRun, Heartbeat, Message
from mavftpfs.link.opening import open_link
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import LinkClosed
from mavftpfs.sim import endpoints
from mavftpfs.sim.arguments import add_arguments, link_settings
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.replies import request
from tests.support.vehicles import free_udp_port

pytestmark = pytest.mark.real_time


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser("sim")
    add_arguments(parser)
    return parser.parse_args(words)


MODEL_WORDS = """
    --rate 5760 --queue 1000 --mtu 200 --duplex half --delay .1 --jitter .2 --loss .3 --burst-loss .4 --dup .5
    --corrupt .6 --reorder .7 --seed 8 --armed --telemetry 500 --profile mavsdk
"""


def test_arguments_reach_the_model() -> None:
    args = arguments("DIR", *MODEL_WORDS.split())
    assert link_settings(args) == LinkSettings(
        rate=5760, queue=1000, mtu=200, duplex=Duplex.HALF, delay=0.1, jitter=0.2, loss=0.3, burst_loss=0.4,
        duplicate=0.5, corrupt=0.6, reorder=0.7,
    )  # fmt: skip
    assert (args.seed, args.armed, args.telemetry, args.profile) == (8, True, 500.0, "mavsdk")


@pytest.mark.parametrize(
    "words",
    [
        "--system 0",
        "--system 256",
        "--system x",
        "--loss 1.5",
        "--loss -1",
        "--loss nan",
        "--rate 0",
        "--queue x",
        "--delay -1",
        "--profile mine",
    ],
)
def test_nonsense_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        arguments("DIR", *words.split())
    assert words.split()[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("profile", "storage", "told"),
    [("px4", "", False), ("px4-nuttx", "", True), ("px4-nuttx", "fs/microsd", False)],
)
def test_a_card_that_nothing_can_be_written_to_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], profile: str, storage: str, told: bool
) -> None:
    (tmp_path / storage).mkdir(parents=True, exist_ok=True)
    with pytest.raises(LinkClosed):
        endpoints.run(arguments(str(tmp_path), "--profile", profile, "--link", "udpin:198.51.100.1:1"))
    assert ("only below /fs/microsd" in capsys.readouterr().err) == told


RUNNER = """
import argparse, sys
from mavftpfs.sim import endpoints
from mavftpfs.sim.arguments import add_arguments
parser = argparse.ArgumentParser("sim")
add_arguments(parser)
sys.exit(endpoints.run(parser.parse_args()))
"""


@contextmanager
def running(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Run the command in a process of its own."""
    child = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", RUNNER, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate(timeout=60)


def line(stream: IO[str] | None) -> str:
    assert stream is not None
    return stream.readline().rstrip("\n")


def test_says_where_to_connect_reacts_to_signals_and_ends_cleanly(tmp_path: Path) -> None:
    port = free_udp_port()
    with running(str(tmp_path), "--link", f"udpout:127.0.0.1:{port}") as child:
        assert line(child.stdout) == f"mavftpfs udpin:127.0.0.1:{port} MOUNTPOINT"
        for number, says in (
            (signal.SIGUSR1, "armed"),
            (signal.SIGUSR1, "disarmed"),
            (signal.SIGUSR2, "link cut"),
            (signal.SIGUSR2, "link mended"),
            (signal.SIGPWR, "rebooted"),
        ):
            child.send_signal(number)
            assert line(child.stdout) == says
        child.send_signal(signal.SIGTERM)
        assert line(child.stdout) == "ended after 0 FTP requests, open sessions: 0"
        assert child.wait(60) == 0


@pytest.mark.parametrize(("words", "baud"), [((), 4_000_000), (("--rate", "5760"), 57_600)])
def test_a_serial_port_is_as_fast_as_the_link(tmp_path: Path, words: tuple[str, ...], baud: int) -> None:
    """Programs that share a port pace themselves by its baud rate."""
    with running(str(tmp_path), "--link", "pty", *words) as child:
        assert re.fullmatch(rf"mavftpfs /dev/pts/\d+,{baud} MOUNTPOINT", line(child.stdout))


def test_the_help_says_what_each_profile_simulates() -> None:
    parser = argparse.ArgumentParser("sim")
    add_arguments(parser)
    for profile in PROFILES.values():
        assert re.search(rf"^  {profile.name} +\w.{{20,}}$", parser.format_help(), re.MULTILINE)


def test_it_ends_with_its_terminal(tmp_path: Path) -> None:
    with running(str(tmp_path), "--link", f"udpout:127.0.0.1:{free_udp_port()}") as child:
        line(child.stdout)
        child.send_signal(signal.SIGHUP)
        assert line(child.stdout).startswith("ended")
        assert child.wait(60) == 0


async def test_the_process_joins_the_pieces_of_a_stream(tmp_path: Path) -> None:
    """Cut where a datagram's reader would think that a new frame begins."""
    framer = Framer(Address(254, 191), stream=True)
    frame = framer.encode_ftp(Address(1, 1), request(7, Opcode.NONE, data=b"\xfd" * 20).encode())
    middle = frame.index(b"\xfd", 1)
    with running(str(tmp_path), "--link", "tcpin:127.0.0.1:0") as child, trio.fail_after(60):
        words = (await trio.to_thread.run_sync(line, child.stdout)).split()
        async with open_link(parse_source(words[1])) as link:
            heard: list[Message] = []

            async def hear(kind: type[Message]) -> None:
                while not any(isinstance(message, kind) for message in heard):
                    heard.extend(message for data, _ in await link.receive() for message in framer.feed(data))

            await hear(Heartbeat)
            link.send([frame[:middle]])
            await trio.sleep(0.1)
            link.send([frame[middle:]])
            await hear(FtpRun)
