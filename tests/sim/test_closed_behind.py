"""An upload that makes room sends its Terminate right behind its last requests, on virtual time.

What of them is lost, or comes late, is sent once the file is open again: who came in between sees its own
file, and the uploads end with the right bytes (promises 1 and 7).
"""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import Armed, FtpNak
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.sources import MemorySource
from tests.support.takingturns import taking_turns
from tests.support.worlds import ROOTS, World, read_file

pytestmark = pytest.mark.holds("promise 7")

KEEPING = [name for name in sorted(PROFILES) if not PROFILES[name].write_only_truncates]
LINK = LinkSettings(rate=100_000.0, delay=0.05, queue=50_000)
BAD = {
    "lossy": replace(LINK, loss=0.1),
    "doubling": replace(LINK, loss=0.03, duplicate=0.2),
    "mixing": replace(LINK, loss=0.03, reorder=0.2, jitter=0.04),
}
SIZE = 150_000
SMALL = 40_000
OPCODE = 3


class Place:
    """A vehicle with a small file, and uploads to it; records the opcodes that come to the server."""

    def __init__(self, profile: str, link: LinkSettings) -> None:
        self.world = World(profile, link)
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.world.tree.add(self.root + b"/small", b"q" * 100)
        self.came: list[int] = []
        self.lose: list[int] = []
        server = self.world.vehicle.server
        self._handle = server.handle
        server.handle = self._on_request  # type: ignore[method-assign]

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        if wire[OPCODE] in self.lose:
            self.lose.remove(wire[OPCODE])
            return
        self.came.append(wire[OPCODE])
        self._handle(wire, source, now)

    async def small(self, connection: Connection) -> None:
        assert await read_file(connection, self.root + b"/small") == b"q" * 100

    async def upload(self, connection: Connection, name: bytes, data: bytes) -> None:
        source = MemorySource(data)
        connection.store.traits.wo_truncates = False
        upload = await connection.store.open_upload(self.root + b"/" + name, source)
        upload.wake()
        await upload.finish()
        assert source.all_proven
        assert bytes(self.world.tree.data(self.root + b"/" + name)) == data


def came_at(place: Place, opcode: Opcode) -> list[float]:
    """Return when such requests come to the server, from now on."""
    times: list[float] = []
    server = place.world.vehicle.server
    handle = server.handle

    def on_request(wire: bytes, source: Address, now: float) -> None:
        if wire[OPCODE] == opcode:
            times.append(now)
        handle(wire, source, now)

    server.handle = on_request  # type: ignore[method-assign]
    return times


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
async def test_no_answer_is_waited_for_before_it(profile: str, autojump: MockClock) -> None:
    """A small read takes four round trips else: 1.2 s where 1.21 are allowed for all. In a
    short queue there may be no place for it before an answer came."""
    place = Place(profile, LINK)
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        data = random.Random(1).randbytes(SIZE)
        nursery.start_soon(place.upload, connection, b"new", data)
        await trio.sleep(1.5)
        began = trio.current_time()
        came = came_at(place, Opcode.TERMINATE_SESSION)
        await place.small(connection)
    assert came[0] - began < 3 * LINK.delay, "an answer, and the Terminate behind it, take longer"


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_what_is_lost_before_it_is_sent_when_the_file_is_open_again(
    profile: str, autojump: MockClock
) -> None:
    place = Place(profile, LINK)
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        data = random.Random(2).randbytes(SIZE)
        nursery.start_soon(place.upload, connection, b"new", data)
        await trio.sleep(1.5)
        place.lose = [int(Opcode.WRITE_FILE)] * 2
        count = len(place.came)
        await place.small(connection)
        between = place.came[count:]
        closed = between.index(Opcode.TERMINATE_SESSION)
        assert Opcode.WRITE_FILE not in between[closed : between.index(Opcode.READ_FILE)]


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_WO, Opcode.TERMINATE_SESSION])
async def test_each_of_these_may_get_lost(opcode: Opcode, autojump: MockClock) -> None:
    """Nothing stays open in the end."""
    place = Place("ardupilot", LINK)
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(place.upload, connection, b"new", random.Random(3).randbytes(SIZE))
        for number in range(6):
            await trio.sleep(1.5)
            await place.small(connection)
            place.lose = [int(opcode)] * (1 + number % 2)
    assert not place.lose
    assert place.world.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_full_card_is_told_though_somebody_reads_all_the_time(
    profile: str, autojump: MockClock
) -> None:
    """What was refused behind the Terminate was sent again, and refused again, for ever."""
    place = Place(profile, LINK)
    place.world.tree.capacity = place.world.tree.used + 20_400
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(_read_always, place, connection)
        with trio.fail_after(200), pytest.raises(FtpNak):
            await place.upload(connection, b"new", random.Random(1).randbytes(SIZE))
        nursery.cancel_scope.cancel()


async def _read_always(place: Place, connection: Connection) -> None:
    while True:
        await place.small(connection)


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_arming_while_it_is_closed_is_told(profile: str, autojump: MockClock) -> None:
    """Who waits for an upload was told nothing before the vehicle was disarmed (promise 9)."""
    place = Place(profile, LINK)
    vehicle, handle = place.world.vehicle, place.world.vehicle.server.handle

    def on_request(wire: bytes, source: Address, now: float) -> None:
        closing = wire[OPCODE] == Opcode.TERMINATE_SESSION and place.came[-1] == Opcode.WRITE_FILE
        if closing and now > 3.0 and not vehicle.armed:
            vehicle.arm()  # that is heard before it is closed
        else:
            handle(wire, source, now)

    vehicle.server.handle = on_request  # type: ignore[method-assign]
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(_read_always, place, connection)
        with trio.fail_after(60), pytest.raises(Armed):
            await place.upload(connection, b"new", random.Random(1).randbytes(SIZE))
        nursery.cancel_scope.cancel()


async def test_listings_beside_a_reader_do_not_halve_what_is_written(autojump: MockClock) -> None:
    """PX4 on NuttX refuses writes once it was asked for another path, which only an answer tells."""
    place = Place("px4-nuttx", LINK)
    async with place.world.connection() as connection, trio.open_nursery() as nursery:

        async def list_always() -> None:
            while True:
                await connection.store.list_directory(b"/")

        nursery.start_soon(_read_always, place, connection)
        nursery.start_soon(list_always)
        with trio.fail_after(100):
            await place.upload(connection, b"new", random.Random(1).randbytes(20_000))
        nursery.cancel_scope.cancel()


@pytest.mark.parametrize("link", BAD)
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
@pytest.mark.parametrize("seed", [1, 2])
async def test_two_uploads_and_a_reader_over_bad_links(
    seed: int, profile: str, link: str, autojump: MockClock
) -> None:
    place = Place(profile, BAD[link])
    rng = random.Random(seed)
    async with place.world.connection(seed=seed) as connection, trio.open_nursery() as nursery:

        async def read_now_and_then() -> None:
            while True:
                await trio.sleep(rng.uniform(0.0, 0.8))
                await place.small(connection)

        with trio.fail_after(600):
            async with trio.open_nursery() as uploads:
                nursery.start_soon(read_now_and_then)
                for name in (b"one", b"two"):
                    uploads.start_soon(place.upload, connection, name, rng.randbytes(SMALL))
        nursery.cancel_scope.cancel()


async def test_of_two_uploads_none_waits_for_ever(autojump: MockClock) -> None:
    """Each wait for the other's late requests to be dead counted as a turn, and began the wait anew after
    which it goes before readers: one of them was sent, the other did not get a byte in ten minutes."""
    place = Place("ardupilot", BAD["mixing"])
    rng = random.Random(1)
    sources = [MemorySource(rng.randbytes(SIZE)) for _ in range(2)]
    async with place.world.connection(seed=1) as connection, trio.open_nursery() as nursery:
        connection.store.traits.wo_truncates = False
        for number, source in enumerate(sources):
            upload = await connection.store.open_upload(place.root + b"/%d" % number, source)
            upload.wake()

        async def read_now_and_then() -> None:
            while True:
                await trio.sleep(rng.uniform(0.0, 0.8))
                await place.small(connection)

        nursery.start_soon(read_now_and_then)
        for _ in range(3):
            before = [source.proven.total for source in sources]
            await trio.sleep(60)
            assert all(source.proven.total > old for source, old in zip(sources, before, strict=True))
        nursery.cancel_scope.cancel()


async def seconds_for(count: int, link: LinkSettings) -> float:
    """Return how long so many uploads to ArduPilot take that begin together."""
    place = Place("ardupilot", link)
    began = trio.current_time()
    async with place.world.connection() as connection, trio.open_nursery() as nursery:
        for number in range(count):
            data = random.Random(number).randbytes(60_000)
            nursery.start_soon(place.upload, connection, b"%d" % number, data)
    return trio.current_time() - began


async def test_three_uploads_alternate_by_more_than_a_window(autojump: MockClock) -> None:
    """Who waited for the two others longer than service counts passed for a light user: each turn was as
    long as opening the file again (347 s where it takes 176 by now)."""
    assert await seconds_for(3, replace(LINK, delay=0.3, loss=0.01, duplicate=0.02)) < 230


async def test_a_short_queue_is_filled_beside_another_upload(autojump: MockClock) -> None:
    """The place for the Terminate was kept free through whole turns: a fifth less was written."""
    assert await seconds_for(2, replace(LINK, delay=0.15, loss=0.01)) < 46
