"""Programs beside an upload: each gets its own file soon, and the upload ends with the right bytes.

The upload learns on the way whether OpenFileWO empties files. If it does, others wait, or get an error in
time.
"""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import Armed, FtpNak, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.rigs import Rig, rig, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import (
    MemorySink,
    MemorySource,
    begin_to_read,
    content,
    know,
    path,
    put,
    read_file,
    start,
    under_way,
)

EVERY_PROFILE = sorted(PROFILES)
TRUNCATING = [name for name in EVERY_PROFILE if PROFILES[name].write_only_truncates]
KEEPING = [name for name in EVERY_PROFILE if not PROFILES[name].write_only_truncates]
QUICK = LinkSettings(delay=0.02)
SLOW = LinkSettings(rate=10_000.0, delay=0.05)
OP_DEADLINE = 30.0
OPCODE = 3


FILES = {b"/d/other": b"q" * 3000, b"/d/brief": b"q" * 100}


async def read_brief(here: Rig) -> None:
    assert await read_file(here.connection, here.root + b"/d/brief") == FILES[b"/d/brief"]


async def read_now_and_then(here: Rig, rng: random.Random, longest: float = 0.8) -> None:
    while True:
        await trio.sleep(rng.uniform(0.0, longest))
        await read_brief(here)


async def upload(here: Rig, name: bytes, data: bytes) -> None:
    """Upload without a mount, where it is known what OpenFileWO does."""
    here.connection.store.traits.wo_truncates = False
    await put(here.connection, here.root + b"/d/" + name, data)
    assert here.data(b"/d/" + name) == data


async def trickle(tree: Tree, path: bytes, pause: float = 1.0) -> None:
    """Write a log that is never closed."""
    file = await tree.create(path, exclusive=True)
    await file.write(0, b"s" * 70_000)
    at = 70_000
    while True:
        await file.write(at, b"s" * 500)
        at += 500
        await trio.sleep(pause)


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_close_and_a_read_beside_a_trickling_writer(profile: str) -> None:
    here = Rig(profile, FILES, QUICK)
    async with here.mounted(b"/d") as tree, trio.open_nursery() as nursery:
        nursery.start_soon(trickle, tree, b"/d/log")
        await trio.sleep(10)
        for number in range(4):
            with trio.fail_after(15):
                await write_file(tree, b"/d/b%d" % number, b"b" * 1000)
            assert here.data(b"/d/b%d" % number) == b"b" * 1000
            file = await tree.open(b"/d/other")
            with trio.fail_after(15):
                assert await file.read(number * 300, 300) == b"q" * 300
            file.close()
            await trio.sleep(5)
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(TRUNCATING))
async def test_where_it_empties_files_the_second_waits_as_long_as_the_first_moves(profile: str) -> None:
    """The first one would have to be sent from its beginning again. Listings go on beside it."""
    here = Rig(profile, FILES, SLOW)
    data = content(600_000, 4)
    async with here.mounted(b"/d") as tree:
        here.faults.requests.clear()
        async with trio.open_nursery() as nursery:
            nursery.start_soon(write_file, tree, b"/d/big", data)
            await trio.sleep(10)
            assert await read_file(here.connection, here.root + b"/d/other") == b"q" * 3000  # the trial
            await trio.sleep(2)
            began = trio.current_time()
            nursery.start_soon(write_file, tree, b"/d/small", b"b" * 1000)
            await here.connection.store.list_directory(here.root + b"/d")
            assert trio.current_time() - began < 3
        assert trio.current_time() - began > 2 * OP_DEADLINE
        assert here.connection.store.traits.wo_truncates is True
        # big twice, small, and an empty file that shows whether the card can rename
        assert here.count(Opcode.CREATE_FILE) <= 2 + 1 + 1
    assert here.data(b"/d/small") == b"b" * 1000
    assert here.data(b"/d/big") == data


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_log_written_now_and_then_costs_little(profile: str) -> None:
    """The whole file again for each line is more than a link carries."""
    here = Rig(profile, FILES, QUICK)
    async with here.mounted(b"/d") as tree, trio.open_nursery() as nursery:
        here.faults.requests.clear()
        nursery.start_soon(trickle, tree, b"/d/log", 3.0)
        await trio.sleep(300)
        nursery.cancel_scope.cancel()
    needed = (70_000 + 100 * 500) // 239
    assert here.count(Opcode.CREATE_FILE) <= 16
    assert here.count(Opcode.WRITE_FILE) <= (10 if profile in TRUNCATING else 2) * needed


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize(("profile", "step"), [("px4", 1), ("px4-nuttx", 100), ("ardupilot", 100)])
async def test_a_few_bytes_at_a_time_fill_requests(profile: str, step: int) -> None:
    """A program without a buffer of its own writes faster than answers come, and slower than the link."""
    here = Rig(profile, FILES, LinkSettings(rate=100_000.0, delay=0.02))
    data = content(70_000 + 700 * step, 5)
    async with here.mounted(b"/d") as tree:
        file = await tree.create(b"/d/log", exclusive=True)
        await file.write(0, data[:70_000])
        await trio.sleep(10)  # it is on its way, and all there is was sent
        here.faults.requests.clear()
        for at in range(70_000, len(data), step):
            await file.write(at, data[at : at + step])
            await trio.sleep(0.004)
        await file.flush()
        await file.release()
    assert here.count(Opcode.WRITE_FILE) <= 1.1 * (700 * step // 239) + 3
    assert here.data(b"/d/log") == data


# --- over bad links, and where an upload cannot go on

LINK = LinkSettings(rate=100_000.0, delay=0.05, queue=50_000)
BAD = {
    "lossy": replace(LINK, loss=0.1),
    "doubling": replace(LINK, loss=0.03, duplicate=0.2),
    "mixing": replace(LINK, loss=0.03, reorder=0.2, jitter=0.04),
}

SIZE = 150_000
SMALL = 40_000


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_full_card_is_told_though_somebody_reads_all_the_time(profile: str) -> None:
    here = Rig(profile, FILES, LINK)
    here.card.capacity = here.card.used + 20_400
    async with here.connected():
        here.nursery.start_soon(read_now_and_then, here, random.Random(1), 0.0)
        with trio.fail_after(200), pytest.raises(FtpNak):
            await upload(here, b"new", content(SIZE, 1))


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_arming_while_it_is_closed_is_told(profile: str) -> None:
    """A caller that waited for the upload got no answer before the vehicle was disarmed (promise 9)."""
    here = Rig(profile, FILES, LINK)
    vehicle, handle = here.vehicle, here.server.handle

    def on_request(wire: bytes, source: Address, now: float) -> None:
        closing = wire[OPCODE] == Opcode.TERMINATE_SESSION and here.faults.requests[-1] == Opcode.WRITE_FILE
        if closing and now > 3.0 and not vehicle.armed:
            vehicle.arm()  # that is heard before it is closed
        else:
            handle(wire, source, now)

    vehicle.server.handle = on_request  # type: ignore[method-assign]
    async with here.connected():
        here.nursery.start_soon(read_now_and_then, here, random.Random(1), 0.0)
        with trio.fail_after(60), pytest.raises(Armed):
            await upload(here, b"new", content(SIZE, 1))


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("link", BAD)
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_two_uploads_and_a_reader_over_bad_links(profile: str, link: str) -> None:
    here = Rig(profile, FILES, BAD[link])
    rng = random.Random(1)
    async with here.connected(seed=1):
        with trio.fail_after(600):
            async with trio.open_nursery() as uploads:
                here.nursery.start_soon(read_now_and_then, here, rng)
                for name in (b"one", b"two"):
                    uploads.start_soon(upload, here, name, rng.randbytes(SMALL))


@pytest.mark.holds("promise 7")
async def test_of_two_uploads_none_waits_for_ever() -> None:
    """Each wait for the other's late requests to be dead counted as a turn, and began the wait anew after
    which it goes before readers: one of them was sent, the other did not get a byte in ten minutes."""
    here = Rig("ardupilot", FILES, BAD["mixing"])
    rng = random.Random(1)
    sources = [MemorySource(rng.randbytes(SIZE)) for _ in range(2)]
    async with here.connected(seed=1) as connection:
        connection.store.traits.wo_truncates = False
        for number, source in enumerate(sources):
            (connection.store.open_upload(here.root + b"/d/%d" % number, source)).wake()
        here.nursery.start_soon(read_now_and_then, here, rng)
        for _ in range(3):
            before = [source.proven.total for source in sources]
            await trio.sleep(60)
            for source, old in zip(sources, before, strict=True):
                assert source.proven.total > old or source.proven.total == SIZE


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize(
    ("count", "link", "most"),
    [
        # Who waited for the two others longer than service counts passed for a light user: each turn was as
        # long as opening the file again (347 s where it takes 176 by now).
        (3, replace(LINK, delay=0.3, loss=0.01, duplicate=0.02), 230),
        (2, replace(LINK, delay=0.15, loss=0.01), 46),
    ],
)
async def test_uploads_that_alternate_fill_a_short_queue(count: int, link: LinkSettings, most: float) -> None:
    here = Rig("ardupilot", FILES, link)
    began = trio.current_time()
    async with here.connected(), trio.open_nursery() as nursery:
        for number in range(count):
            data = content(60_000, number)
            nursery.start_soon(upload, here, b"%d" % number, data)
    assert trio.current_time() - began < most


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("times", [1, 99])
async def test_an_upload_that_was_refused_to_go_on_begins_once_more_and_the_next_one_is_asked(
    times: int,
) -> None:
    """One refusal says nothing of the server. If it refuses always, each upload asks once."""
    data = content(60_000)
    here = Rig("px4", FILES, PLAIN)
    async with here.connected() as connection:
        here.faults.refuse(Opcode.OPEN_FILE_WO, NakCode.FAIL_ERRNO, 5, times=times)
        for beginnings in (2, 1 if times == 1 else 2):
            async with under_way(connection, "px4", data) as source:
                await read_brief(here)
                assert not source.all_proven
            assert source.all_proven
            assert source.beginnings == beginnings
            assert here.data(b"/d/new") == data


# --- requests about other paths, on PX4's NuttX and elsewhere

PLAIN = LinkSettings(rate=20_000.0, delay=0.02)


@pytest.mark.holds("promise 4")
async def test_a_reader_waits_as_long_as_an_upload_moves_and_no_longer() -> None:
    here = Rig("mavsdk", {b"/d/old": b"hello"}, LinkSettings(rate=5_000.0, delay=0.05))
    async with here.connected() as connection, trio.open_nursery() as nursery:
        know(connection, "mavsdk")
        upload = await start(connection, "mavsdk", MemorySource(content(400_000)))

        async def finish() -> None:
            with pytest.raises(RequestTimeout):
                await upload.finish()

        nursery.start_soon(finish)
        await trio.sleep(1.5)
        sink = MemorySink(5)
        reader = await connection.store.open_reader(path("mavsdk", "old"), sink, expected_size=5)
        reader.want(0, 5, demand=True)
        await trio.sleep(2 * OP_DEADLINE)
        assert reader.awaited_since is not None
        here.faults.ignore(Opcode.WRITE_FILE)
        began = trio.current_time()
        assert await sink.wait_for(0, 5) == b"hello"
        assert trio.current_time() - began == pytest.approx(OP_DEADLINE, abs=2.0)
        reader.close()


@pytest.mark.holds("rule 14.24")
async def test_path_operations_beside_an_upload_on_nuttx() -> None:
    """Listing outside the card's whitelist makes PX4 refuse the next write (servers.md 8)."""
    data = content(60_000)
    here = Rig("px4-nuttx", {b"/d": None}, PLAIN)
    here.card.add(b"/etc/init.d/rcS", b"#")
    async with here.connected() as connection:
        async with under_way(connection, "px4-nuttx", data, seconds=0.5) as source:
            for _ in range(8):
                await connection.store.list_directory(b"/etc/init.d")
                await trio.sleep(0.3)
        assert source.all_proven
        assert source.rollbacks == 0
        refused = here.faults.refused.count(Opcode.WRITE_FILE)
        assert 1 <= refused < 30  # the first window only: after that, each knows its turn
    assert here.data(b"/d/new") == data


async def test_outside_the_whitelist_stays_refused() -> None:
    here = Rig("px4-nuttx", {b"/d": None})
    here.card.add_directory(b"/etc")
    async with here.connected() as connection:
        upload = connection.store.open_upload(b"/etc/new", MemorySource(b"hello"))
        with pytest.raises(FtpNak) as refusal:
            await upload.finish()
        assert (refusal.value.opcode, refusal.value.code) == (Opcode.WRITE_FILE, 9)
        assert here.count(Opcode.LIST_DIRECTORY) == 3, "the buffer was set right"
        await upload.end()
    assert here.server.open_sessions == 0


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("beside_a_copy", [False, True])
@pytest.mark.parametrize("count", [1, 2])
async def test_long_listings_one_after_the_other_leave_an_upload_on_nuttx_its_turn(
    count: int, beside_a_copy: bool
) -> None:
    """With two listings one is always in flight; beside a copy each turn begins beside a listing."""
    directories = [b"/l%d" % number for number in range(count)]
    files = {name + b"/a_long_name_of_a_log_%d.ulg" % i: b"" for name in directories for i in range(100)}
    files |= {b"/d/big": content(1_000_000)}
    here = Rig("px4-nuttx", files, LinkSettings(rate=5_000.0, delay=0.1))
    data = content(4_000)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        connection.engine.traits.paths_block_writes = True

        async def list_for_ever(directory: bytes) -> None:
            while True:
                await connection.store.list_directory(here.root + directory)

        if beside_a_copy:
            know(connection, "px4-nuttx")
            await begin_to_read(connection, path("px4-nuttx", "big"), 1000)
        for directory in directories:
            nursery.start_soon(list_for_ever, directory)
        await trio.sleep(1.0)
        with trio.fail_after(20):
            await put(connection, path("px4-nuttx", "new"), data)
        nursery.cancel_scope.cancel()
    assert here.data(b"/d/new") == data


@pytest.mark.holds("promise 7")
async def test_a_client_that_lists_beside_an_upload_on_nuttx_does_not_pass_for_a_protected_file() -> None:
    """The client's requests for paths take no turns with the upload, which is refused when it goes on."""
    data = content(40_000)
    here = Rig("px4-nuttx", {b"/d": None}, LinkSettings(rate=20_000.0, delay=0.1))
    here.card.add_directory(b"/etc")
    async with here.mounted(b"/d") as tree, trio.open_nursery() as nursery:
        nursery.start_soon(write_file, tree, b"/d/new", data)
        await trio.sleep(0.5)
        for _ in range(13):  # an answer each, one after the other
            here.another_asks(Opcode.LIST_DIRECTORY, b"/etc")
            await trio.sleep(0.2)
    assert here.data(b"/d/new") == data


@pytest.mark.parametrize("replaces", [False, True])
async def test_a_close_does_not_wait_for_another_upload_that_gives_no_way(replaces: bool) -> None:
    """The close asks a listing whether its name is still free, or which size is under it."""
    old = {b"/d/one": b"old", b"/d/two": b"old"} if replaces else {b"/d": None}
    async with rig("mavsdk", old, link=LinkSettings(rate=5_760.0, delay=0.05)) as here:
        tree = here.mount(verify_max=0)
        here.connection.store.traits.wo_truncates = True
        async with trio.open_nursery() as nursery:
            nursery.start_soon(write_file, tree, b"/d/one", content(100_000, 1))
            await trio.sleep(8)
            nursery.start_soon(write_file, tree, b"/d/two", content(400_000, 2))
        assert here.data(b"/d/one") == content(100_000, 1)
        assert here.data(b"/d/two") == content(400_000, 2)
