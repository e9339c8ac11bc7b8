"""Files over links that lose every full frame, on virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.chunking import SHORT, SHORT_SECONDS
from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.uploads import put
from tests.support.worlds import content, path, read_file, world

pytestmark = pytest.mark.holds("fault long frames")

RADIO = LinkSettings(rate=5760.0, delay=0.05, queue=8192)
PROFILES = ["px4", "ardupilot", "mavsdk", "px4-nuttx"]
LIMIT = 150
"""Bytes of the longest frame that passes: more than one with a short chunk has."""


def sizes(connection: Connection) -> tuple[int, int]:
    """Return the chunk sizes of reads and of writes."""
    return connection.scheduler.read_chunks.size, connection.scheduler.write_chunks.size


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_read_where_no_full_frame_passes(profile: str, autojump: MockClock) -> None:
    data = content(50_000)
    here = world(profile, replace(RADIO, mtu=LIMIT), file=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection) == (SHORT, MAX_DATA)


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_written_where_no_full_frame_passes(profile: str, autojump: MockClock) -> None:
    data = content(50_000)
    here = world(profile, RADIO)
    async with here.connection() as connection:
        here.model.settings = replace(RADIO, mtu=LIMIT)
        await put(connection, path(profile, "new"), data)
        assert here.tree.data(path(profile, "new")) == data
        assert sizes(connection)[1] == SHORT
    assert here.vehicle.server.open_sessions == 0


async def test_a_file_of_one_chunk_passes_too(autojump: MockClock) -> None:
    here = world("px4", replace(RADIO, mtu=LIMIT), small=content(200))
    async with here.connection() as connection:
        assert await read_file(connection, path("px4", "small")) == content(200)
        await put(connection, path("px4", "new"), content(200))
    assert here.tree.data(path("px4", "new")) == content(200)


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_link_that_recovers_gets_full_chunks_back(profile: str, autojump: MockClock) -> None:
    data = content(20_000)
    here = world(profile, replace(RADIO, mtu=LIMIT), file=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] == SHORT
        here.model.settings = RADIO
        await trio.sleep(SHORT_SECONDS)
        requests = connection.engine.stats.requests
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] == MAX_DATA
        assert connection.engine.stats.requests - requests < 20_000 / MAX_DATA + 8


async def take_both_ways(profile: str, settings: LinkSettings, options: ConnectOptions) -> object:
    """Read and write a file; return what that cost."""
    data = content(100_000)
    here = world(profile, settings, file=data)
    async with here.connection(options) as connection:
        assert await read_file(connection, path(profile, "file")) == data
        await put(connection, path(profile, "new"), data)
        return trio.current_time(), dict(connection.engine.stats.by_opcode)


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
def test_losses_of_a_fifth_change_nothing(profile: str) -> None:
    """The same requests go out as with chunk=239, and it takes as long."""
    settings = replace(RADIO, loss=0.2)
    costs = [
        trio.run(take_both_ways, profile, settings, options, clock=MockClock(autojump_threshold=0))
        for options in (ConnectOptions(), ConnectOptions(chunk=MAX_DATA))
    ]
    assert costs[0] == costs[1]
