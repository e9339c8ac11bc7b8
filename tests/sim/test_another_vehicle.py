"""Another vehicle with the same address takes the first one's place: nothing of one reaches the other."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.compose import subscribe
from mavftpfs.shared.errors import MavftpfsError, VehicleLost
from mavftpfs.sim.linkmodel import Direction, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.fake_store import read_file
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World

pytestmark = pytest.mark.holds("fault another vehicle")

SLOW = LinkSettings(rate=20_000.0, delay=0.02, loss=0.05)
OURS = random.Random(1).randbytes(60_000)
THEIRS = random.Random(2).randbytes(60_000)
NEW = random.Random(3).randbytes(60_000)


class Scene:
    """A mount of a vehicle that has a file. other: a vehicle of the same kind, with a file of that name."""

    def __init__(self, profile: str, settings: LinkSettings = SLOW) -> None:
        self.world = World(profile, settings)
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.file = self.root + b"/f"
        self.world.tree.add(self.file, OURS)
        self.ours = self.world.vehicle
        tree = MemoryTree()
        tree.add(self.file, THEIRS)
        self.other = SimVehicle(tree, PROFILES[profile], rng=random.Random(99))

    @asynccontextmanager
    async def mounted(self) -> AsyncIterator[Tree]:
        """Give a tree that hears the news as a mount does."""
        async with mounted(self.world) as (connection, tree):
            subscribe(connection, tree)
            await trio.sleep(3.0)  # it told who it is
            yield tree


async def swap(world: World, vehicle: SimVehicle, *, gap: float) -> None:
    """One is switched off, `gap` seconds later the other is there."""
    world.link.cut()
    await trio.sleep(gap)
    world.link.vehicle = vehicle
    vehicle.server.firmware.tx_room = lambda: world.model.room(Direction.TO_CLIENT)
    world.link.restore()


@pytest.mark.parametrize("gap", [3.0, 40.0])
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot"])
async def test_what_is_held_for_one_is_not_written_to_the_other(
    profile: str, gap: float, autojump: MockClock
) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        await tree.list(scene.root)
        file = await tree.open(scene.file, write=True, truncate=True)
        await file.write(0, NEW)
        async with trio.open_nursery() as nursery:

            async def close() -> None:
                with pytest.raises(MavftpfsError):
                    await file.release()

            nursery.start_soon(close)
            await trio.sleep(1.0)
            await swap(scene.world, scene.other, gap=gap)
        await trio.sleep(100.0)
        assert scene.other.server.requests.total() == 0
        assert tree.undelivered() == [scene.file]
        again = await tree.open(scene.file, write=True)
        with pytest.raises(VehicleLost, match="another vehicle answers"):
            await again.fsync()
        again.close()
        await swap(scene.world, scene.ours, gap=4.0)
        await trio.sleep(100.0)
        assert tree.undelivered() == []
        assert scene.world.tree.data(scene.file) == NEW


@pytest.mark.parametrize("profile", ["px4", "px4-2026", "ardupilot"])
async def test_no_file_is_read_half_from_each(profile: str, autojump: MockClock) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        file = await tree.open(scene.file)
        head = bytes(await file.read(0, 10_000))
        await swap(scene.world, scene.other, gap=4.0)
        with pytest.raises(MavftpfsError):
            await file.read(30_000, 30_000)
        assert scene.other.server.requests.total() == 0
        await swap(scene.world, scene.ours, gap=4.0)
        await trio.sleep(5.0)
        file.close()
        assert head == OURS[:10_000]
        assert await read_file(tree, scene.file) == OURS


async def test_the_same_vehicle_goes_on_after_a_silence(autojump: MockClock) -> None:
    scene = Scene("px4")
    async with scene.mounted() as tree:
        file = await tree.open(scene.file)
        await swap(scene.world, scene.world.vehicle, gap=4.0)
        assert bytes(await file.read(0, len(OURS))) == OURS
        file.close()


@pytest.mark.parametrize("tells", ["never", "once"])
async def test_a_vehicle_that_does_not_tell_who_it_is_is_believed(
    tells: str, autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later, if it told once: it was asked for seconds."""
    scene = Scene("px4", LinkSettings(delay=0.02))
    silent = scene.world.vehicle.framer.encode_heartbeat(2, 12)
    if tells == "never":
        monkeypatch.setattr(scene.world.vehicle, "_version", lambda: silent)
    async with scene.mounted() as tree:
        monkeypatch.setattr(scene.world.vehicle, "_version", lambda: silent)
        await swap(scene.world, scene.world.vehicle, gap=4.0)
        start = trio.current_time()
        assert await read_file(tree, scene.file) == OURS
        assert (trio.current_time() - start > 5.0) == (tells == "once")


async def test_a_vehicle_that_is_seldom_heard_and_told_once_is_believed(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two heartbeats another one could have come, each time."""
    scene = Scene("px4", LinkSettings(delay=0.02))
    async with scene.mounted() as tree:
        monkeypatch.setattr(scene.ours, "_on_command", lambda command, now: None)
        monkeypatch.setattr("mavftpfs.sim.vehicle.HEARTBEAT_PERIOD", 4.0)
        await trio.sleep(120.0)
        start = trio.current_time()
        for _ in range(10):
            assert await read_file(tree, scene.file) == OURS
            await trio.sleep(5.0)
        assert trio.current_time() - start < 120.0


async def test_ours_is_known_again_though_nobody_was_silent(autojump: MockClock) -> None:
    """A ground station asked the other one, which is switched on as ours is switched off."""
    scene = Scene("px4", LinkSettings(delay=0.02))
    async with scene.mounted() as tree:
        await swap(scene.world, scene.other, gap=0.5)
        scene.world.model.push(Direction.TO_CLIENT, scene.other._version(), trio.current_time())
        await trio.sleep(2.0)
        with pytest.raises(VehicleLost, match="another vehicle answers"):
            await tree.open(scene.file)
        await swap(scene.world, scene.ours, gap=0.5)
        await trio.sleep(10.0)
        assert await read_file(tree, scene.file) == OURS


async def test_a_vehicle_that_is_gone_again_is_seldom_asked(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A radio at the edge of its range: it was heard for a moment, and did not answer."""
    scene = Scene("px4", LinkSettings(delay=0.02))
    link = scene.world.link
    async with scene.mounted():
        monkeypatch.setattr(scene.ours, "_on_command", lambda command, now: None)
        await swap(scene.world, scene.ours, gap=4.0)
        await trio.sleep(1.5)
        link.cut()
        await trio.sleep(10.0)
        sent = link.stats.sent_chunks
        await trio.sleep(100.0)
        assert link.stats.sent_chunks - sent <= 170, "100 of them are heartbeats"
