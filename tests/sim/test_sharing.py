"""A port that a program has alone, shares through a hub and has alone again: link.sharing, with real hubs."""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import Any

import pytest
import trio

from mavftpfs.cli import ports
from mavftpfs.link import hublink, sharing
from mavftpfs.link.base import Link, plain_nursery
from mavftpfs.link.framing import Framer
from mavftpfs.link.hublink import PortRequest
from mavftpfs.link.messages import Address
from mavftpfs.link.ports import connect, next_caller, port_name, take_name
from mavftpfs.link.sharing import open_shared
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import LinkClosed
from tests.support.mounts import wait_until
from tests.support.vehicles import HOST, free_udp_port

pytestmark = pytest.mark.real_time
US = Address(254, 191)
VEHICLE = Address(1, 1)


class Port:
    """A UDP port that programs of ours share, and the vehicle that sends there."""

    def __init__(self) -> None:
        self.source = f"udpin:{HOST}:{free_udp_port()}"
        self.spec = parse_source(self.source)
        self.vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.vehicle.connect((HOST, self.spec.port))
        self.vehicle.setblocking(False)
        self._beat = Framer(VEHICLE, stream=False).encode_heartbeat(2, 12)

    def shared(self, *forward: str) -> Any:
        """Return the context manager of one more program's link."""
        return open_shared(self.spec, PortRequest(US, forward))

    async def run_program(self, *, task_status: trio.TaskStatus[tuple[Link, trio.CancelScope]]) -> None:
        """Be one more program until cancelled; starts with its link, and what cancels it."""
        with trio.CancelScope() as scope:
            async with self.shared() as link:
                task_status.started((link, scope))
                await trio.sleep_forever()

    def hub(self) -> int | None:
        """Return the process id of the hub."""
        found = ports.statuses(self.source)
        return found[0]["pid"] if found else None

    async def hears(self, *links: Link) -> None:
        """Wait until the vehicle reaches all of these, and they reach it."""
        for link in links:
            with trio.fail_after(60):
                while not await self._heard(link):
                    pass

    async def _heard(self, link: Link) -> bool:
        try:
            self.vehicle.send(self._beat)
        except ConnectionRefusedError:
            await trio.sleep(0.02)
        with trio.move_on_after(0.1):
            data, sender = (await link.receive())[-1]
            if data:
                address = self.vehicle.getsockname()
                assert sender == address
                link.send([Framer(US, stream=False).encode_heartbeat(18)], address)
                await trio.lowlevel.wait_readable(self.vehicle)
                self.vehicle.recv(2048)
                return True
        return False


@pytest.fixture
def port() -> Iterator[Port]:
    """A port, and its vehicle. Its hub ends with its last client; hubs of other tests live on beside it."""
    made = Port()
    yield made
    made.vehicle.close()
    wait_until("its hub ended", lambda: made.hub() is None)


async def kill_hub(port: Port) -> None:
    pid = await trio.to_thread.run_sync(port.hub)
    assert pid is not None
    os.kill(pid, signal.SIGKILL)


@asynccontextmanager
async def listening(link: Link) -> AsyncIterator[list[int]]:
    """Take what comes in the background; yields the sizes of all pieces, so 0 for "reopened"."""
    sizes: list[int] = []

    async def listen() -> None:
        while True:
            sizes.extend(len(data) for data, _ in await link.receive())

    async with trio.open_nursery() as nursery:
        nursery.start_soon(listen)
        yield sizes
        nursery.cancel_scope.cancel()


async def until(condition: Callable[[], bool]) -> None:
    with trio.fail_after(60):
        while True:
            if condition():
                return
            await trio.sleep(0.02)


# -- who has the port -----------------------------------------------------------------------------


async def test_the_last_client_of_a_killed_hub_has_the_port_itself_and_keeps_its_seat(port: Port) -> None:
    async with plain_nursery() as nursery:
        _, first = await nursery.start(port.run_program)
        two, _ = await nursery.start(port.run_program)
        first.cancel()
        seat = two.seat
        assert seat is not None
        assert seat.own == Address(254, 192)
        async with listening(two) as sizes:
            await kill_hub(port)
            await until(lambda: 0 in sizes)
        await port.hears(two)
        assert await trio.to_thread.run_sync(port.hub) is None
        async with port.shared() as three:
            await port.hears(three, two)
            assert two.seat == seat
            assert three.seat is not None
            assert three.seat.own == US


async def test_programs_that_begin_at_once_all_share_the_port(port: Port) -> None:
    links: list[Link] = []

    async def begin() -> None:
        link, _ = await nursery.start(port.run_program)
        links.append(link)

    async with plain_nursery() as nursery:
        async with trio.open_nursery() as beginning:
            for _ in range(6):
                beginning.start_soon(begin)
        await until(lambda: all(link.seat is not None for link in links))
        seats = [link.seat for link in links if link.seat is not None]
        assert len({seat.own for seat in seats}) == 6
        assert len({seat.number for seat in seats}) == 6
        await port.hears(*links)


# -- what cannot be -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("program", "why"), [("/bin/false", "the hub did not start"), ("/bin/true", "the hub ended at once")]
)
async def test_why_a_port_cannot_be_shared_is_told_to_the_program_that_wants_it(
    port: Port, monkeypatch: pytest.MonkeyPatch, program: str, why: str
) -> None:
    monkeypatch.setattr(sharing, "COMING", 0.2)
    async with port.shared() as one:
        await port.hears(one)
        monkeypatch.setattr(sys, "executable", program)
        with pytest.raises(LinkClosed, match=f"cannot be shared: {why}"):
            async with port.shared():
                pass
        assert one.stats.reopened == 0
        monkeypatch.undo()
        async with port.shared() as two:
            await port.hears(one, two)


async def test_a_program_keeps_its_port_from_those_of_another_version(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither joins, nor is it the hub that takes the port."""
    async with port.shared() as one:
        await port.hears(one)
        with monkeypatch.context() as patch:
            patch.setattr(hublink, "PROTOCOL", hublink.PROTOCOL - 1)
            with pytest.raises(
                LinkClosed, match=f"process {os.getpid()} has this port, with another version"
            ):
                async with port.shared():
                    pass
        with monkeypatch.context() as patch:  # an upgrade replaced the files; the hub is of the new version
            patch.setattr(sharing, "PROTOCOL", hublink.PROTOCOL + 1)
            patch.setattr(hublink, "PROTOCOL", hublink.PROTOCOL + 1)
            with pytest.raises(LinkClosed, match="mavftpfs was upgraded since this program started"):
                async with port.shared():
                    pass
        await port.hears(one)
        assert one.stats.reopened == 0


@contextmanager
def no_descriptors_left() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))), before[1]))
    taken = []
    with suppress(OSError):
        while True:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        for descriptor in taken:
            os.close(descriptor)


async def test_a_program_without_descriptors_left_keeps_its_port_and_shares_it_later(port: Port) -> None:
    async with port.shared() as one:
        with connect(port_name(port.spec)), no_descriptors_left():
            await port.hears(one)
        async with port.shared() as two:
            await port.hears(one, two)


async def test_a_program_that_does_not_answer_keeps_its_port(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program was stopped: with two sockets, two programs would speak to one vehicle."""
    monkeypatch.setattr(hublink, "WELCOME_PATIENCE", 0.2)
    taken = take_name(port_name(port.spec))
    assert taken is not None
    with taken, pytest.raises(LinkClosed, match=f"process {os.getpid()} has this port and does not answer"):
        async with port.shared():
            pass


async def test_a_program_that_ends_while_it_is_asked_is_waited_for(port: Port) -> None:
    """A kill may hit the program between the question and the start of the hub."""

    async def end(name: socket.socket) -> None:
        for _ in range(2):
            (await next_caller(name)).close()
        name.close()
        await trio.sleep(0.02)
        old.close()

    name = take_name(port_name(port.spec))
    assert name is not None
    with name, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as old:
        old.bind((HOST, port.spec.port))
        async with trio.open_nursery() as nursery:
            nursery.start_soon(end, name)
            async with port.shared() as link:
                await port.hears(link)


async def test_the_hub_sends_from_the_port_from_which_the_first_program_sent() -> None:
    """PX4 answers only the first address that it heard."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind((HOST, 0))
        vehicle.setblocking(False)
        spec = parse_source(f"udpout:{HOST}:{vehicle.getsockname()[1]}")
        senders: list[Any] = []

        async def speak(link: Link, own: Address) -> None:
            beat = Framer(own, stream=False).encode_heartbeat(18)
            with trio.fail_after(60):
                while not senders or senders[-1][0] != beat:
                    link.send([beat])
                    await trio.sleep(0.02)
                    with suppress(BlockingIOError):
                        senders.append(vehicle.recvfrom(2048))

        async with open_shared(spec, PortRequest(US)) as one:
            await speak(one, US)
            async with open_shared(spec, PortRequest(US)) as two:
                assert two.seat is not None
                await speak(two, two.seat.own)
                await speak(one, US)
        assert len({address for _, address in senders}) == 1


async def test_a_port_that_another_kind_of_program_has_is_said_soon(port: Port) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, port.spec.port))
        with trio.fail_after(60), pytest.raises(LinkClosed, match="in use by another program"):
            async with port.shared():
                pass
