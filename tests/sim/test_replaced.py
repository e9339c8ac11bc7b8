"""A file that is replaced while the vehicle restarts in mid-copy: one version or an error. Virtual time."""

from __future__ import annotations

import random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import FileChanged
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.takingturns import taking_turns
from tests.support.worlds import ROOTS, World

OLD = random.Random(1).randbytes(200_000)
NEW = random.Random(2).randbytes(260_000)
STEP = 16_384
UNTIMED = {"px4", "px4-nuttx", "ardupilot", "littlefs", "mavsdk-old"}


def mounted(connection: Connection) -> Tree:
    """Return what a mount has over a connection, told of restarts as it would be."""
    tree = Tree(connection.store, CacheOptions(), clock=trio.current_time, invalidate=lambda path: None)
    connection.subscribe(lambda news: tree.rebooted() if news == "reboot" else None)
    return tree


async def read_through(handle: OpenFile) -> bytes:
    """Read from the beginning to the end."""
    return b"".join([bytes(await handle.read(at, STEP)) for at in range(0, handle.size, STEP)])


async def copy(tree: Tree, path: bytes) -> bytes:
    """Open, read to the end and close, as cp does."""
    handle = await tree.open(path)
    try:
        return await read_through(handle)
    finally:
        handle.close()


@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk"])
async def test_the_end_of_a_copy_waits_for_the_news_of_a_reboot(profile: str, autojump: MockClock) -> None:
    """A vehicle may answer before it tells its boot time, and what is left may come in between."""
    here = World(profile, LinkSettings(rate=20_000.0, delay=0.02))
    path = ROOTS.get(profile, b"") + b"/big"
    here.tree.add(path, OLD, 1_700_000_000)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        tree = mounted(connection)
        await trio.sleep(10)
        handle = await tree.open(path)
        blocks = handle._version.blocks  # type: ignore[attr-defined]

        async def reboot() -> None:
            for _ in range(10_000):
                if sum(stop - start for start, stop in blocks.missing(0, handle.size)) <= 8_000:
                    break
                await trio.sleep(0.02)
            now = trio.current_time()
            here.vehicle.reboot(now, downtime=2.7)
            here.vehicle._next_beat = now + 4.2
            here.tree.add(path, NEW[: len(OLD)], 1_700_000_100)
            here.link.kick()

        nursery.start_soon(reboot)
        with pytest.raises(FileChanged):
            await read_through(handle)
        handle.close()
        assert connection.vehicle.reboots == 1


@pytest.mark.parametrize("unasked", [True, False])
@pytest.mark.parametrize("size", [0, 190_000, 200_000, 260_000])
@pytest.mark.parametrize("profile", taking_turns(PROFILES))
async def test_a_copy_over_a_reboot_is_of_one_version(
    profile: str, size: int, unasked: bool, autojump: MockClock
) -> None:
    """size: of the successor; 0 = the file stays. unasked: the vehicle tells its boot time so. Where listings
    tell no times, nothing but the size tells a successor."""
    if size == len(OLD) and profile in UNTIMED:
        return
    here = World(profile, LinkSettings(rate=20_000.0, delay=0.02))
    here.vehicle.tells_time = unasked
    here.vehicle.reboot(-5.0)
    path = ROOTS.get(profile, b"") + b"/big"
    here.tree.add(path, OLD, 1_700_000_000)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        tree = mounted(connection)
        await trio.sleep(10)  # a boot time has to go back by some seconds to tell of a restart

        async def reboot() -> None:
            await trio.sleep(4.5)
            here.vehicle.reboot(trio.current_time(), downtime=4.0)
            if size:
                here.tree.add(path, NEW[:size], 1_700_000_100)
            here.link.kick()

        nursery.start_soon(reboot)
        if size:
            with pytest.raises(FileChanged):
                await copy(tree, path)
        else:
            assert await copy(tree, path) == OLD
        assert connection.vehicle.reboots == 1
        assert await copy(tree, path) == (NEW[:size] or OLD)
