"""Suspect replies: their causes, and the comparisons while they last. Virtual time.

A suspect file is compared whatever its size, because the size proves nothing about bytes that were ACKed and
differ on the card: a late duplicate was executed, another client wrote, or the power failed.
"""

from __future__ import annotations

import errno
import random
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.quarantine import LASTS, LEAST_IF_REPEATED, MOST, UNKNOWN_LATENESS, Quarantine
from mavftpfs.session.scheduler import MAYBE_OPEN_CLOSE
from mavftpfs.shared.errors import MavftpfsError, NotVerified, RequestTimeout, SessionLost
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support import rigs
from tests.support.latecomers import Latecomer, come_again, come_late
from tests.support.rigs import KINDS, RENAMING, Rig, rig, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import MemorySink, begin_to_read, content, path, put, read_file

pytestmark = pytest.mark.holds("fault duplicate")

EVERY_PROFILE = sorted(PROFILES)
CLEAN = LinkSettings(delay=0.02)


async def test_distrust_lasts_for_ten_minutes() -> None:
    here = Rig("px4", {b"/d": None}, CLEAN)
    async with here.connected() as connection:
        store = connection.store
        assert not store.in_doubt()
        connection.scheduler.server.distrust(reads=False)
        at = trio.current_time()
        await trio.sleep(LASTS)
        assert store.in_doubt()
        await trio.sleep(0.1)
        assert not store.in_doubt()
        assert store.in_doubt(at - 0.1)
        assert not store.in_doubt(at)


def test_a_name_is_in_quarantine_where_duplicates_come_late() -> None:
    names = Quarantine()
    names.on_changed(b"/d/a", 0.0)
    assert names.left(b"/d/a", 0.0) == 0.0
    names.saw(0.02, 0.0)
    assert names.left(b"/d/A", 0.0) == 0.04
    assert names.left(b"/d/other", 0.0) == 0.0
    for seconds, expected in ((None, 2 * UNKNOWN_LATENESS), (4.0, 8.0), (2.0, 8.0), (40.0, MOST)):
        names.saw(seconds, 0.0)
        assert names.left(b"/d/a", 0.0) == expected
    assert names.left(b"/d/a", 9.0) == MOST - 9.0
    names.on_changed(b"/d/a", LASTS)
    assert names.left(b"/d/a", LASTS) == MOST
    assert names.left(b"/d/a", LASTS + 0.1) == 0.0, "none was late for ten minutes"


def test_the_largest_lateness_of_ten_minutes_counts() -> None:
    names = Quarantine()
    names.saw(5.0, 0.0)
    names.saw(3.0, 500.0)
    names.on_changed(b"/d/a", 601.0)
    assert names.left(b"/d/a", 601.0) >= 6.0
    names.saw(1.0, 500.0 + LASTS + 0.1)
    names.on_changed(b"/d/a", 500.0 + LASTS + 0.1)
    assert names.left(b"/d/a", 500.0 + LASTS + 0.1) == 2.0, "those before are forgotten"


def test_a_name_whose_request_was_repeated_is_in_quarantine_on_any_link() -> None:
    names = Quarantine()
    for took, expected in ((0.1, LEAST_IF_REPEATED), (2.0, 4.0), (30.0, MOST)):
        names.on_changed(b"/d/a", 0.0, took)
        assert names.left(b"/d/A", 0.0) == expected
    names.on_changed(b"/d/a", 4.0)
    assert names.left(b"/d/a", 4.0) == MOST - 4.0, "a later change does not cut it short"
    assert names.left(b"/d/other", 0.0) == 0.0


async def seconds_of_changes(duplicate: float) -> float:
    """Return how long it takes to change a file twenty times."""
    link = LinkSettings(delay=0.005, duplicate=duplicate)
    async with rig("px4-2026", {b"/d/f": content(50_000)}, link=link) as here:
        tree = here.mount()
        began = trio.current_time()
        for number in range(20):
            await write_file(tree, b"/d/f", content(50_000, number))
        assert here.data(b"/d/f") == content(50_000, 19)
        return trio.current_time() - began


@pytest.mark.holds("fault duplicate")
async def test_doubled_packets_do_not_make_changing_a_file_slow() -> None:
    assert await seconds_of_changes(0.01) <= 2 * await seconds_of_changes(0.0)


def test_few_names_are_remembered() -> None:
    names = Quarantine()
    for number in range(1000):
        names.on_changed(b"/%d" % number, float(number))
    assert len(names._changed) == MOST + 1


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_neither_a_clean_link_nor_our_own_repetitions_raise_it(profile: str, loss: float) -> None:
    here = Rig(profile, {b"/d/f": content(20_000)}, LinkSettings(delay=0.02, loss=loss))
    async with here.connected() as connection:
        await read_file(connection, path(profile, "f"))
        await put(connection, path(profile, "new"), content(20_000))
        await connection.store.remove(path(profile, "new"))
        assert connection.engine.stats.lost or not loss
        assert loss or not connection.store.in_doubt()


async def test_an_answer_that_comes_twice_raises_it() -> None:
    here = Rig("px4", {b"/d": None}, CLEAN)
    async with here.connected() as connection:
        began = trio.current_time()
        Latecomer(here, Opcode.CREATE_DIRECTORY, after=Opcode.REMOVE_DIRECTORY)
        await connection.store.make_directory(b"/d/one")
        await trio.sleep(3)
        assert not connection.store.in_doubt()
        await connection.store.remove_directory(b"/d/one")
        await trio.sleep(0.1)
        assert connection.store.in_doubt()
        assert connection.store.in_doubt(began)
        assert 6 < connection.scheduler.server.quarantine.left(b"/d/one", trio.current_time()) < 8


@pytest.mark.holds("rule 14.12")
async def test_what_another_client_does_decides_whether_bytes_are_in_doubt() -> None:
    """The first that is heard of it, because earlier requests may have been missed, and what uses the session
    that all share; once for what was read by then. An open tells by its answer."""
    data = content(200_000)
    here = Rig("px4", {b"/d/f": data}, LinkSettings(rate=5_000.0, delay=0.02))
    async with here.connected() as connection:
        reader, _ = await begin_to_read(connection, b"/d/f", 5_000)

        async def doubts(opcode: Opcode, pause: float = 0.0) -> bool:
            await trio.sleep(pause)
            epoch = connection.store.epoch
            here.another_asks(opcode, b"/")
            await trio.sleep(1.0)
            return connection.store.epoch > epoch

        assert await doubts(Opcode.LIST_DIRECTORY)
        assert not await doubts(Opcode.LIST_DIRECTORY)
        assert await doubts(Opcode.READ_FILE)
        assert not await doubts(Opcode.READ_FILE), "the mount's file was closed"
        assert not await doubts(Opcode.TERMINATE_SESSION)
        assert not await doubts(Opcode.LIST_DIRECTORY, 3.0)
        assert await doubts(Opcode.LIST_DIRECTORY, 11.0)
        assert not await doubts(Opcode.OPEN_FILE_RO, 11.0), "the server refuses it"
        reader.close()


async def test_a_session_that_vanished_raises_it() -> None:
    data = content(200_000)
    here = Rig("px4", {b"/d/f": data}, LinkSettings(rate=50_000.0, delay=0.02))
    async with here.connected() as connection:
        reader, sink = await begin_to_read(connection, b"/d/f", 10_000)
        began = trio.current_time()
        here.another_asks(Opcode.RESET_SESSIONS)
        assert await sink.wait_for(0, len(data)) == data
        assert connection.store.in_doubt()
        assert connection.store.epoch >= began
        reader.close()


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk"])
async def test_an_at_file_is_written_no_further_once_another_client_opened_a_file(profile: str) -> None:
    """The news and an ACK come together; the next WriteFile would change the other client's file."""
    here = Rig(profile, {b"/d/theirs": b"theirs"}, CLEAN)
    async with here.connected() as connection:
        opens = partial(here.another_asks, Opcode.CREATE_FILE, path(profile, "theirs"))
        here.faults.at(Opcode.WRITE_FILE, opens, nth=5)
        with pytest.raises(SessionLost):
            await connection.store.write_whole(path(profile, "x"), [content(200)] * 50)
        await trio.sleep(1.0)
        assert here.count(Opcode.WRITE_FILE) == 5


async def read_or_doubt(connection: Connection, target: bytes, expected: bytes) -> None:
    """Read a file; other bytes than its own are provisional by then."""
    sink, epoch = MemorySink(len(expected)), connection.store.epoch
    reader = await connection.store.open_reader(target, sink)
    reader.want(0, reader.size, demand=True)
    data = await sink.wait_for(0, reader.size)
    await trio.sleep(1)
    assert data == expected or connection.store.epoch > epoch
    reader.close()


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize(
    ("after", "nth"),
    [*((Opcode.READ_FILE, nth) for nth in (8, 9, 12)), (Opcode.OPEN_FILE_RO, 1)],
)
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_late_open_of_another_file_gives_no_wrong_bytes(
    profile: str, after: Opcode, nth: int
) -> None:
    """MAVSDK closes what is open and opens that one, under the same id; files of one size hide it. Right
    behind our open both answers come at once, before the task that opened the file goes on."""
    one, two = content(1500, 1), content(1500, 2)
    here = Rig(profile, {b"/d/one": one, b"/d/two": two}, CLEAN)
    async with here.connected() as connection:
        connection.engine.flow = Flow(limit=1)
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=after, nth=nth, first=True)
        assert await read_file(connection, path(profile, "one")) == one
        if after is Opcode.OPEN_FILE_RO:
            assert await read_file(connection, path(profile, "two")) == two
        else:
            await read_or_doubt(connection, path(profile, "two"), two)
        assert copy.late is not None
        await trio.sleep(8)
        assert connection.scheduler.server.opened is None


@pytest.mark.holds("fault leaving")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_a_late_open_left_open_does_not_lock_us_out(profile: str) -> None:
    here = Rig(profile, {b"/d/one": content(1500, 1), b"/d/two": content(1500, 2)}, CLEAN)
    async with here.connected() as connection:
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.TERMINATE_SESSION)
        await read_file(connection, path(profile, "one"))
        await trio.sleep(3)
        assert copy.late is not None
        began = trio.current_time()
        assert await read_file(connection, path(profile, "two")) == content(1500, 2)
        assert trio.current_time() - began < 1


@pytest.mark.holds("fault leaving")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_a_late_open_left_open_is_closed_although_nobody_asks_for_a_file(profile: str) -> None:
    """Its ACK comes together with that of the Terminate before, which closed the file of an earlier open."""
    here = Rig(profile, {b"/d/one": content(1500, 1)}, CLEAN)
    async with here.connected() as connection:
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.TERMINATE_SESSION)
        await read_file(connection, path(profile, "one"))
        await trio.sleep(3 + MAYBE_OPEN_CLOSE)
        assert copy.late is not None
        assert here.server.open_sessions == 0


async def test_who_waits_for_a_turn_is_not_timed_out() -> None:
    """120 programs read at once over a round trip of 150 ms: the last one waits longer than a read may."""
    files = {b"/f%d" % number: content(2000, number) for number in range(120)}
    ended: list[float] = []
    async with Rig("px4", files, LinkSettings(delay=0.075)).mounted(b"/") as tree:
        opened = {path: await tree.open(path) for path in files}

        async def read(path: bytes) -> None:
            assert await opened[path].read(0, 2000) == files[path]
            ended.append(trio.current_time())

        async with trio.open_nursery() as readers:
            for path in files:
                readers.start_soon(read, path)
    assert len(ended) == 120
    assert ended[-1] - ended[0] > ConnectOptions().op_deadline


# --- bytes that were ACKed and are not on the card


OPCODE = 3

READY = 0.011
"""Seconds before ArduPilot looks at its queue."""

FORGOTTEN = 400
"""Bytes that a card loses with the power: less than a sector."""

SWIFTEST = 2.5
"""No vehicle restarts twice in so many seconds."""


@pytest.mark.holds("rule 14.12")
async def test_a_create_that_we_repeated_comes_after_the_file_was_compared() -> None:
    """The answer to the copy that empties what was compared gets lost, so there is no doubt."""
    here = Rig("px4", {b"/d": None}, CLEAN)
    async with here.mounted(b"/d") as tree:
        here.connection.store.traits.rename_works = True  # else an empty file of ours finds that out first
        copy = Latecomer(here, Opcode.CREATE_FILE, after=Opcode.CALC_FILE_CRC32)
        here.faults.lose_reply_to(Opcode.CREATE_FILE)
        here.faults.at(Opcode.CALC_FILE_CRC32, lambda: here.faults.lose_reply_to(Opcode.CREATE_FILE))
        await write_file(tree, b"/d/new", content(300))
        assert copy.late is not None
        assert not here.connection.store.in_doubt()
        assert here.card.data(b"/d/new") == content(300)


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("lateness", [0.2, 0.4, 0.8])
async def test_nor_does_it_empty_a_file_that_has_its_final_name_at_once(lateness: float) -> None:
    """The card cannot rename, so nothing would compare the file again."""
    async with rig("littlefs", {b"/d/k": b"x"}, link=LinkSettings(delay=0.01)) as here:
        tree = here.mount()
        await write_file(tree, b"/d/first", content(300, 1))  # that is known from now on
        came = come_late(here, lateness, Opcode.CREATE_FILE)
        await write_file(tree, b"/d/new", content(300, 2))
        await came.wait()
        await trio.sleep(READY)
        assert here.data(b"/d/new") == content(300, 2)


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("verify_max", [1 << 20, 0])
@pytest.mark.parametrize("after", [Opcode.CALC_FILE_CRC32, Opcode.OPEN_FILE_RO, Opcode.TERMINATE_SESSION])
@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_a_create_that_the_network_repeats_after_the_file_was_compared(
    profile: str, after: Opcode, verify_max: int
) -> None:
    """The duplicate is the first suspicious sign, and the file is empty when it gets its name."""
    async with rig(profile, {b"/d/k": b"x"}, link=CLEAN) as here:
        tree = here.mount(verify_max=verify_max)
        await write_file(tree, b"/d/first", content(300, 1))  # the server renames, as is known from now on
        copy = Latecomer(here, Opcode.CREATE_FILE, after=after)
        with suppress(SessionLost):  # MAVSDK: the copy took the session in which the size was asked for
            await write_file(tree, b"/d/new", content(300))
        assert await tree.drain(60) == []
        assert here.data(b"/d/new") == content(300)
        assert copy.late is not None or (verify_max, after) == (0, Opcode.CALC_FILE_CRC32)
        assert await read_all(tree, b"/d/new") == content(300)


async def read_all(tree: Tree, target: bytes) -> bytes:
    """Read a file by a mount that remembers nothing."""
    tree.forget_caches()
    return await rigs.read_file(tree, target)


@pytest.mark.holds("promise 3", "rule 14.12")
@pytest.mark.parametrize("known", [False, True], ids=["first", "known"])
@pytest.mark.parametrize(
    ("what", "after", "nth", "first"),
    [
        # What moved the old file aside comes when the new one is there.
        (Opcode.RENAME, Opcode.RENAME, 1, True),
        (Opcode.RENAME, Opcode.RENAME, 1, False),
        (Opcode.RENAME, Opcode.REMOVE_FILE, 1, True),
        (Opcode.RENAME, Opcode.REMOVE_FILE, 1, False),
        (Opcode.REMOVE_FILE, Opcode.RENAME, 2, True),
        (Opcode.CREATE_FILE, Opcode.RENAME, 1, False),
        (Opcode.CREATE_FILE, Opcode.RENAME, 2, False),
    ],
)
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot5"])
async def test_a_late_rename_or_remove_never_loses_old_and_new(
    profile: str, what: Opcode, after: Opcode, nth: int, first: bool, known: bool
) -> None:
    """The file is replaced, removed and made again; at each moment one of its contents is on the card."""
    async with rig(profile, {b"/d/f": content(500, 1), b"/d/g": b""}, link=CLEAN) as here:
        tree = here.mount()
        await write_file(tree, b"/d/g", b"x")  # what the card can is known from now on
        if known:
            here.connection.scheduler.server.distrust(reads=True)
            here.connection.scheduler.server.quarantine.saw(0.5, trio.current_time())
        Latecomer(here, what, after=after, nth=nth, first=first)
        wanted = content(500, 1)
        for number in (2, 3):
            wanted, before = content(500, number), wanted
            await write_file(tree, b"/d/f", wanted)
            assert wanted in here.files().values(), before
        for _ in range(2):
            await trio.sleep(12.0)
            await rigs.list_all(here, tree)
        assert await read_all(tree, b"/d/f") == wanted == here.data(b"/d/f")
        await tree.unlink(b"/d/f")
        await write_file(tree, b"/d/f", content(400, 4))
        for _ in range(2):
            await trio.sleep(12.0)
            await rigs.list_all(here, tree)
        assert here.data(b"/d/f") == content(400, 4)
        assert here.litter() == []


@pytest.mark.holds("promise 3", "rule 14.12")
@pytest.mark.parametrize("known", [False, True], ids=["first", "known"])
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_a_rename_that_comes_after_all_waiting_is_mended_unasked(profile: str, known: bool) -> None:
    """The rename that moved the old file aside takes the new one away 5 s later. No program lists the
    directory."""
    async with rig(profile, {b"/d/f": content(500, 1), b"/d/g": b""}, link=CLEAN) as here:
        tree = here.mount()
        await write_file(tree, b"/d/g", b"x")  # what the card can is known from now on
        if known:
            here.connection.scheduler.server.distrust(reads=True)
            here.connection.scheduler.server.quarantine.saw(0.1, trio.current_time())
        renames: list[bytes] = []

        def is_first(wire: bytes) -> bool:
            if wire[OPCODE] == Opcode.RENAME:
                renames.append(wire)
            return wire[OPCODE] == Opcode.RENAME and len(renames) == 1

        come_again(here, 5.0, is_first)
        await write_file(tree, b"/d/f", content(500, 2))
        await trio.sleep(30.0)
        assert here.data(b"/d/f") == content(500, 2)
        assert here.litter() == []


@pytest.mark.holds("promise 3", "rule 14.12")
async def test_the_old_file_is_removed_only_when_the_new_one_is_seen() -> None:
    """The copy comes right behind the second rename. What lay aside was removed then, and was the new
    file by that time."""
    async with rig("px4-nuttx", {b"/d/f": content(500, 1), b"/d/g": content(500, 2)}, link=CLEAN) as here:
        tree = here.mount()
        await write_file(tree, b"/d/k", b"x")
        here.connection.scheduler.server.distrust(reads=True)
        here.connection.scheduler.server.quarantine.saw(0.1, trio.current_time())
        await tree.list(b"/d")
        copy = Latecomer(here, Opcode.RENAME, after=Opcode.RENAME, first=True)
        await tree.rename(b"/d/g", b"/d/f")
        await trio.sleep(30.0)
        assert copy.late is not None
        assert here.files() == {b"/d/f": content(500, 2), b"/d/k": b"x"}


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_an_older_file_never_gets_the_name_while_the_next_is_placed(profile: str, moves: bool) -> None:
    """The first replacement left its old file aside, and the vehicle refused to remove that. The directory is
    listed when the second one has moved the name's file aside, and its next request is lost three times."""
    async with rig(profile, {b"/d/f": content(500, 1), b"/d/g": content(500, 3)}, link=CLEAN) as here:
        tree = here.mount()
        await write_file(tree, b"/d/k", b"x")  # what the card can is known from now on
        here.connection.scheduler.server.distrust(reads=True)
        await write_file(tree, b"/d/f", content(500, 2))
        here.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, errno.EACCES, times=100)
        await trio.sleep(11.0)
        here.faults.call_off()
        assert len(here.litter()) == 1

        async def list_directory() -> None:
            tree.forget_caches()
            await tree.list(b"/d")

        here.faults.at(Opcode.RENAME, lambda: here.nursery.start_soon(list_directory))
        here.faults.at(Opcode.RENAME, lambda: None, nth=2, times=3, drop=True)
        if moves:
            await tree.rename(b"/d/g", b"/d/f")
        else:
            await write_file(tree, b"/d/f", content(500, 3))
        assert here.data(b"/d/f") == content(500, 3)
        await trio.sleep(30.0)
        assert here.data(b"/d/f") == content(500, 3)
        assert here.litter() == []


@pytest.mark.holds("promise 2", "rule 14.12")
@pytest.mark.parametrize(
    ("profile", "every", "late"),
    [
        ("littlefs", 1, 0.5),
        *((profile, 1, 0.5) for profile in RENAMING),
        *((profile, 2, late) for profile in RENAMING for late in (0.1, 0.3, 0.5, 2.0)),
    ],
)
async def test_copies_of_a_create_and_of_its_rename_both_late(profile: str, every: int, late: float) -> None:
    """Together they would put an empty file under the name: over two radios of which one loses the bytes, or
    where all that concerns a file, or every other one, comes twice."""
    async with rig(profile, {b"/d/k": b"x"}, link=CLEAN) as here:
        made: dict[bytes, int] = {}

        def is_doubled(wire: bytes) -> bool:
            target = wire[12 : 12 + wire[4]].split(b"\0")[0]
            if wire[OPCODE] == Opcode.CREATE_FILE:
                made.setdefault(target, len(made))
            unless_of_a_file = 0 if every == 1 else 1
            return wire[OPCODE] == Opcode.CREATE_DIRECTORY or not made.get(target, unless_of_a_file) % every

        come_again(here, late, is_doubled)
        tree = here.mount()
        await tree.mkdir(b"/d/sub")
        await trio.sleep(5.0)  # the copy was seen
        for number in range(5):
            await write_file(tree, b"/d/new%d" % number, content(300 + number, number))
        await trio.sleep(5.0)
        for number in range(5):
            assert here.data(b"/d/new%d" % number) == content(300 + number, number)


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("verify_max", [1 << 20, 0])
@pytest.mark.parametrize("profile", taking_turns(KINDS))
async def test_a_late_write_of_one_file_in_the_next(profile: str, verify_max: int) -> None:
    async with rig(profile, {b"/d/k": b"x"}, link=CLEAN) as here:
        tree = here.mount(verify_max=verify_max)
        await write_file(tree, b"/d/one", content(200, 1))
        await write_file(tree, b"/d/one2", content(200, 1))
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, nth=1, first=True)
        await write_file(tree, b"/d/two", content(200, 2))
        await write_file(tree, b"/d/three", content(200, 3))
        assert copy.late is not None
        for name, number in ((b"two", 2), (b"three", 3)):
            assert here.data(b"/d/" + name) == content(200, number)


@pytest.mark.holds("promise 2", "rule 14.12")
@pytest.mark.parametrize("lateness", [0.24, 0.4, 0.8])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_a_change_of_a_name_that_we_repeated_comes_late(
    profile: str, moves: bool, lateness: float
) -> None:
    """The repetition was ACKed, and the name has a new file."""
    async with rig(profile, {b"/d/f": content(500, 1)}, link=LinkSettings(delay=0.01)) as here:
        tree = here.mount()
        await tree.list(b"/d")
        came = come_late(here, lateness, Opcode.RENAME if moves else Opcode.REMOVE_FILE)
        if moves:
            await tree.rename(b"/d/f", b"/d/f~")
        else:
            await tree.unlink(b"/d/f")
        await write_file(tree, b"/d/f", content(400, 2))
        assert came.is_set()
        assert here.data(b"/d/f") == content(400, 2)


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("lateness", [0.15, 0.4, 0.8])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_a_change_of_a_name_whose_caller_was_cancelled_comes_late(
    profile: str, moves: bool, lateness: float
) -> None:
    here = Rig(profile, {b"/d/f": content(500, 1)}, LinkSettings(delay=0.01))
    name = path(profile, "f")
    async with here.connected() as connection:
        came = come_late(here, lateness, Opcode.RENAME if moves else Opcode.REMOVE_FILE)
        with trio.move_on_after(0.002):
            if moves:
                await connection.store.rename(name, path(profile, "f~"))
            else:
                await connection.store.remove(name)
        await put(connection, name, content(400, 2))
        await came.wait()
        await trio.sleep(READY)
        assert here.card.data(name) == content(400, 2)


@pytest.mark.holds("promise 2")
async def test_a_removal_without_an_answer_comes_late() -> None:
    here = Rig("px4", {b"/d/f": content(500, 1)}, LinkSettings(delay=0.01))
    name = path("px4", "f")
    async with here.connected(ConnectOptions(op_deadline=3.0)) as connection:
        came = come_again(here, 4.0, lambda wire: wire[OPCODE] == Opcode.REMOVE_FILE, at_once=False)
        with pytest.raises(RequestTimeout):
            await connection.store.remove(name)
        await put(connection, name, content(400, 2))
        await came.wait()
        await trio.sleep(READY)
        assert here.card.data(name) == content(400, 2)


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize(
    ("profile", "delay", "latenesses"),
    [
        ("px4-2026", 0.01, (0.18, 0.19)),
        ("mavsdk", 0.01, (0.18, 0.19)),
        ("mavsdk", 0.1, (1.3, 1.4)),
        ("ardupilot5", 0.1, (1.75, 1.8)),
    ],
)
async def test_an_open_that_we_repeated_comes_late(
    profile: str, delay: float, latenesses: tuple[float, ...]
) -> None:
    """The late open puts its file in place of the one that is read."""
    files = {b"/d/one": content(60_000, 1), b"/d/two": content(60_000, 2)}
    for lateness in latenesses:
        async with rig(profile, files, link=LinkSettings(delay=delay)) as here:
            tree = here.mount()
            await tree.list(b"/d")
            assert await rigs.read_file(tree, b"/d/one") == files[b"/d/one"]
            tree.forget_caches()
            come_late(here, lateness, Opcode.OPEN_FILE_RO)
            for name, data in files.items():
                assert await rigs.read_file(tree, name) == data


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("lateness", [0.03, 0.04, 0.07])
@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk", "ardupilot5"])
async def test_an_open_whose_caller_was_cancelled_comes_late(profile: str, lateness: float) -> None:
    """Before it would have been repeated. ArduPilot refuses the next open then."""
    files = {b"/d/one": content(20_000, 1), b"/d/two": content(20_000, 2)}
    async with rig(profile, files, link=LinkSettings(delay=0.01)) as here:
        connection = here.connection
        await connection.store.stat_size(path(profile, "one"))
        came = come_late(here, lateness, Opcode.OPEN_FILE_RO)
        with trio.move_on_after(0.002):
            await connection.store.stat_size(path(profile, "one"))
        await read_or_doubt(connection, path(profile, "two"), files[b"/d/two"])
        assert came.is_set()


@pytest.mark.holds("rule 14.39")
@pytest.mark.parametrize(("profile", "leaves"), [("px4", False), ("px4-2026", True), ("px4-nuttx", True)])
async def test_another_clients_file_took_the_bytes(profile: str, leaves: bool) -> None:
    """PX4 has one session, 0, for all clients: our ACKs may be for the other one's file."""
    here = Rig(profile, {b"/d/f": b"x" * 130_000}, CLEAN)
    new = bytes(range(1, 240)) * 500
    async with here.mounted(b"/d", verify_max=0) as tree:
        file = await tree.open(b"/d/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()

        def take() -> None:
            here.another_asks(Opcode.RESET_SESSIONS, heard=False)
            here.another_asks(Opcode.CREATE_FILE, here.root + b"/d/theirs", heard=False)
            here.connection.vehicle.on_another_client(bytes(251))

        here.faults.at(Opcode.WRITE_FILE, take, nth=100)
        if leaves:
            leave = partial(here.another_asks, Opcode.TERMINATE_SESSION, heard=False)
            here.faults.at(Opcode.WRITE_FILE, leave, nth=200)
        await file.write(0, new)
        for _ in range(3):  # it may be told that the session is shared just now
            try:
                await file.flush()
            except MavftpfsError:
                await trio.sleep(20)
                continue
            break
        else:
            pytest.fail("it never ended well")
        assert here.data(b"/d/f") == new + b"x" * (130_000 - len(new))
        file.close()


@pytest.mark.parametrize(
    ("profile", "downtime", "beat_after"),
    [("px4", 0.0, 0.0), ("px4-nuttx", 3.0, 0.0), ("ardupilot", 4.0, 0.9), ("px4", 12.0, 0.9)],
)
async def test_the_power_went_between_the_last_answer_and_the_close(
    profile: str, downtime: float, beat_after: float
) -> None:
    """The last sector was in its memory. Who restarted may ACK the Terminate, too, before we hear of that."""
    async with rig(profile, {b"/d/f": b"x" * 30_000}, link=CLEAN) as here:
        tree = here.mount(verify_max=0)
        await tree.list(b"/d")
        file = await tree.open(b"/d/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()
        await trio.sleep(30)
        before = here.data(b"/d/f")
        await file.write(1000, b"B" * 100)

        def power_cut() -> None:
            [path] = here.server.open_paths
            data = here.card.data(path)
            here.vehicle.reboot(trio.current_time(), downtime, beat_after=beat_after)
            here.card.add(path, data[:-FORGOTTEN] + bytes(FORGOTTEN))

        here.faults.at(Opcode.TERMINATE_SESSION, power_cut, drop=True)
        await file.fsync()
        assert here.data(b"/d/f") == before[:1000] + b"B" * 100 + before[1100:]
        file.close()


@pytest.mark.holds("promise 2", "fault killed program")
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 60))])
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_fsync_is_true_though_the_vehicle_restarts_at_any_request(profile: str, seed: int) -> None:
    """FAT has a sector in memory until the file is closed."""
    rng = random.Random(seed)
    settings = LinkSettings(delay=rng.choice([0.02, 0.1, 0.4]), loss=rng.choice([0.0, 0.05]))
    model, last = bytearray(rng.randbytes(20_000)), -SWIFTEST
    here = Rig(profile, {b"/d/f": bytes(model)}, settings, seed=seed)
    async with here.mounted(verify_max=rng.choice([1 << 20, 0])) as tree:
        file = await tree.open(b"/d/f", write=True)
        for _ in range(12):
            await trio.sleep(rng.uniform(1, 40))
            for _ in range(rng.randrange(1, 4)):
                at, data = rng.randrange(19_000), rng.randbytes(rng.choice([1, 50, 300, 900]))
                model[at : at + len(data)] = data
                await file.write(at, data)
            downtime, beat_after = rng.choice([(0.0, 0.0), (2.6, 0.5), (3.0, 0.9), (5.0, 0.0), (9.0, 0.9)])

            def restart(downtime: float = downtime, beat_after: float = beat_after) -> None:
                nonlocal last
                if trio.current_time() - last >= SWIFTEST:  # else one that was left from before just struck
                    last = trio.current_time()
                    here.vehicle.reboot(last, downtime, beat_after=beat_after)

            here.faults.after(rng.randrange(1, 14), restart)
            for _ in range(8):
                try:
                    await file.fsync()
                    break
                except MavftpfsError:
                    await trio.sleep(10)
            assert here.data(b"/d/f") == bytes(model)
        file.close()


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("told", ["nothing", "a refusal"])
async def test_in_doubt_a_file_waits_for_its_checksum(told: str) -> None:
    """A byte is wrong on the card. Without a checksum nobody says that the file is there."""
    data = bytes(range(1, 240)) * 300
    async with rig("px4", {b"/d/f": b"x"}, link=CLEAN) as here:
        tree = here.mount(op_deadline=5.0)
        here.connection.store.traits.rename_works = True  # else an empty file of ours finds that out first
        here.connection.scheduler.server.distrust(reads=True)

        def spoil() -> None:
            here.put(here.litter()[0], data[:70_000] + b"?" + data[70_001:])

        here.faults.at(Opcode.CALC_FILE_CRC32, spoil)
        if told == "nothing":
            here.faults.ignore(Opcode.CALC_FILE_CRC32)
        else:
            here.faults.refuse(Opcode.CALC_FILE_CRC32, NakCode.UNKNOWN_COMMAND, times=1000)
        with pytest.raises(RequestTimeout if told == "nothing" else NotVerified):
            await write_file(tree, b"/d/new", data)
        await trio.sleep(60)
        assert b"/d/new" not in here.files()
        assert tree.undelivered() == [b"/d/new"]
        assert here.count(Opcode.CREATE_FILE) == 1
        here.faults.call_off()
        assert await tree.drain(200) == []
        assert here.data(b"/d/new") == data
        assert here.count(Opcode.CREATE_FILE) == 2
        assert tree.status()["verified_by_crc"] == 2, "once more under its own name"


def delay(here: Rig, chosen: Callable[[bytes], bool], writes: int) -> None:
    """Have the first transmission of a chosen request arrive late: after so many WriteFiles."""
    handle, held, left = here.server.handle, list[tuple[bytes, Address]](), writes

    def arrive(wire: bytes, source: Address, now: float) -> None:
        nonlocal left
        if not held and chosen(wire):
            held.append((wire, source))
            return
        handle(wire, source, now)
        left -= wire[3] == Opcode.WRITE_FILE
        if left == 0 and held:
            left = -1
            handle(*held[0], now)
            here.link.kick()

    here.server.handle = arrive  # type: ignore[method-assign]


@pytest.mark.holds("promise 2")
async def test_a_file_that_may_have_been_emptied_while_it_was_sent_is_compared() -> None:
    """Later writes hide it from the size; the server's ACK is explained by our repetition."""
    data = content(300_000)
    async with rig("mavsdk", {b"/d/f": b"x"}, link=CLEAN) as here:
        tree = here.mount(verify_max=1000)
        here.connection.store.traits.rename_works = True
        delay(here, lambda wire: wire[3] == Opcode.CREATE_FILE, 300)
        await write_file(tree, b"/d/new", data)
        assert here.data(b"/d/new") == data


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("profile", ["px4", "ardupilot5", "mavsdk"])
async def test_a_write_that_arrives_in_the_next_file_is_noticed(profile: str) -> None:
    """The repetition of the WriteFile explains its ACK. Both files had the same session id."""
    one, two = content(20_000, 1), content(300_000, 2)
    async with rig(profile, {b"/d/f": b"x"}, link=CLEAN) as here:
        tree = here.mount(verify_max=1000)
        here.connection.store.traits.rename_works = True
        at = (20 * 239).to_bytes(4, "little")
        delay(here, lambda wire: wire[3] == Opcode.WRITE_FILE and wire[8:12] == at, 400)
        await write_file(tree, b"/d/one", one)
        assert not here.connection.store.in_doubt()
        await write_file(tree, b"/d/two", two)
        assert (here.data(b"/d/one"), here.data(b"/d/two")) == (one, two)


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot5", "littlefs", "mavsdk"])
async def test_doubt_costs_a_new_file_one_comparison(profile: str) -> None:
    """The link doubles 2 % of its packets, at once. Forty small files took a second each."""

    async def forty(duplicate: float) -> float:
        link = LinkSettings(delay=0.01, duplicate=duplicate)
        async with rig(profile, {b"/d/k": b"x"}, link=link) as here:
            tree = here.mount()
            await tree.list(b"/d")
            began = trio.current_time()
            for number in range(40):
                await write_file(tree, b"/d/%d" % number, content(600, number))
            assert here.connection.store.in_doubt() == bool(duplicate)
            return trio.current_time() - began

    comparison = 0.02 + READY
    assert await forty(0.02) <= await forty(0.0) + 40 * comparison + 0.3


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("opcode", [Opcode.RENAME, Opcode.REMOVE_FILE])
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "ardupilot5", "mavsdk"])
async def test_a_change_of_names_that_comes_after_its_quarantine_is_a_reason_for_doubt(
    profile: str, opcode: Opcode
) -> None:
    here = Rig(profile, {b"/d/y": content(4000)}, LinkSettings(delay=0.02))
    async with here.connected() as connection:
        store, y = connection.store, path(profile, "y")
        await store.list_directory(path(profile, "")[:-1])
        came = come_late(here, 2.0, opcode)  # the first transmission; the second one is answered at once
        await (store.rename(y, path(profile, "w")) if opcode is Opcode.RENAME else store.remove(y))
        await put(connection, y, content(4500, 1))
        assert not store.in_doubt()
        await came.wait()
        await trio.sleep(0.1)
        assert y in here.files() or store.in_doubt()


@pytest.mark.holds("rule 14.38")
@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk"])
async def test_a_long_way_is_no_proof_that_listings_have_no_times(profile: str) -> None:
    here = Rig(profile, {b"/d/a": b"x"}, LinkSettings(delay=1.4))
    async with here.connected() as connection:
        for _ in range(3):
            await connection.store.list_directory(path(profile, "")[:-1])
        assert connection.store.traits.lists_times
