"""A close that somebody is told of waits as long as other requests do."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from tests.support.faults import Faults
from tests.support.worlds import World


@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk", "px4"])
async def test_a_new_file_s_close_outlasts_bad_luck(profile: str, autojump_clock: MockClock) -> None:
    here = World(profile)
    here.tree.add_directory(b"/d")
    async with here.connection() as connection:
        await connection.store.list_directory(b"/d")
        faults = Faults(here)
        for _ in range(8):
            faults.lose_reply_to(Opcode.TERMINATE_SESSION)
        began = trio.current_time()
        await connection.store.create_empty(b"/d/new")
        assert trio.current_time() - began > 5
        assert here.tree.data(b"/d/new") == b""
    assert here.vehicle.server.open_sessions == 0
