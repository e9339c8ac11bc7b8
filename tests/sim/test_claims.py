"""Who waits for a path that is being changed holds up nobody else. On virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.session.queue import Queue
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.faults import Faults
from tests.support.trees import content
from tests.support.worlds import MemorySink, World, read_file

ROUNDS = 10_000


@pytest.mark.holds("fault overlap")
async def test_a_reader_goes_on_beside_a_job_that_has_to_wait(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = World("px4", LinkSettings(rate=5760.0, delay=0.02))
    here.tree.add(b"/big", content("big", 20_000))
    here.tree.add(b"/changing", b"old")
    rounds = 0
    choose = Queue.first

    def counted(queue: Queue) -> object:
        nonlocal rounds
        rounds += 1
        assert rounds < ROUNDS, "it goes round without a moment in between"
        return choose(queue)

    monkeypatch.setattr(Queue, "first", counted)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        scheduler = connection.scheduler
        async with scheduler.server.excluded(b"/changing"):
            nursery.start_soon(scheduler.use_session, b"/changing", Opcode.OPEN_FILE_RO)
            await trio.sleep(0.1)
            assert await read_file(connection, b"/big") == content("big", 20_000)
    assert rounds < 100


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", ["px4", "mavsdk", "ardupilot"])
async def test_a_file_is_not_opened_under_a_name_that_it_lost_meanwhile(
    autojump: MockClock, profile: str
) -> None:
    """Another file is open and has to be closed first; once more, where the answer to that is lost."""
    old, new = content("old", 5000), content("new", 5000)
    for lost in (False, True):
        for later in range(0, 60, 3):
            here = World(profile, LinkSettings(delay=0.1))
            for path, data in ((b"/a", old), (b"/b", new), (b"/other", new)):
                here.tree.add(path, data)
            async with here.connection() as connection, trio.open_nursery() as nursery:
                store, sink = connection.store, MemorySink(5000)
                assert await read_file(connection, b"/other") == new
                reader = await store.open_reader(b"/a", sink, expected_size=5000)
                faults = Faults(here)
                if lost:
                    faults.lose_reply_to(Opcode.TERMINATE_SESSION)

                async def change(connection: Connection = connection, later: int = later) -> None:
                    await trio.sleep(later * 0.02)
                    await connection.store.rename(b"/a", b"/aside")
                    await connection.store.rename(b"/b", b"/a")

                nursery.start_soon(change)
                reader.want(0, 5000, demand=True)
                assert await sink.wait_for(0, 5000) == old
                reader.close()
