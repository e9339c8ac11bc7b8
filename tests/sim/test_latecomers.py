"""Requests that come once more, after newer ones, and that servers carry out: what is believed then.

Each is repeated at one exact place, within the time in which such copies are feared (`session.echoes.QUIET`).
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.echoes import QUIET
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.sim.test_upload import content, path, probes, put, world
from tests.support.latecomers import Latecomer

EVERY_PROFILE = sorted(PROFILES)
DOUBLING = LinkSettings(delay=0.02, duplicate=0.3, reorder=0.1)


@pytest.fixture
def autojump() -> MockClock:
    return MockClock(autojump_threshold=0)


@pytest.mark.parametrize(
    ("what", "after"),
    [
        (Opcode.WRITE_FILE, Opcode.OPEN_FILE_WO),  # fills what was emptied
        (Opcode.CREATE_FILE, Opcode.TERMINATE_SESSION),  # empties what was not
    ],
)
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_copy_does_not_teach_what_the_server_does_not_do(
    profile: str, what: Opcode, after: Opcode, autojump: MockClock
) -> None:
    plain = world(profile)
    async with plain.connection() as connection:
        await connection.store.probe_open_for_write(*probes(profile))
        truth = connection.store.traits
    here = world(profile, DOUBLING)
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))  # answered twice
        copy = Latecomer(here, what, after=after)
        await connection.store.probe_open_for_write(*probes(profile))
        assert copy.late is not None
        assert copy.late < QUIET[0]
        assert connection.store.traits == truth


@pytest.mark.parametrize("profile", ["mavsdk", "mavsdk-old"])
async def test_a_late_write_does_not_hide_that_reopening_empties_files(
    profile: str, autojump: MockClock
) -> None:
    """Two copies at once on a fresh mount: the first is interrupted to see whether that can be done."""
    here = world(profile, replace(DOUBLING, rate=100_000.0))
    files = {path(profile, name): content(60_000, seed) for seed, name in enumerate(("f", "g"))}
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.OPEN_FILE_WO)
        async with trio.open_nursery() as nursery:
            for name, data in files.items():
                nursery.start_soon(put, connection, name, data)
        assert copy.late is not None
        assert copy.late < QUIET[1]
        assert connection.store.traits.wo_truncates is True
    for name, data in files.items():
        assert here.tree.data(name) == data
