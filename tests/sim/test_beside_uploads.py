"""What others wait for beside an upload on a fresh mount, where OpenFileWO is unknown yet, on virtual time.

A file of our own making is interrupted for whoever waits, and what becomes of it tells what the server does.
Where OpenFileWO empties files it is sent once more and cannot be interrupted from then on: others then wait,
and are told in time, but a writer that has nothing to send does not keep them waiting (promises 4 and 7).
"""

from __future__ import annotations

import random
from contextlib import AbstractAsyncContextManager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.sources import MemorySource
from tests.support.takingturns import taking_turns
from tests.support.worlds import ROOTS, World, read_file

pytestmark = pytest.mark.holds("promise 7")

EVERY_PROFILE = sorted(PROFILES)
TRUNCATING = [name for name in EVERY_PROFILE if PROFILES[name].write_only_truncates]
KEEPING = [name for name in EVERY_PROFILE if not PROFILES[name].write_only_truncates]
QUICK = LinkSettings(delay=0.02)
SLOW = LinkSettings(rate=10_000.0, delay=0.05)
OP_DEADLINE = 30.0


class Place:
    """A vehicle with a directory in which there are some files."""

    def __init__(self, profile: str, link: LinkSettings) -> None:
        self.world = World(profile, link)
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.world.tree.add(self.root + b"/other", b"q" * 3000)

    def mounted(self) -> AbstractAsyncContextManager[tuple[Connection, Tree]]:
        return mounted(self.world, self.root)

    async def copy(self, tree: Tree, name: bytes, data: bytes) -> float:
        """Do what cp does; return how long closing took."""
        file = await tree.create(self.root + b"/" + name, exclusive=True)
        for at in range(0, len(data), 50_000):
            await file.write(at, data[at : at + 50_000])
        began = trio.current_time()
        try:
            await file.flush()
        finally:  # the kernel releases it in any case
            await file.release()
        return trio.current_time() - began

    def data(self, name: bytes) -> bytes:
        return bytes(self.world.tree.data(self.root + b"/" + name))


async def trickle(tree: Tree, path: bytes, pause: float = 1.0) -> None:
    """Write a log that is never closed."""
    file = await tree.create(path, exclusive=True)
    await file.write(0, b"s" * 70_000)
    at = 70_000
    while True:
        await file.write(at, b"s" * 500)
        at += 500
        await trio.sleep(pause)


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_close_and_a_read_beside_a_trickling_writer(profile: str, autojump: MockClock) -> None:
    place = Place(profile, QUICK)
    async with place.mounted() as (_, tree), trio.open_nursery() as nursery:
        nursery.start_soon(trickle, tree, place.root + b"/log")
        await trio.sleep(10)
        for number in range(4):
            with trio.fail_after(15):
                await place.copy(tree, b"b%d" % number, b"b" * 1000)
            assert place.data(b"b%d" % number) == b"b" * 1000
            file = await tree.open(place.root + b"/other")
            with trio.fail_after(15):
                assert await file.read(number * 300, 300) == b"q" * 300
            file.close()
            await trio.sleep(5)
        nursery.cancel_scope.cancel()


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_read_and_a_close_beside_a_copy_that_lasts(profile: str, autojump: MockClock) -> None:
    place = Place(profile, SLOW)
    data = random.Random(4).randbytes(600_000)
    async with place.mounted() as (connection, tree):
        async with trio.open_nursery() as nursery:
            nursery.start_soon(place.copy, tree, b"big", data)
            await trio.sleep(10)
            with trio.fail_after(5):
                assert await read_file(connection, place.root + b"/other") == b"q" * 3000
            with trio.fail_after(10):
                await place.copy(tree, b"small", b"b" * 1000)
        assert connection.store.traits.wo_truncates is False, "learnt on the way"
    assert place.data(b"big") == data
    assert place.data(b"small") == b"b" * 1000


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_copy_that_was_tried_can_be_interrupted_after_a_reboot_too(
    profile: str, autojump: MockClock
) -> None:
    """What OpenFileWO does is not known any more then: the same file tells once more."""
    place = Place(profile, SLOW)
    data = random.Random(4).randbytes(400_000)
    async with place.mounted() as (connection, tree), trio.open_nursery() as nursery:
        nursery.start_soon(place.copy, tree, b"big", data)
        await trio.sleep(10)
        assert await read_file(connection, place.root + b"/other") == b"q" * 3000  # the trial
        await trio.sleep(2)
        assert connection.store.traits.wo_truncates is False
        place.world.vehicle.reboot(trio.current_time(), downtime=4.0)
        place.world.link.kick()
        await trio.sleep(15)
        assert connection.store.traits.wo_truncates is None
        with trio.fail_after(10):
            assert await read_file(connection, place.root + b"/other") == b"q" * 3000
        with trio.fail_after(10):
            await place.copy(tree, b"small", b"b" * 1000)
    assert place.data(b"big") == data
    assert place.data(b"small") == b"b" * 1000


@pytest.mark.parametrize("profile", taking_turns(TRUNCATING))
async def test_where_it_empties_files_the_second_waits_and_is_told(profile: str, autojump: MockClock) -> None:
    """The bytes stay held, and are brought when the vehicle has time."""
    place = Place(profile, SLOW)
    data = random.Random(4).randbytes(600_000)
    waited: list[float] = []
    async with place.mounted() as (connection, tree):
        faults = Faults(place.world)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(place.copy, tree, b"big", data)
            await trio.sleep(10)
            assert await read_file(connection, place.root + b"/other") == b"q" * 3000  # the trial
            await trio.sleep(2)
            began = trio.current_time()
            with pytest.raises(RequestTimeout):
                await place.copy(tree, b"small", b"b" * 1000)
            waited.append(trio.current_time() - began)
            began = trio.current_time()
            await connection.store.list_directory(place.root)
            waited.append(trio.current_time() - began)
        assert waited[0] <= 2 * OP_DEADLINE + 3, "for close, and for the release behind it"
        assert waited[1] < 3
        assert connection.store.traits.wo_truncates is True
        await trio.sleep(60)
        assert place.data(b"small") == b"b" * 1000, "brought later"
        # big twice, small, and an empty file that shows whether the card can rename
        assert faults.requests.count(Opcode.CREATE_FILE) <= 2 + 1 + 1
    assert place.data(b"big") == data


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_two_copies_at_once(profile: str, autojump: MockClock) -> None:
    place = Place(profile, LinkSettings(rate=100_000.0, delay=0.02))
    files = {name: random.Random(name).randbytes(250_000) for name in (b"one", b"two")}
    async with place.mounted() as (_, tree):
        with trio.fail_after(60):
            async with trio.open_nursery() as nursery:
                for name, data in files.items():
                    nursery.start_soon(place.copy, tree, name, data)
    for name, data in files.items():
        assert place.data(name) == data


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_log_written_now_and_then_costs_little(profile: str, autojump: MockClock) -> None:
    """The whole file again for each line is more than a link carries."""
    place = Place(profile, QUICK)
    async with place.mounted() as (_, tree), trio.open_nursery() as nursery:
        faults = Faults(place.world)
        nursery.start_soon(trickle, tree, place.root + b"/log", 3.0)
        await trio.sleep(600)
        nursery.cancel_scope.cancel()
    needed = (70_000 + 200 * 500) // 239
    assert faults.requests.count(Opcode.CREATE_FILE) <= 16
    assert faults.requests.count(Opcode.WRITE_FILE) <= (10 if profile in TRUNCATING else 2) * needed


@pytest.mark.parametrize("step", [1, 100])
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot"])
async def test_a_few_bytes_at_a_time_fill_requests(profile: str, step: int, autojump: MockClock) -> None:
    """A program without a buffer of its own writes faster than answers come, and slower than the link."""
    place = Place(profile, LinkSettings(rate=100_000.0, delay=0.02))
    data = random.Random(5).randbytes(70_000 + 700 * step)
    async with place.mounted() as (_, tree):
        file = await tree.create(place.root + b"/log", exclusive=True)
        await file.write(0, data[:70_000])
        await trio.sleep(10)  # it is on its way, and all there is was sent
        faults = Faults(place.world)
        for at in range(70_000, len(data), step):
            await file.write(at, data[at : at + step])
            await trio.sleep(0.004)
        await file.flush()
        await file.release()
    assert faults.requests.count(Opcode.WRITE_FILE) <= 1.1 * (700 * step // 239) + 3
    assert place.data(b"log") == data


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
@pytest.mark.parametrize("size", [100, 3000])
async def test_what_was_learnt_by_it_costs_the_bytes_once_at_most(
    profile: str, size: int, autojump: MockClock
) -> None:
    """More comes for a file that was closed for lack of bytes: it is reopened, and that is looked at."""
    place = Place(profile, QUICK)
    async with place.world.connection() as connection:
        faults = Faults(place.world)
        source = MemorySource(b"a" * size)
        upload = await connection.store.open_upload(place.root + b"/new", source)
        await upload.finish()
        source.add(b"b" * 100)
        upload.wake()
        await upload.finish()
        assert source.all_proven
        assert connection.store.traits.wo_truncates is (profile in TRUNCATING)
        assert source.rollbacks == ([True] if profile in TRUNCATING else [])
        assert faults.requests.count(Opcode.CREATE_FILE) == 1 + (profile in TRUNCATING)
    assert place.data(b"new") == b"a" * size + b"b" * 100
    assert place.world.vehicle.server.open_sessions == 0
