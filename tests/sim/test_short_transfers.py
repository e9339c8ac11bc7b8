"""How many round trips short work takes, on virtual time: what a person with a slow radio waits for."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World, read_file

RTT = 0.3
LONG = LinkSettings(delay=RTT / 2)
PROFILES = ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk"]
READY = 0.1
"""What a server may take beside the way: ArduPilot looks at its queue every 10 ms."""


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
async def test_a_long_fat_way_is_filled_by_doubling(profile: str, autojump_clock: MockClock) -> None:
    """Open, eight answers, then twice as many in each round trip; the last one comes back, too."""
    rate, size = 1e6, 400_000
    world = World(profile, LinkSettings(rate=rate, delay=RTT / 2, queue=int(rate / 2)))
    world.tree.add(b"/d/f", bytes(range(1, 251)) * (size // 250))
    async with world.connection() as connection:
        for _ in range(2):
            await connection.store.list_directory(b"/d")
        began = trio.current_time()
        assert len(await read_file(connection, b"/d/f")) == size
        assert trio.current_time() - began <= 8 * RTT + READY + size / rate * 266 / 239


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_directory_is_listed_in_two_round_trips(profile: str, autojump_clock: MockClock) -> None:
    """The names, and that there are no more of them: two requests."""
    world = World(profile, LONG)
    directory = ROOTS.get(profile, b"") + b"/d"
    for name in (b"a", b"b"):
        world.tree.add(directory + b"/" + name, name)
    async with world.connection() as connection:
        store = connection.store

        async def names() -> tuple[float, set[bytes]]:
            began = trio.current_time()
            listing = await store.list_directory(directory)
            return trio.current_time() - began, {entry.name for entry in listing.entries}

        await names()
        requests = connection.engine.stats.requests
        took, seen = await names()
        assert (took <= 2 * RTT + READY, seen) == (True, {b"a", b"b"})
        assert connection.engine.stats.requests == requests + 2
        await store.make_directory(directory + b"/c")
        await store.remove(directory + b"/a")
        await store.create_empty(directory + b"/e")
        await store.create_empty(directory + b"/f")
        took, seen = await names()
        assert (took <= 2 * RTT + READY, seen) == (True, {b"b", b"c", b"e", b"f"})
        if profile == "littlefs":  # which cannot rename
            return
        requests = connection.engine.stats.requests
        await store.rename(directory + b"/f", directory + b"/e2")  # it might have replaced a file
        await names()
        assert connection.engine.stats.requests == requests + 3
        world.tree.add(directory + b"/g", b"of somebody else")
        took, seen = await names()
        assert (took <= 2 * RTT + READY, seen) == (True, {b"b", b"c", b"e", b"e2", b"g"})
        assert (await names())[0] <= 2 * RTT + READY


FIRST_WINDOWS = {"px4": 8, "px4-nuttx": 1, "ardupilot": 4, "ardupilot5": 4, "littlefs": 4, "mavsdk": 8}
"""Writes that may go out before the first answer; a serial port, as of PX4 on NuttX, begins with one."""


@pytest.mark.parametrize(
    ("profile", "chunks"),
    [(profile, chunks) for profile, most in FIRST_WINDOWS.items() for chunks in sorted({1, most})],
)
async def test_a_small_file_is_written_and_proven_in_eight_round_trips(
    profile: str, chunks: int, autojump_clock: MockClock
) -> None:
    """CreateFile, its bytes and Terminate, size, CRC32, a look whether the name is free, and the rename; no
    matter how full the window is. The first two files also find out what the card can."""
    data = bytes(range(239)) * chunks
    world = World(profile, LONG)
    world.tree.add_directory(ROOTS.get(profile, b"") + b"/d")
    path = ROOTS.get(profile, b"") + b"/d/f"
    async with mounted(world, split(path)[0]) as (_, tree):
        for name in (b"1", b"2", b""):
            began = trio.current_time()
            file = await tree.create(path + name, exclusive=False)
            await file.write(0, data)
            await file.flush()
            took = trio.current_time() - began
            assert world.tree.data(path + name) == data
            await file.release()
        assert tree.status()["verified_by_crc"] == 3
    assert took <= 8 * RTT + READY
