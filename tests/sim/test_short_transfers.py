"""How many round trips short work takes, on virtual time: what a person with a slow radio waits for."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.worlds import World, read_file

RTT = 0.3
LONG = LinkSettings(delay=RTT / 2)
PROFILES = ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk"]
READY = 0.1
"""What a server may take beside the way: ArduPilot looks at its queue every 10 ms."""


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
async def test_a_long_fat_way_is_full_after_three_round_trips(
    profile: str, autojump_clock: MockClock
) -> None:
    """Open, eight answers, 64, and from then on as many as the way holds; the last one comes back, too."""
    rate, size = 1e6, 400_000
    world = World(profile, LinkSettings(rate=rate, delay=RTT / 2, queue=int(rate / 2)))
    world.tree.add(b"/d/f", bytes(range(1, 251)) * (size // 250))
    async with world.connection() as connection:
        for _ in range(2):
            await connection.store.list_directory(b"/d")
        began = trio.current_time()
        assert len(await read_file(connection, b"/d/f")) == size
        assert trio.current_time() - began <= 4 * RTT + READY + size / rate * 266 / 239
