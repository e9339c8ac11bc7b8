"""Uploads against every profile over bad links, on virtual time."""

from __future__ import annotations

import pytest
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.takingturns import taking_turns
from tests.support.uploads import put
from tests.support.worlds import content, path, world

EVERY_PROFILE = sorted(PROFILES)
BAD = LinkSettings(rate=60_000.0, delay=0.02, loss=0.1, duplicate=0.02, reorder=0.05)
PLAIN = LinkSettings(rate=60_000.0, delay=0.02)


@pytest.mark.holds("rule 14.22")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_is_on_the_card_is_what_was_given(profile: str, autojump: MockClock) -> None:
    sizes = (0, 1, 238, 239, 240, 478, 5000, 60_000)
    here = world(profile, BAD, f1=b"something older and longer")
    async with here.connection() as connection:
        for size in sizes:
            await put(connection, path(profile, f"f{size}"), content(size, size))
            assert here.tree.data(path(profile, f"f{size}")) == content(size, size)
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_small_file_costs_create_write_terminate(profile: str, autojump: MockClock) -> None:
    here = world(profile)
    async with here.connection() as connection:
        await put(connection, path(profile, "small"), b"hello")
        assert connection.engine.stats.by_opcode == {
            Opcode.CREATE_FILE: 1,
            Opcode.WRITE_FILE: 1,
            Opcode.TERMINATE_SESSION: 1,
        }
