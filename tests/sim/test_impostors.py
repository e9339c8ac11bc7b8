"""Another sender claims to be the vehicle, or takes its place: no bytes of one reach the other."""

from __future__ import annotations

import logging
import random
import socket
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Address
from mavftpfs.link.opening import open_link
from mavftpfs.link.udp import UdpLink
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.session.connection import Connection, ConnectOptions, connected
from mavftpfs.session.vehicle import Standing
from mavftpfs.shared.errors import MavftpfsError, VehicleLost
from mavftpfs.sim import vehicle as sim_vehicle
from mavftpfs.sim.linkmodel import Direction, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Family
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.lying import CrowdedLink, LyingVehicle, ftp, heartbeat
from tests.support.replies import ack
from tests.support.rigs import Rig
from tests.support.rigs import read_file as read_through
from tests.support.transfers import content, read_file
from tests.support.vehicles import HOST, free_udp_port

HERE = ("10.0.0.1", 14550)
THERE = ("10.0.0.2", 14550)
OURS = content(20_000, 1)
THEIRS = content(20_000, 2)


class Crowd:
    """A vehicle at HERE: this component of it (1: the autopilot). other: another vehicle with such a file."""

    def __init__(self, profile: str = "px4", component: int = 1) -> None:
        self.rig = Rig(profile, {b"/f": OURS}, LinkSettings(delay=0.02))
        self.rig.vehicle = self.ours = SimVehicle(
            self.rig.card, PROFILES[profile], rng=random.Random(1), address=Address(1, component)
        )
        self.rig.link = self.link = CrowdedLink(self.ours, self.rig.model, HERE)
        tree = MemoryTree()
        tree.add(b"/f", THEIRS)
        self.other = SimVehicle(tree, PROFILES["px4"], rng=random.Random(99))

    def move(self, vehicle: SimVehicle, address: tuple[str, int]) -> None:
        """From now on this vehicle speaks, and from this address."""
        self.link.vehicle = vehicle
        self.link.address = address
        self.link.kick()

    async def beat(self, address: tuple[str, int] | None, pause: float = 0.1, armed: bool = False) -> None:
        """Send heartbeats in the autopilot's name, for ever. address: None for where the vehicle is then."""
        while True:
            self.link.intrude(address or self.link.address, heartbeat(armed=armed))
            await trio.sleep(pause)


async def told(connection: Connection) -> None:
    """Wait until the vehicle has told its id."""
    await trio.sleep(5.0)
    assert connection.vehicle.version is not None


@pytest.mark.holds("promise 10")
async def test_heartbeats_from_elsewhere_do_not_move_the_vehicle(caplog: pytest.LogCaptureFixture) -> None:
    scene = Crowd()
    async with scene.rig.connected() as connection, trio.open_nursery() as nursery:
        await told(connection)
        nursery.start_soon(scene.beat, THERE)
        for _ in range(10):
            assert await read_file(connection, b"/f") == OURS
            await trio.sleep(1.0)
        assert connection.status()["link"]["address"] == "10.0.0.1:14550"
        assert connection.status()["link"]["second"] == "10.0.0.2:14550"
        nursery.cancel_scope.cancel()
    assert [line for line in caplog.messages if "10.0.0.2:14550" in line] == [
        "10.0.0.2:14550 says that it is 1/1, too: ignored as long as the vehicle is heard where it was; "
        "if these are two vehicles, and not frames that a router sends back, give each a system id of its own"
    ]


@pytest.mark.holds("promise 10")
async def test_a_vehicle_whose_address_changes_is_found_again(caplog: pytest.LogCaptureFixture) -> None:
    scene = Crowd()
    async with scene.rig.connected() as connection:
        await told(connection)
        assert await read_file(connection, b"/f") == OURS
        scene.move(scene.ours, THERE)
        await trio.sleep(10.0)
        assert await read_file(connection, b"/f") == OURS
        assert connection.status()["link"]["address"] == "10.0.0.2:14550"
        assert not connection.vehicle.lost(trio.current_time())
    assert [line for line in caplog.messages if "10.0.0.2:14550" in line] == [
        "the vehicle is silent at 10.0.0.1:14550; its id is asked for at 10.0.0.2:14550"
    ]


@pytest.mark.holds("promise 10")
@pytest.mark.parametrize("tells", [True, False])
async def test_another_vehicle_that_takes_the_address_is_not_read(
    tells: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle that tells no id is another one, too, because the mounted one told its own."""
    scene = Crowd()
    if not tells:
        monkeypatch.setattr(scene.other, "_on_command", lambda command, now: None)
    async with scene.rig.connected() as connection, trio.open_nursery() as nursery:
        await told(connection)
        scene.move(scene.other, THERE)
        await trio.sleep(60.0)
        with pytest.raises(VehicleLost, match="another vehicle answers"):
            await read_file(connection, b"/f")
        assert scene.other.server.requests.total() == 0
        nursery.start_soon(scene.beat, THERE)  # it stays
        scene.move(scene.ours, HERE)
        await trio.sleep(5.0)
        assert await read_file(connection, b"/f") == OURS
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 10")
async def test_two_links_to_one_vehicle_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    scene = Crowd()
    scene.link.mirrors = [THERE]
    async with scene.rig.connected() as connection:
        for _ in range(5):
            assert await read_file(connection, b"/f") == OURS
            await trio.sleep(3.0)
        assert connection.status()["link"]["address"] == "10.0.0.1:14550"
        scene.link.address, scene.link.mirrors = THERE, []  # one of them ends
        await trio.sleep(10.0)
        assert await read_file(connection, b"/f") == OURS
    assert connection.vehicle.reboots == 0


@pytest.mark.holds("promise 10")
async def test_a_companion_has_an_address_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Our target is not the autopilot, whose heartbeats come from elsewhere and say whether it is armed."""
    monkeypatch.setitem(sim_vehicle._AUTOPILOT_TYPE, Family.MAVSDK, MAV_AUTOPILOT_INVALID)
    scene = Crowd("mavsdk", component=191)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(scene.beat, THERE, 1.0, True)
        async with scene.rig.connected(ConnectOptions(target_component=191)) as connection:
            await trio.sleep(2.0)
            assert await read_file(connection, b"/f") == OURS
            assert connection.vehicle.identity.standing is Standing.TRUSTED
            assert connection.vehicle.armed
            await trio.sleep(10.0)
            assert await read_file(connection, b"/f") == OURS
            assert connection.status()["link"]["address"] == "10.0.0.1:14550"
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 10")
async def test_a_vehicle_of_a_large_swarm_has_an_address_too() -> None:
    """It is heard after 500 others; the one that spoke last is another one."""
    scene = Crowd()
    others = [Address(system, component) for system in range(2, 252) for component in (1, 154)]
    for other in others:
        scene.link.intrude(THERE, heartbeat(other))
    options = ConnectOptions(target_system=1)
    async with scene.rig.connected(options) as connection, trio.open_nursery() as nursery:
        nursery.start_soon(scene.beat, THERE)
        assert await read_file(connection, b"/f") == OURS
        assert connection.status()["link"]["address"] == "10.0.0.1:14550"
        nursery.cancel_scope.cancel()


def forge(request: Payload) -> bytes:
    """Return the ACK of a read with everything right but the bytes."""
    return ftp(ack(request, b"\xee" * request.size).encode(), Address(254, 191))


@pytest.mark.real_time
@pytest.mark.holds("promise 10")
@pytest.mark.parametrize("kind", ["udpin", "udpout", "tcpin"])
async def test_a_forged_reply_from_another_socket_is_not_believed(kind: str) -> None:
    """Each read is answered by the forger first. kind: our end of the link."""
    tree = MemoryTree()
    tree.add(b"/f", OURS)
    ends = {"udpin": "udpout", "udpout": "udpin", "tcpin": "tcp"}
    port = free_udp_port()
    stream = kind == "tcpin"
    with (
        LyingVehicle(tree, f"{ends[kind]}:{HOST}:{port}") as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM) as forger,
    ):
        async with (
            open_link(parse_source(f"{kind}:{HOST}:{port}")) as link,
            connected(link, ConnectOptions()) as made,
        ):
            await made.ready(30.0)
            assert await read_file(made, b"/f") == OURS
            if isinstance(link, UdpLink):
                port = parse_source(link.description).port
            forger.connect((HOST, port))
            vehicle.server.change = forging(forger.send)
            for _ in range(20):
                assert await read_file(made, b"/f") == OURS


def forging(send: Callable[[bytes], object]) -> Callable[[Payload, Payload], Iterable[Payload]]:
    """Return a hook that sends a forged reply to each read before the true one."""

    def change(request: Payload, reply: Payload) -> Iterable[Payload]:
        if request.opcode == Opcode.READ_FILE:
            send(heartbeat() + forge(request))
        return [reply]

    return change


# --- another vehicle with the same address

SLOW = LinkSettings(rate=20_000.0, delay=0.02, loss=0.05)
FILE = b"/d/f"
OUR_FILE = content(60_000, 1)
THEIR_FILE = content(60_000, 2)
NEW = content(60_000, 3)


class Scene:
    """A mount of a vehicle that has a file. other: a vehicle of the same kind, with a file of that name."""

    def __init__(self, profile: str, settings: LinkSettings = SLOW) -> None:
        self.rig = Rig(profile, {FILE: OUR_FILE}, settings)
        self.ours = self.rig.vehicle
        tree = MemoryTree()
        tree.add(self.rig.root + FILE, THEIR_FILE)
        self.other = SimVehicle(tree, PROFILES[profile], rng=random.Random(99))

    @asynccontextmanager
    async def mounted(self) -> AsyncIterator[Tree]:
        """Give a tree that hears the news as a mount does."""
        async with self.rig.mounted() as tree:
            await trio.sleep(3.0)  # it told its id
            yield tree


async def swap(here: Rig, vehicle: SimVehicle, *, gap: float) -> None:
    """One is switched off, `gap` seconds later the other is there."""
    here.link.cut()
    await trio.sleep(gap)
    here.link.vehicle = vehicle
    vehicle.server.firmware.tx_room = lambda: here.model.room(Direction.TO_CLIENT)
    here.link.restore()


@pytest.mark.holds("fault another vehicle")
@pytest.mark.parametrize("gap", [3.0, 40.0])
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot"])
async def test_what_is_held_for_one_is_not_written_to_the_other(profile: str, gap: float) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        await tree.list(b"/d")
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, NEW)
        async with trio.open_nursery() as nursery:

            async def close() -> None:
                with pytest.raises(MavftpfsError):
                    await file.release()

            nursery.start_soon(close)
            await trio.sleep(1.0)
            await swap(scene.rig, scene.other, gap=gap)
        await trio.sleep(100.0)
        assert scene.other.server.requests.total() == 0
        assert tree.undelivered() == [FILE]
        again = await tree.open(FILE, write=True)
        with pytest.raises(VehicleLost, match="another vehicle answers"):
            await again.fsync()
        again.close()
        await swap(scene.rig, scene.ours, gap=4.0)
        await trio.sleep(100.0)
        assert tree.undelivered() == []
        assert scene.rig.data(FILE) == NEW


@pytest.mark.holds("fault another vehicle")
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "ardupilot"])
async def test_no_file_is_read_half_from_each(profile: str) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        file = await tree.open(FILE)
        head = bytes(await file.read(0, 10_000))
        await swap(scene.rig, scene.other, gap=4.0)
        with pytest.raises(MavftpfsError):
            await file.read(30_000, 30_000)
        assert scene.other.server.requests.total() == 0
        await swap(scene.rig, scene.ours, gap=4.0)
        await trio.sleep(5.0)
        file.close()
        assert head == OUR_FILE[:10_000]
        assert await read_through(tree, FILE) == OUR_FILE


@pytest.mark.holds("fault another vehicle")
async def test_ours_is_known_again_though_nobody_was_silent(caplog: pytest.LogCaptureFixture) -> None:
    """A ground station asked the other one, which is switched on as ours is switched off."""
    caplog.set_level(logging.INFO)
    scene = Scene("px4", LinkSettings(delay=0.02))
    async with scene.mounted() as tree:
        await swap(scene.rig, scene.other, gap=0.5)
        scene.rig.model.push(Direction.TO_CLIENT, scene.other._version(), trio.current_time())
        await trio.sleep(2.0)
        with pytest.raises(VehicleLost, match="another vehicle answers"):
            await tree.open(FILE)
        await swap(scene.rig, scene.ours, gap=0.5)
        await trio.sleep(10.0)
        assert await read_through(tree, FILE) == OUR_FILE
    assert len([line for line in caplog.messages if "another vehicle" in line]) == 1


@pytest.mark.holds("fault another vehicle")
async def test_one_heartbeat_between_two_silences_makes_nobody_another_vehicle(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It had no time to tell its id."""
    scene = Crowd()
    async with scene.rig.connected() as connection:
        await told(connection)
        scene.link.cut()
        await trio.sleep(10.0)
        scene.link.intrude(HERE, heartbeat())
        await trio.sleep(60.0)
        assert connection.status()["link"]["state"] == "lost"
        scene.link.restore()
        await trio.sleep(5.0)
        assert await read_file(connection, b"/f") == OURS
        assert connection.vehicle.reboots == 0
    assert caplog.messages == []


@pytest.mark.holds("promise 10")
async def test_a_target_without_heartbeats_moves_with_its_autopilot(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Crowd("mavsdk", component=191)
    monkeypatch.setattr(
        scene.ours, "_beat", lambda frames, now: scene.ours.__setattr__("_next_beat", now + 1)
    )
    async with trio.open_nursery() as nursery:
        nursery.start_soon(scene.beat, None, 1.0)
        async with scene.rig.connected(ConnectOptions(target_component=191)) as connection:
            assert await read_file(connection, b"/f") == OURS
            scene.link.address = THERE
            await trio.sleep(20.0)
            assert await read_file(connection, b"/f") == OURS
            assert connection.status()["link"]["address"] == "10.0.0.2:14550"
        nursery.cancel_scope.cancel()
