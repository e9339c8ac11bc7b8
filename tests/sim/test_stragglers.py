"""A write request that the network held back, and that arrives when another file is open under the same id.

WriteFile carries a session id and an offset, and nothing that tells which file is meant (servers.md 1 and 8).
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.shared.errors import RequestTimeout
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.sim.test_arming_replacement import NEW, Scene, replace
from tests.sim.test_doubted_bytes import CLEAN, KEEPING
from tests.sim.test_late_writes import change
from tests.support.mounting import mounted
from tests.support.sources import MemorySource
from tests.support.takingturns import taking_turns
from tests.support.uploads import append, probe, put, start
from tests.support.worlds import World, begin_to_read, content, path, read_file, world

DOUBLING = LinkSettings(delay=0.02, duplicate=1.0, reorder=0.1)
LATE = 0.1
"""Seconds after the end of its file: 2.5 round trips, when the next file's first bytes may be written."""

FIRST, SECOND = b"a" * 500, b"b" * 400


def hold_back_a_write(here: World, start: Callable[..., object]) -> None:
    """Have the first WriteFile come once more, LATE after the first Terminate."""
    server = here.vehicle.server
    handle = server.handle
    kept: list[tuple[bytes, Address]] = []

    async def arrive_late() -> None:
        await trio.sleep(LATE)
        handle(*kept[0], trio.current_time())

    def watch(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == Opcode.WRITE_FILE and not kept:
            kept.append((wire, source))
        if wire[3] == Opcode.TERMINATE_SESSION and len(kept) == 1:
            kept.append(kept[0])
            start(arrive_late)
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]


def double(
    here: World, opcode: Opcode, late: float, start: Callable[..., object], *, mute: bool = False
) -> None:
    """Have the first request of a kind come once more, so much later; mute: the second answer is lost."""
    server = here.vehicle.server
    handle = server.handle
    kept: list[bytes] = []

    async def arrive_late(wire: bytes, source: Address) -> None:
        await trio.sleep(late)
        handle(wire, source, trio.current_time())
        if mute:
            server.outgoing(trio.current_time())
        here.link.kick()

    def watch(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == opcode and not kept:
            kept.append(wire)
            start(arrive_late, wire, source)
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]


def hold_back_the_create(
    here: World, start: Callable[..., object], *, until: float = 0.0, late: float = 2 * LATE
) -> None:
    """Have the first CreateFile come so much later than the second one (the first after `until`), and those
    between get lost; its answer is lost, too."""
    server = here.vehicle.server
    handle = server.handle
    kept: list[bytes] = []

    async def arrive_late(source: Address) -> None:
        await trio.sleep(late)
        handle(kept[0], source, trio.current_time())
        server.outgoing(trio.current_time())
        here.link.kick()

    def watch(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == Opcode.CREATE_FILE:
            kept.append(wire)
            if len(kept) == 1 or now < until:
                return
            if len(kept) == 2 or until:
                start(arrive_late, source)
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]


async def rename_late(here: World, connection: Connection, late: float, nursery: trio.Nursery) -> None:
    """Rename a file and make another one of its old name, with the rename coming once more."""
    double(here, Opcode.RENAME, late, nursery.start_soon)
    await connection.store.rename(b"/d/old", b"/d/new")
    await put(connection, b"/d/old", SECOND)
    await trio.sleep(late + 1)


async def create_late(here: World, connection: Connection, late: float, nursery: trio.Nursery) -> bytes:
    """Make a file with its CreateFile coming once more; return what it was when it was said to be there:
    emptied by then, or not at all."""
    double(here, Opcode.CREATE_FILE, late, nursery.start_soon)
    await put(connection, path(here.profile, "first"), FIRST)
    verified = here.tree.data(path(here.profile, "first"))
    await trio.sleep(late + 1)
    return verified


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_a_late_write_does_not_reach_the_next_file(profile: str, autojump: MockClock) -> None:
    here, root = world(profile, DOUBLING), path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(root)  # answered twice, which shows what this link does
        hold_back_a_write(here, nursery.start_soon)
        await put(connection, root + b"/first", FIRST)
        await put(connection, root + b"/second", SECOND)
    assert here.tree.data(root + b"/first") == FIRST
    assert here.tree.data(root + b"/second") == SECOND


async def test_a_link_that_keeps_the_order_costs_no_wait(autojump: MockClock) -> None:
    here = world("px4", LinkSettings(delay=0.02))
    async with here.connection() as connection:
        await connection.store.list_directory(b"/d")
        began = trio.current_time()
        await put(connection, b"/d/first", FIRST)
        await put(connection, b"/d/second", SECOND)
        assert trio.current_time() - began < 8 * 0.04


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_a_create_that_was_repeated_is_dead_before_its_file_counts_as_written(
    profile: str, autojump: MockClock
) -> None:
    """On a link that was not seen to hold anything back: the first CreateFile comes after all, much later
    than the second one, and its answer is lost."""
    here, name = world(profile, CLEAN), path(profile, "first")
    async with trio.open_nursery() as nursery, here.connection() as connection:
        hold_back_the_create(here, nursery.start_soon)
        await put(connection, name, FIRST)
        verified = here.tree.data(name)
        await trio.sleep(5.0)
        assert here.tree.data(name) == verified


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_nor_does_one_of_an_attempt_that_failed_empty_it(profile: str, autojump: MockClock) -> None:
    here, name = world(profile, CLEAN), path(profile, "first")
    async with trio.open_nursery() as nursery, here.connection() as connection:
        hold_back_the_create(here, nursery.start_soon, until=trio.current_time() + 30.0)
        upload = await connection.store.open_upload(name, MemorySource(FIRST), create=True)
        with pytest.raises(RequestTimeout):
            await upload.finish()
        await upload.finish()
        verified = here.tree.data(name)
        await trio.sleep(5.0)
        assert here.tree.data(name) == verified


async def test_nor_does_one_that_was_refused_the_second_time(autojump: MockClock) -> None:
    """The session was a killed client's: what closes it is followed by another CreateFile, sent once."""
    here = world("px4", CLEAN, old=content(50_000))
    async with here.connection(seed=3) as connection:
        await begin_to_read(connection, b"/d/old", 1000)
        here.link.cut()  # so that the farewell does not arrive: kill -9
    here.link.restore()
    async with trio.open_nursery() as nursery, here.connection(seed=4) as connection:
        hold_back_the_create(here, nursery.start_soon, late=0.3)
        await put(connection, b"/d/first", FIRST)
        verified = here.tree.data(b"/d/first")
        assert connection.engine.stats.naks
        await trio.sleep(5.0)
        assert here.tree.data(b"/d/first") == verified


@pytest.mark.parametrize("profile", ["mavsdk", "ardupilot", "px4"])
async def test_a_late_rename_does_not_take_the_next_file_of_that_name(
    profile: str, autojump: MockClock
) -> None:
    here = world(profile, DOUBLING, old=FIRST)
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(b"/d")
        await rename_late(here, connection, LATE, nursery)
    assert here.tree.data(b"/d/new") == FIRST
    assert here.tree.data(b"/d/old") == SECOND


async def test_a_late_removal_does_not_take_the_next_directory(autojump: MockClock) -> None:
    here = World("mavsdk", DOUBLING)
    here.tree.add_directory(b"/d/e")
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(b"/d")
        double(here, Opcode.REMOVE_DIRECTORY, LATE, nursery.start_soon)
        await connection.store.remove_directory(b"/d/e")
        await connection.store.make_directory(b"/d/e")
        await trio.sleep(1)
    assert [entry.name for entry in here.tree.entries(b"/d") if entry.name == b"e"] == [b"e"]


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_name_that_was_removed_does_not_come_back(profile: str, autojump: MockClock) -> None:
    """OpenFileWO makes missing files on most servers."""
    here, name = world(profile, DOUBLING, f=content(100)), path(profile, "f")
    async with trio.open_nursery() as nursery, here.connection() as connection:
        connection.store.traits.wo_truncates = False
        await connection.store.list_directory(split(name)[0])
        double(here, Opcode.OPEN_FILE_WO, 0.24, nursery.start_soon)
        await append(connection, name, b"hello", 100)
        assert here.tree.data(name) == content(100) + b"hello"
        await connection.store.remove(name)
        await trio.sleep(1)
    assert b"f" not in {entry.name for entry in here.tree.entries(split(name)[0])}


@pytest.mark.parametrize("profile", taking_turns([name for name in KEEPING if name != "littlefs"]))
async def test_what_was_written_to_a_file_does_not_come_to_the_next_of_its_name(
    profile: str, autojump: MockClock
) -> None:
    """OpenFileWO and WriteFile come once more, both: only so a write finds the file that took the place."""
    here = world(profile, DOUBLING, f=content(100), g=content(1000, 2))
    name, other = path(profile, "f"), path(profile, "g")
    async with trio.open_nursery() as nursery, here.connection() as connection:
        connection.store.traits.wo_truncates = False
        await connection.store.list_directory(split(name)[0])
        double(here, Opcode.OPEN_FILE_WO, 0.2, nursery.start_soon)
        double(here, Opcode.WRITE_FILE, 0.2, nursery.start_soon)
        await append(connection, name, b"hello", 100)
        if profile in ("ardupilot5", "px4-nuttx"):  # FAT: they rename over no file
            await connection.store.remove(name)
        await connection.store.rename(other, name)
        await trio.sleep(1)
    assert here.tree.data(name) == content(1000, 2)


@pytest.mark.parametrize("late", [0.06, 0.09, 0.11])
async def test_a_late_rename_of_the_old_file_does_not_take_the_new_one(
    late: float, autojump: MockClock
) -> None:
    """On FAT the old file makes room first; its aside is removed last, whatever it is by then."""
    scene = Scene("ardupilot5")
    scene.world.model.settings = DOUBLING
    async with scene.mounted() as tree, trio.open_nursery() as nursery:
        await replace(scene, tree)
        await tree.list(scene.root)
        double(scene.world, Opcode.RENAME, late, nursery.start_soon)
        await replace(scene, tree)
        await trio.sleep(1)
    assert scene.content() == NEW


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_a_late_create_does_not_lock_us_out(profile: str, autojump: MockClock) -> None:
    """ArduPilot opens the file again, under our id, and refuses all others until we close it."""
    here, root = world(profile, DOUBLING), path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(root)
        double(here, Opcode.CREATE_FILE, 0.3, nursery.start_soon)
        await put(connection, root + b"/first", FIRST)
        await trio.sleep(0.5)
        await put(connection, root + b"/second", SECOND)
        assert connection.scheduler.opener.quiet_periods == 0  # in which such a session would end by itself
    assert here.tree.data(root + b"/second") == SECOND


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_a_late_create_empties_nothing_that_is_said_to_be_there(
    profile: str, autojump: MockClock
) -> None:
    here, root = world(profile, DOUBLING), path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(root)
        verified = await create_late(here, connection, 0.24, nursery)
    assert here.tree.data(path(profile, "first")) == verified


VERY_LATE = 3.0
"""Seconds; QUIET is one at most."""


async def show(here: World, connection: Connection, root: bytes, late: float, nursery: trio.Nursery) -> None:
    """Let the client see how late copies come on this path."""
    while connection.store.lists_times is None:
        await connection.store.list_directory(root)
    timed = connection.store.lists_times
    listing = Opcode.LIST_DIRECTORY_WITH_TIME if timed else Opcode.LIST_DIRECTORY
    double(here, listing, late, nursery.start_soon)
    await connection.store.list_directory(root)
    await connection.store.list_directory(root)
    await trio.sleep(late + 1)


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_write_as_late_as_others_were_does_not_reach_the_next_file(
    profile: str, autojump: MockClock
) -> None:
    """Its answer is lost, so that nothing but the time keeps it from there."""
    old = content(20_000)
    here = world(profile, LinkSettings(delay=0.02, rate=5760.0), first=old, second=old)
    root = path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, mounted(here, root) as (connection, tree):
        await change(tree, root + b"/first", 1, b"x")  # tries out what the server does
        await show(here, connection, root, VERY_LATE + 0.1, nursery)
        double(here, Opcode.WRITE_FILE, VERY_LATE, nursery.start_soon, mute=True)
        await change(tree, root + b"/first", 100, FIRST)
        await trio.sleep(VERY_LATE - 1.5)
        await change(tree, root + b"/second", 5000, content(10_000, 2))
        await trio.sleep(VERY_LATE)
    assert here.tree.data(root + b"/second") == old[:5000] + content(10_000, 2) + old[15_000:]
    assert here.tree.data(root + b"/first") == old[:1] + b"x" + old[2:100] + FIRST + old[600:]


@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
async def test_a_create_as_late_as_others_were_empties_nothing_that_is_said_to_be_there(
    profile: str, autojump: MockClock
) -> None:
    here, root = world(profile, CLEAN), path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await show(here, connection, root, VERY_LATE + 0.1, nursery)
        verified = await create_late(here, connection, VERY_LATE, nursery)
    assert here.tree.data(path(profile, "first")) == verified


@pytest.mark.parametrize("profile", ["mavsdk", "ardupilot", "px4"])
async def test_a_rename_as_late_as_others_were_does_not_take_the_next_file(
    profile: str, autojump: MockClock
) -> None:
    here = world(profile, CLEAN, old=FIRST)
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await show(here, connection, b"/d", VERY_LATE + 0.1, nursery)
        await rename_late(here, connection, VERY_LATE, nursery)
    assert here.tree.data(b"/d/new") == FIRST
    assert here.tree.data(b"/d/old") == SECOND


@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
async def test_readers_do_not_wait_for_copies_to_be_dead(profile: str, autojump: MockClock) -> None:
    """The next file is not opened to be written for ten seconds; who reads has the session meanwhile."""
    here, root = world(profile, LinkSettings(delay=0.02, rate=5760.0), read=FIRST), path(profile, "")[:-1]
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await show(here, connection, root, 8.0, nursery)
        await put(connection, root + b"/first", content(60_000))
        async with trio.open_nursery() as writing:
            writing.start_soon(put, connection, root + b"/second", SECOND)
            await trio.sleep(1.0)
            for _ in range(3):
                began = trio.current_time()
                assert await read_file(connection, root + b"/read") == FIRST
                assert trio.current_time() - began < 1.0
                await trio.sleep(2.0)
            assert b"second" not in [entry.name for entry in here.tree.entries(root)]
    assert here.tree.data(root + b"/second") == SECOND


@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
async def test_a_small_file_gets_its_turn_beside_a_long_copy_where_copies_come_late(
    profile: str, autojump: MockClock
) -> None:
    """Each piece of the long one leaves copies to wait for: it must not go on while the other waits."""
    here = world(profile, LinkSettings(delay=0.02, duplicate=1.0, reorder=0.1, rate=20_000.0))
    async with here.connection() as connection:
        await probe(connection, profile)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(put, connection, path(profile, "long"), content(400_000))
            await trio.sleep(4.0)
            began = trio.current_time()
            await put(connection, path(profile, "small"), SECOND)
            took = trio.current_time() - began
    assert here.tree.data(path(profile, "long")) == content(400_000)
    assert here.tree.data(path(profile, "small")) == SECOND
    if connection.store.traits.wo_truncates is False:  # else a copy that is interrupted begins again
        assert took < 5.0


@pytest.mark.parametrize("pause", [0.2, 2.0])
@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_small_file_gets_its_turn_beside_a_log_where_copies_come_late(
    profile: str, waits: bool, pause: float, autojump: MockClock
) -> None:
    """Each line of it leaves copies to wait for. waits: the log's writer asks for each line to be there."""
    here, root = world(profile, CLEAN), path(profile, "")[:-1]

    async def write_lines(upload: QueuedUpload, source: MemorySource) -> None:
        while True:
            source.add(b"line\n")
            upload.wake()
            if waits:
                await upload.finish()
            await trio.sleep(pause)

    async with trio.open_nursery() as nursery, here.connection() as connection:
        await probe(connection, profile)
        await show(here, connection, root, 8.0, nursery)
        source = MemorySource(FIRST)
        upload = await start(connection, profile, source, "log")
        await upload.finish()
        nursery.start_soon(write_lines, upload, source)
        await trio.sleep(5.0)
        with trio.fail_after(40.0):
            await put(connection, root + b"/small", SECOND)
        nursery.cancel_scope.cancel()
    assert here.tree.data(root + b"/small") == SECOND
