"""What puts everything in doubt, and what is done while it lasts. On virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, request
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.doubt import LASTS, LEAST_LATE, MOST_LATE, Doubt
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.latecomers import Latecomer
from tests.support.mounting import writable_tree
from tests.support.takingturns import taking_turns
from tests.support.uploads import put
from tests.support.worlds import MemorySink, World, begin_to_read, content, path, read_file, world

pytestmark = pytest.mark.holds("fault duplicate")

EVERY_PROFILE = sorted(PROFILES)
CLEAN = LinkSettings(delay=0.02)


def test_doubt_lasts_for_ten_minutes() -> None:
    now = 0.0
    doubt = Doubt(lambda: now)
    assert not doubt.is_active()
    assert doubt.lateness == 0.0
    now = 5.0
    doubt.raise_it("a reason")
    assert doubt.is_active()
    assert doubt.arose_since(4.9)
    assert not doubt.arose_since(5.0)
    assert doubt.lateness == LEAST_LATE
    now += LASTS
    assert doubt.is_active()
    now += 0.1
    assert not doubt.is_active()
    assert doubt.lateness == 0.0


def test_the_largest_lateness_counts_between_bounds() -> None:
    now = 0.0
    doubt = Doubt(lambda: now)
    doubt.raise_it("a reason")
    for seconds, expected in ((0.1, LEAST_LATE), (4.0, 4.0), (2.0, 4.0), (40.0, MOST_LATE)):
        doubt.note_late(seconds)
        assert doubt.lateness == expected


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_clean_link_raises_none(profile: str, autojump: MockClock) -> None:
    here = world(profile, CLEAN, f=content(5000))
    async with here.connection() as connection:
        await read_file(connection, path(profile, "f"))
        await put(connection, path(profile, "new"), content(5000))
        await connection.store.remove(path(profile, "new"))
        assert not connection.store.in_doubt()


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_our_own_repetitions_raise_none(profile: str, autojump: MockClock) -> None:
    here = world(profile, LinkSettings(delay=0.02, loss=0.2), f=content(20_000))
    async with here.connection() as connection:
        await read_file(connection, path(profile, "f"))
        await put(connection, path(profile, "new"), content(20_000))
        assert connection.engine.stats.retransmissions
        assert connection.engine.stats.strays == 0


async def test_an_answer_that_comes_twice_raises_it(autojump: MockClock) -> None:
    here = world("px4", CLEAN)
    async with here.connection() as connection:
        began = trio.current_time()
        Latecomer(here, Opcode.CREATE_DIRECTORY, after=Opcode.REMOVE_DIRECTORY)
        await connection.store.make_directory(b"/d/one")
        await trio.sleep(3)
        assert not connection.store.in_doubt()
        await connection.store.remove_directory(b"/d/one")
        await trio.sleep(0.1)
        assert connection.store.in_doubt()
        assert connection.store.doubted_since(began)
        assert 3 < connection.scheduler.doubt.lateness < 4


async def test_another_client_raises_it(autojump: MockClock) -> None:
    here = world("px4", CLEAN)
    async with here.connection() as connection:
        here.vehicle.foreign_request(
            request(777, Opcode.NONE).encode(), Address(255, 190), trio.current_time()
        )
        here.link.kick()
        await trio.sleep(0.5)
        assert connection.store.in_doubt()


@pytest.mark.holds("rule 14.12")
async def test_what_another_client_does_decides_whether_bytes_are_in_doubt(autojump: MockClock) -> None:
    """The first that is heard of him, what may use our session, and for a while after that everything: a
    request that took the session may have been missed."""
    data = content(200_000)
    here = world("px4", LinkSettings(rate=5_000.0, delay=0.02), f=data)
    async with here.connection() as connection:
        reader, sink = await begin_to_read(connection, b"/d/f", 5_000)

        async def doubts(opcode: Opcode, pause: float = 0.0) -> bool:
            await trio.sleep(pause)
            before = len(sink.suspicions)
            here.vehicle.foreign_request(
                request(777, opcode, data=b"/").encode(), Address(255, 190), trio.current_time()
            )
            here.link.kick()
            await trio.sleep(1.0)
            return len(sink.suspicions) > before

        assert await doubts(Opcode.LIST_DIRECTORY)
        assert not await doubts(Opcode.LIST_DIRECTORY)
        assert await doubts(Opcode.READ_FILE)
        assert await doubts(Opcode.LIST_DIRECTORY, 5.0)
        assert not await doubts(Opcode.LIST_DIRECTORY, 5.0)
        reader.close()


async def test_a_session_that_vanished_raises_it(autojump: MockClock) -> None:
    data = content(200_000)
    here = world("px4", LinkSettings(rate=50_000.0, delay=0.02), f=data)
    async with here.connection() as connection:
        reader, sink = await begin_to_read(connection, b"/d/f", 10_000)
        here.vehicle.foreign_request(
            request(777, Opcode.RESET_SESSIONS).encode(), Address(255, 190), trio.current_time()
        )
        assert await sink.wait_for(0, len(data)) == data
        assert connection.store.in_doubt()
        assert sink.suspicions
        reader.close()


async def test_a_restart_raises_it(autojump: MockClock) -> None:
    here = world("px4", CLEAN)
    async with here.connection() as connection:
        await trio.sleep(5)
        here.vehicle.reboot(trio.current_time())
        await trio.sleep(5)
        assert connection.vehicle.reboots == 1
        assert connection.store.in_doubt()


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_name_is_not_changed_twice_while_the_first_may_come_late(
    profile: str, autojump: MockClock
) -> None:
    """The same RENAME, carried out once more, would take the next file of the name."""
    if profile == "littlefs":
        return
    here = world(profile, CLEAN, old=content(500, 1))
    old, new = path(profile, "old"), path(profile, "new")
    async with here.connection() as connection:
        connection.scheduler.doubt.raise_it("as if a copy had been late")
        connection.scheduler.doubt.note_late(2.0)
        copy = Latecomer(here, Opcode.RENAME, after=Opcode.CREATE_FILE)
        await connection.store.rename(old, new)
        await put(connection, old, content(400, 2))
        assert copy.late is not None
        assert copy.late >= 2.0


async def read_or_doubt(connection: Connection, target: bytes, expected: bytes) -> None:
    """Read a file; other bytes than its own are provisional by then."""
    sink = MemorySink(len(expected))
    reader = await connection.store.open_reader(target, sink)
    reader.want(0, reader.size, demand=True)
    data = await sink.wait_for(0, reader.size)
    await trio.sleep(1)
    assert data == expected or sink.suspicions
    reader.close()


@pytest.mark.parametrize("nth", [8, 9, 12])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_late_open_of_another_file_gives_no_wrong_bytes(
    profile: str, nth: int, autojump: MockClock
) -> None:
    """MAVSDK closes what is open and opens that one, under the same id; files of one size hide it."""
    one, two = content(1500, 1), content(1500, 2)
    here = world(profile, CLEAN, one=one, two=two)
    async with here.connection(ConnectOptions(window=1)) as connection:
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.READ_FILE, nth=nth, first=True)
        assert await read_file(connection, path(profile, "one")) == one
        await read_or_doubt(connection, path(profile, "two"), two)
        assert copy.late is not None
        await trio.sleep(8)
        assert connection.scheduler.server.session is None
        connection.scheduler.server.check_invariants()


@pytest.mark.holds("fault leaving")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_a_late_open_left_open_does_not_lock_us_out(profile: str, autojump: MockClock) -> None:
    here = world(profile, CLEAN, one=content(1500, 1), two=content(1500, 2))
    async with here.connection() as connection:
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.TERMINATE_SESSION)
        await read_file(connection, path(profile, "one"))
        await trio.sleep(3)
        assert copy.late is not None
        began = trio.current_time()
        assert await read_file(connection, path(profile, "two")) == content(1500, 2)
        assert trio.current_time() - began < 1


async def test_who_waits_for_a_turn_is_not_timed_out(autojump: MockClock) -> None:
    """200 programs read at once over a round trip of 100 ms: the last one waits longer than a read may."""
    here = World("px4", LinkSettings(delay=0.05))
    for number in range(200):
        here.tree.add(b"/f%d" % number, content(2000, number))
    ended: list[float] = []
    async with here.connection() as connection, trio.open_nursery() as nursery:
        tree = writable_tree(connection, nursery)
        await tree.list(b"/")

        files = [await tree.open(b"/f%d" % number) for number in range(200)]

        async def read(number: int) -> None:
            assert await files[number].read(0, 2000) == content(2000, number)
            ended.append(trio.current_time())

        async with trio.open_nursery() as readers:
            for number in range(200):
                readers.start_soon(read, number)
        nursery.cancel_scope.cancel()
    assert len(ended) == 200
    assert ended[-1] - ended[0] > ConnectOptions().op_deadline
