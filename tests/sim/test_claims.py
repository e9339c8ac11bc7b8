"""Who waits for a path that is being changed holds up nobody else. On virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.trees import content
from tests.support.worlds import World, read_file

ROUNDS = 10_000


@pytest.fixture
def autojump() -> MockClock:
    return MockClock(autojump_threshold=0)


async def test_a_reader_goes_on_beside_a_job_that_has_to_wait(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = World("px4", LinkSettings(rate=5760.0, delay=0.02))
    here.tree.add(b"/big", content("big", 20_000))
    here.tree.add(b"/changing", b"old")
    rounds = 0
    choose = Scheduler._next

    def counted(scheduler: Scheduler) -> object:
        nonlocal rounds
        rounds += 1
        assert rounds < ROUNDS, "it goes round without a moment in between"
        return choose(scheduler)

    monkeypatch.setattr(Scheduler, "_next", counted)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        scheduler = connection.scheduler
        async with scheduler._holder.claim(b"/changing", below=False, limit=5):
            nursery.start_soon(scheduler.use_session, b"/changing", Opcode.OPEN_FILE_RO)
            await trio.sleep(0.1)
            assert await read_file(connection, b"/big") == content("big", 20_000)
    assert rounds < 100
