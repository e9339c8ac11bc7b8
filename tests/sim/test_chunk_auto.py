"""Files over links that lose every full frame, on virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import trio

from mavftpfs.protocol.chunking import SHORT, SHORT_SECONDS
from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig
from tests.support.transfers import content, path, put, read_file

pytestmark = pytest.mark.holds("fault long frames")

RADIO = LinkSettings(rate=5760.0, delay=0.05, queue=8192)
PROFILES = ["px4", "ardupilot", "mavsdk", "px4-nuttx"]
LIMIT = 150
"""Bytes of the longest frame that passes: more than one with a short chunk has."""


def sizes(connection: Connection) -> tuple[int, int]:
    """Return the chunk sizes of reads and of writes."""
    return connection.scheduler.read_chunks.size, connection.scheduler.write_chunks.size


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_written_where_no_full_frame_passes(profile: str) -> None:
    data = content(50_000)
    here = Rig(profile, {b"/d": None}, RADIO)
    async with here.connected() as connection:
        here.model.settings = replace(RADIO, mtu=LIMIT)
        await put(connection, path(profile, "new"), data)
        assert here.data(b"/d/new") == data
        assert sizes(connection)[1] == SHORT
    assert here.server.open_sessions == 0


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_read_where_no_full_frame_passes_until_they_do_again(profile: str) -> None:
    data = content(20_000)
    here = Rig(profile, {b"/d/file": data}, replace(RADIO, mtu=LIMIT))
    async with here.connected() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection) == (SHORT, MAX_DATA)
        here.model.settings = RADIO
        await trio.sleep(SHORT_SECONDS)
        requests = connection.engine.stats.requests
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] == MAX_DATA
        assert connection.engine.stats.requests - requests < 20_000 / MAX_DATA + 8


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_file_is_read_to_its_end_where_no_full_frame_passes_any_more(profile: str) -> None:
    """The gaps that a burst left show it. PX4's bursts have full packets, whatever is asked for."""
    data = content(40_000)
    here = Rig(profile, {b"/d/file": data}, replace(RADIO, loss=0.2))
    async with (
        here.connected(ConnectOptions(read_mode="burst")) as connection,
        trio.open_nursery() as nursery,
    ):

        async def spoil() -> None:
            await trio.sleep(3.0)
            here.model.settings = replace(RADIO, mtu=LIMIT)

        nursery.start_soon(spoil)
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] == SHORT
