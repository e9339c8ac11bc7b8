"""A connection: which senders are answered, signing, neighbours with our address, leaving."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from itertools import pairwise
from pathlib import Path

import pytest
import trio

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.client import connect as compose
from mavftpfs.client.several import ON_COMMAND_LINE, unnamed_by
from mavftpfs.link.framing import MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, MAV_CMD_REQUEST_MESSAGE, Framer
from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_TYPE_GCS,
    MAV_TYPE_ONBOARD_CONTROLLER,
    Address,
    CommandLong,
    Heartbeat,
)
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions, connected
from mavftpfs.shared.errors import VehicleLost
from mavftpfs.shared.options import Options
from mavftpfs.sim.linkmodel import Duplex, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.memory import MemoryLink
from tests.support.rigs import Rig
from tests.support.transfers import content, path, put, read_file

KEY = bytes(range(32))
DATA = content(30_000, 5)


@pytest.mark.holds("promise 10", "rule 14.37")
async def test_signing_both_ways() -> None:
    tree = MemoryTree()
    tree.add(b"/f", DATA)
    vehicle = SimVehicle(tree, PROFILES["px4"], rng=random.Random(1), signing_key=KEY)
    link = MemoryLink(vehicle, LinkModel(random.Random(2), LinkSettings(delay=0.01, loss=0.05)))
    async with connected(link, ConnectOptions(key=KEY), rng=random.Random(3)) as connection:
        await connection.ready(10)
        # A vehicle without a clock is refused until it has heard the time in our frames.
        assert await read_file(connection, b"/f") == DATA
        refused = connection.driver.framer.stats.bad_signature
        assert refused < 10
        assert await read_file(connection, b"/f") == DATA
        assert connection.driver.framer.stats.bad_signature == refused
    # Restarted, we must not begin with older timestamps than the vehicle heard from us.
    async with connected(link, ConnectOptions(key=KEY), rng=random.Random(4)) as connection:
        await connection.ready(10)
        assert await read_file(connection, b"/f") == DATA
    async with connected(link, ConnectOptions(key=bytes(32)), rng=random.Random(5)) as connection:
        with pytest.raises(VehicleLost, match="bad signature; check signing_key"):
            await connection.ready(5)


class OldFirmware(SimVehicle):
    """Knows no MAV_CMD_REQUEST_MESSAGE."""

    asked: list[int]

    def _on_command(self, command: CommandLong, now: float) -> None:
        self.asked = [*getattr(self, "asked", []), command.command]
        if command.command != MAV_CMD_REQUEST_MESSAGE:
            super()._on_command(command, now)


US = Address(254, 191)


class Diary(dict[Address, Heartbeat]):
    """The last heartbeats that a vehicle heard, and when it heard the client."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def __setitem__(self, source: Address, heartbeat: Heartbeat) -> None:
        if source == US:
            self.times.append(trio.current_time())
        super().__setitem__(source, heartbeat)


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot", "mavsdk"])
@pytest.mark.parametrize("what", ["window", "burst", "write"])
async def test_heartbeats_go_out_beside_a_copy(what: str, profile: str) -> None:
    """A radio that cannot do both at a time, with a short queue: what we send must not starve them."""
    radio = LinkSettings(rate=5760.0, duplex=Duplex.HALF, queue=4096, delay=0.05)
    here = Rig(profile, {b"/d/f": DATA * 2}, radio)
    here.vehicle.heard = diary = Diary()
    options = ConnectOptions(read_mode="burst" if what == "burst" else "window")
    async with here.connected(options) as connection:
        began = trio.current_time()
        if what == "write":
            await put(connection, path(profile, "new"), DATA * 2)
        else:
            assert await read_file(connection, path(profile, "f")) == DATA * 2
        took = trio.current_time() - began
    heard = [time for time in diary.times if began <= time <= began + took]
    assert len(heard) >= took - 2
    assert max(later - time for time, later in pairwise(heard)) < 2.5


async def test_old_firmware_is_asked_for_its_capabilities_in_the_old_way() -> None:
    vehicle = OldFirmware(MemoryTree(), PROFILES["px4"], rng=random.Random(1))
    link = MemoryLink(vehicle, LinkModel(random.Random(2), LinkSettings(delay=0.01)))
    async with connected(link, ConnectOptions(), rng=random.Random(3)) as connection:
        await connection.ready(10)
        await trio.sleep(3)
        assert MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES not in vehicle.asked
        await trio.sleep(10)
        assert connection.vehicle.ftp_flag is True
        assert vehicle.asked.count(MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES) == 1


@pytest.mark.holds("promise 6")
async def test_what_we_say_we_are() -> None:
    """A ground station's heartbeat would feed the autopilot's failsafe, and trigger it later (promise 6)."""
    here = Rig("px4", {b"/f": DATA})
    async with here.connected() as connection:
        await trio.sleep(3)
        ours = Heartbeat(US, MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID, armed=False)
        assert here.vehicle.heard == {US: ours}
        assert await read_file(connection, b"/f") == DATA


@pytest.mark.holds("promise 6")
async def test_a_neighbour_with_our_address_makes_us_move() -> None:
    here = Rig("ardupilot", {b"/f": DATA}, LinkSettings(delay=0.01))
    async with here.connected() as connection:
        own = connection.vehicle.own
        neighbour = Framer(own, stream=False).encode_heartbeat(18, MAV_AUTOPILOT_INVALID)
        for message in connection.driver.framer.feed(neighbour):
            connection.vehicle.on_message(message, trio.current_time())
        assert connection.vehicle.own != own
        assert connection.vehicle.own.system == own.system
        assert await read_file(connection, b"/f") == DATA


# --- leaving


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("heard", [False, True])
async def test_leaving_waits_for_the_session_while_the_vehicle_is_heard(heard: bool) -> None:
    here = Rig("px4", {b"/f": DATA})
    async with here.connected():
        file = await here.mount().open(b"/f")
        await file.read(0, 1000)
        here.faults.ignore(Opcode.TERMINATE_SESSION)
        if not heard:
            here.link.cut()
            await trio.sleep(3.0)
        left_at = trio.current_time()
    assert trio.current_time() - left_at == pytest.approx(5.0 if heard else 1.0, abs=0.1)


def join(monkeypatch: pytest.MonkeyPatch, here: Rig, folder: Path) -> None:
    """Make all that opens a link, or a spool, get these."""

    @asynccontextmanager
    async def open_link(*_: object) -> AsyncIterator[MemoryLink]:
        yield here.link

    monkeypatch.setattr(compose, "open_shared", open_link)
    monkeypatch.setattr(compose, "spool_for", lambda _: closing(SpoolDirectory(folder / "spool")))


async def test_a_restart_while_leaving_has_nothing_delivered(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = Rig("ardupilot", {b"/d/f": content(100)})
    join(monkeypatch, here, tmp_path)
    async with compose.attached(parse_source("udpin:127.0.0.1:1"), Options(), writing=True) as up:
        await trio.sleep(60.0)
        file = await up.tree.open(b"/d/f", write=True)
        await file.write(0, b"changed")
        assert bytes(await file.read(50, 10)) == content(100)[50:60]
        assert up.connection.scheduler.server.opened is not None

        def restart() -> None:
            here.faults.ignore(Opcode.TERMINATE_SESSION)
            here.vehicle.reboot(trio.current_time(), 1.0)

        here.faults.at(Opcode.TERMINATE_SESSION, restart)
    assert up.connection.vehicle.reboots == 1
    assert up.tree.undelivered() == [b"/d/f"]
    assert here.card.data(b"/d/f") == content(100)


async def test_a_vehicle_whose_clock_is_behind_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """The vehicle has the right key, and does not adopt the client's time."""
    vehicle = SimVehicle(MemoryTree(), PROFILES["px4"], rng=random.Random(1), signing_key=KEY)
    monkeypatch.setattr(vehicle, "receive", lambda data, now: None)
    link = MemoryLink(vehicle, LinkModel(random.Random(2), LinkSettings(delay=0.01)))
    async with connected(link, ConnectOptions(key=KEY), rng=random.Random(3)) as connection:
        with pytest.raises(VehicleLost, match="compare the clocks"):
            await connection.ready(5)


@pytest.mark.parametrize("target", [0, 1])
async def test_another_vehicle_that_is_heard_is_said(target: int) -> None:
    options = Options(target_system=target)
    async with Rig("px4", {b"/d": None}).connected() as connection:
        unnamed = unnamed_by(connection, options)
        assert (unnamed is None) is bool(target)
        if unnamed is None:
            return
        assert unnamed.note(ON_COMMAND_LINE) == ""
        other, station = Address(2, 1), Address(255, 190)
        heard = connection.vehicle.heard
        heard[other] = Heartbeat(other, 2, 3, armed=False)
        heard[station] = Heartbeat(station, MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, armed=False)
        said = unnamed.note(ON_COMMAND_LINE)
        assert said.startswith("this is vehicle 1, which was heard first on ")
        assert said.endswith(
            "also heard: 2/1 (ArduPilot quadrotor, disarmed); to choose one, use -o target_system=2"
        )
