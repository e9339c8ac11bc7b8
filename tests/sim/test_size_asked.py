"""How the size of what was written is asked for at its close: without others' uploads and old listings."""

from __future__ import annotations

from collections import Counter

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.cache.verify import LARGE_LISTING, SMALL_LISTING
from mavftpfs.protocol.payload import Opcode
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.mounting import mounted
from tests.support.worlds import content, path, world

LINK = LinkSettings(rate=20_000.0, delay=0.01, queue=8000)
LISTINGS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)


async def write(tree: Tree, target: bytes, data: bytes) -> None:
    file = await tree.create(target, exclusive=True)
    await file.write(0, data)
    await file.flush()
    await file.release()


@pytest.mark.parametrize("names", [0, 2 * SMALL_LISTING, 2 * LARGE_LISTING])
async def test_a_file_is_closed_while_another_is_written_that_cannot_be_interrupted(
    names: int, autojump: MockClock
) -> None:
    """It was opened for its size, which waits for the whole of the other upload: close failed after 30 s.
    Who is second waits for the whole of the first."""
    vehicle = world("mavsdk", LINK, **{f"old{number}": b"x" for number in range(names)})
    short, long = content(200_000, 1), content(1_500_000, 2)
    async with mounted(vehicle, b"/d", verify="size") as (_, tree), trio.open_nursery() as nursery:
        nursery.start_soon(write, tree, b"/d/short", short)
        await trio.sleep(1.0)
        await write(tree, b"/d/long", long)
    assert vehicle.tree.data(b"/d/short") == short
    assert vehicle.tree.data(b"/d/long") == long


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
async def test_after_a_long_upload_its_path_is_not_walked_again(profile: str, autojump: MockClock) -> None:
    """Four listings, one after the other, where one open tells the size: 1.2 s at 300 ms."""
    vehicle = world(profile, LINK)
    data = content(100_000)
    async with mounted(vehicle, path(profile, "")[:-1], verify="size", dir_timeout=1.0) as (session, tree):
        before = Counter(session.engine.stats.by_opcode)
        await write(tree, path(profile, "new"), data)
        asked = Counter(session.engine.stats.by_opcode) - before
    assert sum(asked[opcode] for opcode in LISTINGS) == 0
    assert asked[Opcode.OPEN_FILE_RO] == 1
    assert vehicle.tree.data(path(profile, "new")) == data


@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5", "mavsdk"])
async def test_files_written_at_once_do_not_list_a_large_directory_each(
    profile: str, autojump: MockClock
) -> None:
    """50 beside 250 others (PX4 on NuttX): each had all of them listed, 0.6 s, and the last ones failed."""
    files = 30
    old = {f"old{number}": b"x" for number in range(2 * LARGE_LISTING)}
    vehicle = world(profile, LinkSettings(rate=1e6, delay=0.001, queue=100_000), **old)
    async with mounted(vehicle, path(profile, "")[:-1], verify="size") as (session, tree):
        before = Counter(session.engine.stats.by_opcode)
        async with trio.open_nursery() as nursery:
            for number in range(files):
                nursery.start_soon(write, tree, path(profile, f"new{number}"), content(500, number))
        asked = Counter(session.engine.stats.by_opcode) - before
    for number in range(files):
        assert vehicle.tree.data(path(profile, f"new{number}")) == content(500, number)
    assert asked[Opcode.OPEN_FILE_RO] >= files or profile == "mavsdk"
    # PX4 on NuttX has the storage's root listed after a path operation between two writes.
    assert sum(asked[opcode] for opcode in LISTINGS) < (2 * files if profile != "mavsdk" else 20 * files)
