"""The simulated vehicle on real links, on the command line, and in memory on a mock clock."""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest
import trio
import trio.testing

from mavftpfs.link.base import Link
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpFrame, Heartbeat, Message
from mavftpfs.link.opening import open_link
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import MAX_DATA, Opcode, Payload, decode_reply, request
from mavftpfs.shared.errors import LinkClosed, UsageError
from mavftpfs.sim import endpoints
from mavftpfs.sim.endpoints import Endpoint, client_source, open_endpoint
from mavftpfs.sim.linkmodel import Duplex, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.memory import MemoryLink
from tests.support.vehicles import free_udp_port

US = Address(254, 191)
DRONE = Address(1, 1)
CONTENT = random.Random("content").randbytes(50_000)


def vehicle(profile: str = "px4", *, stream: bool = False, telemetry: float = 0.0) -> SimVehicle:
    tree = MemoryTree()
    tree.add(b"/log.bin", CONTENT)
    return SimVehicle(tree, PROFILES[profile], rng=random.Random(1), stream=stream, telemetry=telemetry)


class Client:
    """A plain client: one request at a time, or a window of reads."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.framer = Framer(US, stream=link.is_stream)
        self.seq = 100
        self.heard: list[Message] = []
        self.reopened = 0

    async def messages(self) -> list[Message]:
        """Return what the next batch brings."""
        chunks = await self.link.receive()
        if not chunks:
            self.reopened += 1
            self.framer.reset()
        found = [message for chunk in chunks for message in self.framer.feed(chunk)]
        self.heard += found
        return found

    async def beat(self) -> Heartbeat:
        """Wait for a heartbeat."""
        while True:
            for message in await self.messages():
                if isinstance(message, Heartbeat):
                    return message

    async def silence(self) -> None:
        """Wait until longer than between two heartbeats nothing comes."""
        heard = True
        while heard:
            with trio.move_on_after(1.5) as scope:
                await self.messages()
            heard = not scope.cancelled_caught

    def send(self, wanted: Payload) -> None:
        self.link.send_nowait([self.framer.encode_ftp(DRONE, wanted.encode())])

    async def ask(self, opcode: Opcode, data: bytes = b"", **fields: int) -> Payload:
        """Ask until an answer comes, every second with the same seq."""
        self.seq = (self.seq + 7) & 0xFFFF
        while True:
            self.send(request(self.seq, opcode, data=data, **fields))
            with trio.move_on_after(1):
                while True:
                    for message in await self.messages():
                        if isinstance(message, FtpFrame):
                            reply = decode_reply(message.payload)
                            if reply.seq == (self.seq + 1) & 0xFFFF and reply.req_opcode == opcode:
                                return reply

    async def read_file(self, path: bytes) -> bytes:
        """Open and read a file, one chunk after the other."""
        opened = await self.ask(Opcode.OPEN_FILE_RO, path)
        assert opened.opcode == Opcode.ACK
        size, data = int.from_bytes(opened.data, "little"), b""
        while len(data) < size:
            count = min(MAX_DATA, size - len(data))
            reply = await self.ask(Opcode.READ_FILE, offset=len(data), size=count)
            assert reply.offset == len(data)
            data += reply.data
        await self.ask(Opcode.TERMINATE_SESSION)
        return data


# ---------------------------------------------------------------------- real links


@pytest.mark.parametrize("kind", ["udpout", "tcp"])
async def test_pushes_to_a_listening_client(kind: str) -> None:
    listen = {"udpout": "udpin", "tcp": "tcpin"}[kind]
    with trio.fail_after(30):
        async with open_link(parse_source(f"{listen}:127.0.0.1:0")) as client_link:
            port = parse_source(client_link.description).port
            async with open_endpoint(f"{kind}:127.0.0.1:{port}") as link, trio.open_nursery() as nursery:
                assert client_source(link) == client_link.description
                endpoint = Endpoint(vehicle(stream=link.is_stream), link)
                nursery.start_soon(endpoint.run)
                client = Client(client_link)
                await client.beat()
                assert await client.read_file(b"/log.bin") == CONTENT
                nursery.cancel_scope.cancel()


# ---------------------------------------------------------------------- the command


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser("sim")
    endpoints.add_arguments(parser)
    return parser.parse_args(words)


MODEL_WORDS = """
    --rate 5760 --queue 1000 --mtu 200 --duplex half --delay .1 --jitter .2 --loss .3 --burst-loss .4 --dup .5
    --corrupt .6 --reorder .7 --seed 8 --armed --telemetry 500 --profile mavsdk
"""


def test_arguments_reach_the_model() -> None:
    args = arguments("DIR", *MODEL_WORDS.split())
    assert endpoints.link_settings(args) == LinkSettings(
        rate=5760, queue=1000, mtu=200, duplex=Duplex.HALF, delay=0.1, jitter=0.2, loss=0.3, burst_loss=0.4,
        duplicate=0.5, corrupt=0.6, reorder=0.7,
    )  # fmt: skip
    assert (args.seed, args.armed, args.telemetry, args.profile) == (8, True, 500.0, "mavsdk")


@pytest.mark.parametrize(
    "words",
    ["--loss 1.5", "--loss -1", "--loss nan", "--rate 0", "--queue x", "--delay -1", "--profile mine"],
)
def test_nonsense_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        arguments("DIR", *words.split())
    assert words.split()[0] in capsys.readouterr().err


def test_a_missing_directory_is_the_users_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot serve [^:]*nowhere: No such file"):
        endpoints.run(arguments(str(tmp_path / "nowhere")))


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
    assert ("/fs/microsd only" in capsys.readouterr().err) == told


def test_a_bad_link_is_the_users_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="write for example"):
        endpoints.run(arguments(str(tmp_path), "--link", "smoke:signals"))
    with pytest.raises(LinkClosed, match="is not an address"):
        endpoints.run(arguments(str(tmp_path), "--link", "udpin:198.51.100.1:1"))


RUNNER = """
import argparse, sys
from mavftpfs.sim import endpoints
parser = argparse.ArgumentParser("sim")
endpoints.add_arguments(parser)
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
            (signal.SIGHUP, "rebooted"),
        ):
            child.send_signal(number)
            assert line(child.stdout) == says
        child.send_signal(signal.SIGTERM)
        assert line(child.stdout) == "ended after 0 FTP requests, open sessions: 0"
        assert child.wait(60) == 0


async def test_the_process_joins_the_pieces_of_a_stream(tmp_path: Path) -> None:
    """Cut where a datagram's reader would think that a new frame begins."""
    frame = Framer(US, stream=True).encode_ftp(DRONE, request(7, Opcode.NONE, data=b"\xfd" * 20).encode())
    middle = frame.index(b"\xfd", 1)
    with running(str(tmp_path), "--link", "tcpin:127.0.0.1:0") as child, trio.fail_after(60):
        words = (await trio.to_thread.run_sync(line, child.stdout)).split()
        async with open_link(parse_source(words[1])) as client_link:
            client = Client(client_link)
            await client.beat()
            client_link.send_nowait([frame[:middle]])
            await trio.sleep(0.1)
            client_link.send_nowait([frame[middle:]])
            while not any(isinstance(message, FtpFrame) for message in client.heard):
                await client.messages()


# ---------------------------------------------------------------------- in memory


def run_virtual(main: object, *args: object) -> float:
    """Run on a mock clock; return the virtual seconds it took."""
    clock = trio.testing.MockClock(autojump_threshold=0)
    start = clock.current_time()
    trio.run(main, *args, clock=clock)  # type: ignore[arg-type]
    return clock.current_time() - start


RADIO = LinkSettings(rate=5760, queue=4096, duplex=Duplex.HALF, delay=0.05, loss=0.02, corrupt=0.01)


async def read_in_memory(stream: bool, settings: LinkSettings | None, seed: int) -> tuple[Client, MemoryLink]:
    model = None if settings is None else LinkModel(random.Random(seed), settings)
    link = MemoryLink(vehicle(stream=stream, telemetry=300), model, stream=stream, rng=random.Random(seed))
    client = Client(link)
    await client.beat()
    assert await client.read_file(b"/log.bin") == CONTENT
    return client, link


def test_the_same_seed_gives_the_same_story() -> None:
    def story(seed: int) -> tuple[float, list[Message]]:
        heard: list[Message] = []

        async def main() -> None:
            client, _ = await read_in_memory(True, RADIO, seed)
            heard.extend(client.heard)

        return run_virtual(main), heard

    assert story(1) == story(1)
    assert story(1) != story(2)


@pytest.mark.parametrize("modelled", [False, True])
@pytest.mark.parametrize("stream", [False, True])
def test_memory_link_cut_and_restored(modelled: bool, stream: bool) -> None:
    async def main() -> None:
        model = LinkModel(random.Random(1), LinkSettings(delay=0.5)) if modelled else None
        link = MemoryLink(vehicle(stream=stream), model, stream=stream)
        client = Client(link)
        await client.beat()
        client.send(request(7, Opcode.NONE))
        await trio.sleep(0.1)
        link.cut()  # the modelled request is still under way
        client.send(request(8, Opcode.NONE))
        with trio.move_on_after(30):
            while True:
                await client.messages()
        await trio.sleep(1)
        assert link.vehicle.server.requests.total() == (0 if modelled else 1)
        link.restore()
        heard = await client.messages()
        assert (client.reopened, heard) == (1, []) if stream else client.reopened == 0
        assert (await client.ask(Opcode.NONE)).opcode == Opcode.ACK
        assert link.stats.reopened == client.reopened

    run_virtual(main)


def test_a_vehicle_that_never_rests_fails_the_test_instead_of_hanging_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tests.support.memory._MAX_STEPS", 100)

    async def main() -> None:
        link = MemoryLink(vehicle())
        monkeypatch.setattr(type(link.vehicle), "next_deadline", lambda self: 0.0)
        with pytest.raises(AssertionError, match="one instant"):
            await link.receive()

    run_virtual(main)
