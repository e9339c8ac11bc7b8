"""The server's one session: what it costs, and what is done when it is taken, lost or somebody else's.

Against every profile, on virtual time.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import inf

import pytest
import trio

from mavftpfs.client.connect import _list_root
from mavftpfs.link.messages import Address
from mavftpfs.protocol.operations import OpenRequest, Simple
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.others import LEFT_OPEN
from mavftpfs.session.remedies import SILENCE_ARDUPILOT, SILENCE_PX4
from mavftpfs.session.scheduler import SessionUser
from mavftpfs.session.serversession import STALL
from mavftpfs.session.store import TIME_PROBE_LIMIT
from mavftpfs.shared.errors import (
    FileChanged,
    FtpNak,
    NoFtp,
    RequestTimeout,
    SessionBusy,
    SessionLost,
    VehicleLost,
)
from mavftpfs.shared.options import Options
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import STATION
from tests.support.rigs import DEFAULTS, Rig, rig
from tests.support.takingturns import taking_turns
from tests.support.transfers import (
    MemorySink,
    begin_to_read,
    content,
    path,
    put,
    read_file,
)

EVERY_PROFILE = sorted(PROFILES)
BAD = LinkSettings(rate=60_000.0, delay=0.02, loss=0.1, duplicate=0.02, reorder=0.05)


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_small_file_costs_open_transfer_terminate(profile: str) -> None:
    here = Rig(profile, {b"/d/small": b"hello"})
    async with here.connected() as connection:
        assert await read_file(connection, path(profile, "small")) == b"hello"
        await trio.sleep(5)
        costs = {Opcode.OPEN_FILE_RO: 1, Opcode.READ_FILE: 1, Opcode.TERMINATE_SESSION: 1}
        assert Counter(here.faults.requests) == costs
        await put(connection, path(profile, "new"), b"hello")
        costs |= {Opcode.CREATE_FILE: 1, Opcode.WRITE_FILE: 1, Opcode.TERMINATE_SESSION: 2}
        assert Counter(here.faults.requests) == costs
        assert here.server.open_sessions == 0


@pytest.mark.holds("rule 14.7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_several_files_at_once_share_the_session(profile: str) -> None:
    files = {b"/d/f%d" % index: content(20_000, index) for index in range(5)}
    here = Rig(profile, files, BAD)
    got: dict[bytes, bytes] = {}
    most_open = 0
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def fetch(name: bytes) -> None:
            nonlocal most_open
            got[name] = await read_file(connection, here.root + name)
            most_open = max(most_open, here.server.open_sessions)

        for name in files:
            nursery.start_soon(fetch, name)
    assert got == files
    assert most_open == 1, "also where the server has more"
    assert here.server.open_sessions == 0


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_is_asked_for_as_the_last_bytes_come_goes_out_at_once(profile: str) -> None:
    """The request may arrive before the task with the session has noticed that nothing is left to do."""
    rtt, step, steps = 0.1, 239, 60
    here = Rig(profile, {b"/d/f": content(steps * step)}, LinkSettings(rate=1e6, delay=rtt / 2))
    async with here.connected() as connection:
        sink = MemorySink(steps * step)
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        began = trio.current_time()
        for start in range(0, steps * step, step):
            reader.want(start, start + step, demand=True)
            await sink.wait_for(start, start + step)
        assert trio.current_time() - began < 1.2 * steps * rtt
        reader.close()


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_one_small_file_after_another_does_not_stop_a_copy(profile: str) -> None:
    small = {b"/d/s%d" % index: bytes([index]) * 100 for index in range(200)}
    here = Rig(profile, {b"/d/big": content(1_200_000), **small}, LinkSettings(rate=60_000.0, delay=0.015))
    async with here.connected() as connection, trio.open_nursery() as nursery:
        sink = MemorySink(1_200_000)
        reader = await connection.store.open_reader(path(profile, "big"), sink)
        reader.want(0, 1_200_000, demand=True)
        await trio.sleep(2)

        began, before = trio.current_time(), sink.have.total
        with trio.move_on_after(15):
            for name, data in small.items():
                assert await read_file(connection, name) == data
        copied = (sink.have.total - before) / (trio.current_time() - began)
        assert copied > {"px4": 4_000, "ardupilot": 1_800}[profile]  # half of it without the rule
        nursery.cancel_scope.cancel()


async def test_an_operation_that_ends_is_told_once_and_a_cancelled_one_never() -> None:
    async with rig("px4") as here:
        driver, told = here.connection.driver, list[str]()
        first, second, third = (Simple(Opcode.CALC_FILE_CRC32, b"/%d" % number) for number in range(3))

        def on_first() -> None:
            told.append("first")
            driver.cancel(second)

        driver.start(first, on_first)
        driver.start(second, lambda: told.append("second"))
        driver.start(third, lambda: told.append("third"))
        await trio.sleep(1.0)
        assert (first.done, second.done, third.done) == (True, True, True)
        assert told == ["first", "third"]


async def test_a_reboot_forgets_what_was_seen_of_the_server() -> None:
    async with rig("px4", {b"/d/small": b"hello"}) as here:
        await here.connection.store.list_directory(b"/d")
        assert here.connection.engine.traits.lists_times is not None
        await here.reboot()
        assert here.connection.engine.traits.lists_times is None


@pytest.mark.holds("fault stale session", "rule 14.10")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_session_left_by_a_killed_client_is_got_over(profile: str) -> None:
    data = content(50_000)
    here = Rig(profile, {b"/d/big": data}, LinkSettings(rate=100_000.0, delay=0.02))
    with trio.CancelScope():
        async with here.connected(seed=3) as connection:
            await begin_to_read(connection, path(profile, "big"), 1000)
            here.link.cut()  # so that the last requests do not arrive: kill -9
    here.link.restore()
    async with here.connected(seed=7) as connection:  # which asks for another session id
        assert await read_file(connection, path(profile, "big")) == data
        assert here.count(Opcode.RESET_SESSIONS) == 0


async def test_a_close_that_goes_unheard_does_not_fail_the_next_open() -> None:
    here = Rig("px4", {b"/d/first": b"one", b"/d/second": b"two"}, LinkSettings(delay=0.01))
    async with here.connected() as connection:
        assert await read_file(connection, path("px4", "first")) == b"one"
        here.link.cut()

        async def mend() -> None:
            await trio.sleep(8)
            here.link.restore()

        async with trio.open_nursery() as nursery:
            nursery.start_soon(mend)
            assert await read_file(connection, path("px4", "second")) == b"two"


@pytest.mark.holds("promise 4", "rule 14.36")
async def test_silence_fails_one_request_and_then_all_at_once() -> None:
    here = Rig("px4", {b"/d/small": b"hello"})
    async with here.connected() as connection:
        here.link.cut()
        began = trio.current_time()
        with pytest.raises(RequestTimeout):
            await connection.store.list_directory(b"/d")
        assert trio.current_time() - began == pytest.approx(30.0, abs=3.0)
        began = trio.current_time()
        for _ in range(500):
            with pytest.raises(VehicleLost):
                await connection.store.list_directory(b"/d")
        with pytest.raises(VehicleLost):
            await read_file(connection, b"/d/small")
        assert trio.current_time() == began
        here.link.restore()
        await trio.sleep(3)
        assert await read_file(connection, b"/d/small") == b"hello"


async def test_no_vehicle_says_what_was_heard() -> None:
    here = Rig("px4", {b"/d": None})
    with pytest.raises(VehicleLost, match=r"heard only 1/1 \(PX4 quadrotor, disarmed\); check target_system"):
        async with here.connected(ConnectOptions(target_system=9)):
            raise AssertionError("connected to nobody")


# --- names that are being changed


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_user_that_is_cancelled_at_any_time_gives_its_turn_back(profile: str) -> None:
    """In the queue, between its call and its first step, while it opens, reads or closes."""
    here = Rig(profile, {b"/d/f": content(3000), b"/d/g": b"g"}, LinkSettings(delay=0.02))
    async with here.connected() as connection:
        for step in range(60):
            with trio.move_on_after(step * 0.01):
                async with trio.open_nursery() as nursery:
                    nursery.start_soon(connection.store.stat_size, path(profile, "g"))
                    await connection.store.read_whole(path(profile, "f"), 10_000)
            began = trio.current_time()
            assert await read_file(connection, path(profile, "g")) == b"g"
            assert trio.current_time() - began < 1.0
        await trio.sleep(10)
        assert here.server.open_sessions == 0


async def test_a_checksum_or_a_change_of_names_is_not_asked_for_in_a_turn() -> None:
    """The request would wait for itself, because a change waits until the session is off its path."""
    here = Rig("px4", {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        async with connection.scheduler.turn(SessionUser(b"/d/f")) as turn:
            await turn.open()
            with pytest.raises(AssertionError):
                await connection.store.crc32(b"/d/f")
            with pytest.raises(AssertionError):
                await connection.store.remove(b"/d/f")
        await connection.store.remove(b"/d/f")


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_two_changes_wait_for_the_same_open_file(profile: str) -> None:
    """Two waiting changes once woke each other without an end."""
    here = Rig(profile, {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        reader, _ = await begin_to_read(connection, path(profile, "f"), 1000)
        began = trio.current_time()

        async def change() -> None:
            async with connection.scheduler.excluded(path(profile, "f")):
                await trio.sleep(0.1)

        with trio.fail_after(1.0):
            async with trio.open_nursery() as changes:
                for _ in range(2):
                    changes.start_soon(change)
        assert trio.current_time() > began
        reader.close()


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", ["px4", "mavsdk", "ardupilot"])
async def test_a_file_is_not_opened_under_a_name_that_it_lost_meanwhile(profile: str) -> None:
    """Another file is open and has to be closed first; once more, where the answer to that is lost."""
    old, new = content(5000, 1), content(5000, 2)
    for lost in (False, True):
        for later in range(0, 60, 5):
            here = Rig(profile, link=LinkSettings(delay=0.1))
            for name, data in ((b"/a", old), (b"/b", new), (b"/other", new)):
                here.card.add(name, data)
            async with here.connected() as connection, trio.open_nursery() as nursery:
                store, sink = connection.store, MemorySink(5000)
                assert await read_file(connection, b"/other") == new
                reader = await store.open_reader(b"/a", sink, expected_size=5000)
                here.faults.requests.clear()
                if lost:
                    here.faults.lose_reply_to(Opcode.TERMINATE_SESSION)

                async def change(connection: Connection = connection, later: int = later) -> None:
                    await trio.sleep(later * 0.02)
                    await connection.store.rename(b"/a", b"/aside")
                    await connection.store.rename(b"/b", b"/a")

                nursery.start_soon(change)
                reader.want(0, 5000, demand=True)
                assert await sink.wait_for(0, 5000) == old
                reader.close()


# --- a session that is taken

LINK = LinkSettings(delay=0.02)
SLOW = LinkSettings(rate=20_000.0, delay=0.02)
DATA = content(60_000, 1)
OTHER = content(60_000, 2)

CHECK_PERIOD = STALL / 2
"""How often a reading looks whether it stalled."""


@pytest.mark.parametrize("heard", [False, True])
async def test_a_taken_session_is_waited_out_then_reset_if_nobody_is_heard_then_given_up(heard: bool) -> None:
    here = Rig("ardupilot", {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        here.faults.refuse(Opcode.OPEN_FILE_RO, NakCode.NO_SESSIONS_AVAILABLE, times=99)
        if heard:
            connection.scheduler.server.others.heard_at = trio.current_time() + SILENCE_PX4
        with pytest.raises(SessionBusy):
            await connection.scheduler.server.open(path("ardupilot", "f"))
        assert not connection.scheduler.server.maybe_open
        silences = [later - earlier for earlier, later in pairwise(here.faults.times(Opcode.OPEN_FILE_RO))]
        assert silences[:2] == pytest.approx([SILENCE_ARDUPILOT, SILENCE_PX4], abs=0.2)
        assert here.count(Opcode.RESET_SESSIONS) == len(silences[2:]) == (0 if heard else 1)


@pytest.mark.parametrize("may_be_ours", ["", "sent twice", "ids are echoed"])
async def test_an_open_that_plainly_fails_costs_no_silence(may_be_ours: str) -> None:
    """If an open of ours may have worked, that is closed before it is asked again. From the first ACK on it
    is known that the server is an ArduPilot, which says so by this refusal."""
    here = Rig("ardupilot", {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        if may_be_ours == "ids are echoed":
            await connection.store.stat_size(path("ardupilot", "f"))
            await connection.scheduler.server.close()
        closed = here.count(Opcode.TERMINATE_SESSION)
        here.faults.refuse(Opcode.OPEN_FILE_RO, NakCode.FAIL, times=99)
        if may_be_ours == "sent twice":
            here.faults.lose_reply_to(Opcode.OPEN_FILE_RO)
        began = trio.current_time()
        with pytest.raises(FtpNak):
            await connection.scheduler.server.open(path("ardupilot", "f"))
        assert trio.current_time() - began < SILENCE_ARDUPILOT
        assert (here.count(Opcode.TERMINATE_SESSION) > closed) is bool(may_be_ours)


async def test_an_open_whose_answer_was_lost_is_closed_also_where_the_refusal_hides_its_code() -> None:
    """PX4 keeps no answer that begins with a 5, as that of this size does, and says 8 to all it refuses."""
    here = Rig("px4", {b"/d/f": b"hello"}, LINK)
    async with here.connected() as connection:
        with pytest.raises(FtpNak):
            await connection.driver.run(Simple(Opcode.CREATE_DIRECTORY, b"/d"))
        here.faults.lose_reply_to(Opcode.OPEN_FILE_RO)
        began = trio.current_time()
        assert await read_file(connection, path("px4", "f")) == b"hello"
        assert trio.current_time() - began < SILENCE_ARDUPILOT


ONE_SESSION = ["px4", "px4-2026", "ardupilot", "mavsdk"]
"""PX4 of September 2026 and MAVSDK end the session of one client silently when another one opens a file."""


@pytest.mark.holds("promise 6", "rule 14.39")
@pytest.mark.parametrize("profile", ONE_SESSION)
async def test_another_clients_session_is_left_alone(profile: str) -> None:
    """Whoever is heard is alive: no ResetSessions, no Terminate, and its file stays open (promise 6)."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_by_another, here, 60)
        await trio.sleep(2.0)
        began = trio.current_time()
        with pytest.raises(SessionBusy):
            await read_file(connection, path(profile, "f"))
        assert trio.current_time() - began == pytest.approx(DEFAULTS.op_deadline, abs=1.0)
        await trio.sleep(3.0)
        assert here.server.open_paths == [path(profile, "theirs")]
        assert here.count(Opcode.OPEN_FILE_RO, Opcode.RESET_SESSIONS, Opcode.TERMINATE_SESSION) == 0
        nursery.cancel_scope.cancel()


async def test_our_own_listings_make_nobody_wait_longer_for_another_client() -> None:
    """The vehicle answers listings, and they take no turn."""
    here = Rig("px4-2026", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_by_another, here, 60)
        await trio.sleep(0.5)

        async def list_for_ever() -> None:
            while True:
                await connection.store.list_directory(b"/d")
                await trio.sleep(1.0)

        nursery.start_soon(list_for_ever)
        began = trio.current_time()
        with pytest.raises(SessionBusy):
            await read_file(connection, b"/d/f")
        assert trio.current_time() - began == pytest.approx(DEFAULTS.op_deadline, abs=1.0)
        nursery.cancel_scope.cancel()


@pytest.mark.parametrize("profile", ONE_SESSION)
async def test_a_client_that_only_lists_does_not_keep_our_lost_open_open(profile: str) -> None:
    """The client's requests keep the session alive, which only this connection can have opened."""
    here = Rig(profile, {b"/d/f": DATA}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def rival_lists() -> None:
            while True:
                here.another_asks(Opcode.LIST_DIRECTORY, b"/")
                await trio.sleep(0.05)

        nursery.start_soon(rival_lists)
        await trio.sleep(12.0)
        here.faults.lose_reply_to(Opcode.OPEN_FILE_RO)
        with trio.fail_after(5.0):
            assert await read_file(connection, path(profile, "f")) == DATA
        assert here.count(Opcode.RESET_SESSIONS) == 0
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk"])
async def test_the_file_that_another_client_opened_after_a_lost_open_of_ours_stays_open(profile: str) -> None:
    """The other client got the session in place of a file that this connection may have open."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection:
        here.faults.at(Opcode.OPEN_FILE_RO, here.link.cut)
        with trio.move_on_after(0.5):
            await connection.store.stat_size(path(profile, "f"))
        here.link.restore()
        assert connection.scheduler.server.maybe_open
        here.another_asks(Opcode.OPEN_FILE_RO, path(profile, "theirs"))
        for _ in range(12):
            await trio.sleep(1.0)
            here.another_asks(Opcode.READ_FILE)
        assert path(profile, "theirs") in here.server.open_paths
        assert here.count(Opcode.TERMINATE_SESSION) == 0


@pytest.mark.holds("promise 6")
async def test_what_may_be_open_by_our_doing_does_not_keep_another_client_out() -> None:
    """ArduPilot refuses each of its requests. Each refusal keeps our session alive, and is news for us."""
    here = Rig("ardupilot", {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        await read_file(connection, path("ardupilot", "f"))
        await trio.sleep(5.0)
        here.faults.at(Opcode.OPEN_FILE_RO, here.link.cut)
        with trio.move_on_after(0.5) as impatience:
            await connection.store.stat_size(path("ardupilot", "f"))
        assert impatience.cancelled_caught
        here.link.restore()
        assert here.server.open_sessions == 1
        for _ in range(10):
            here.another_asks(Opcode.LIST_DIRECTORY, b"/")
            await trio.sleep(1.0)
        assert here.server.open_sessions == 0


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ONE_SESSION)
@pytest.mark.parametrize("closes", [True, False])
async def test_a_file_is_opened_once_the_other_clients_is_closed_or_left(closes: bool, profile: str) -> None:
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection:
        here.another_asks(Opcode.OPEN_FILE_RO, path(profile, "theirs"))
        await trio.sleep(4.0)
        here.another_asks(Opcode.READ_FILE)
        done = trio.current_time()
        if closes:
            await trio.sleep(1.0)
            here.another_asks(Opcode.TERMINATE_SESSION)
        assert await read_file(connection, path(profile, "f")) == DATA
        (opened,) = here.faults.times(Opcode.OPEN_FILE_RO)
        assert opened - done == pytest.approx(1.0 if closes else LEFT_OPEN, abs=0.2)


async def test_a_client_that_opened_a_file_just_before_us_is_waited_for() -> None:
    """Several commands of ours at once all open theirs when one of them has closed its file."""
    here = Rig("px4", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_by_another, here, 20)
        assert await read_file(connection, b"/d/f") == DATA
        times = here.faults.times(Opcode.OPEN_FILE_RO)
        assert len(times) == 2, "it was refused once, and asked again when the other one had closed its file"


async def read_by_another(here: Rig, seconds: int) -> None:
    """Have another client read a file for so long, and close it."""
    here.another_asks(Opcode.OPEN_FILE_RO, path(here.profile, "theirs"))
    for _ in range(seconds):
        await trio.sleep(1.0)
        here.another_asks(Opcode.READ_FILE)
    here.another_asks(Opcode.TERMINATE_SESSION)


async def test_a_listing_waits_until_another_client_closed_its_file() -> None:
    """ArduPilot refuses it until then. Silences came to an end after 14 s."""
    here = Rig("ardupilot", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_by_another, here, 20)
        await trio.sleep(0.5)
        listing = await connection.store.list_directory(b"/d")
        assert {entry.name for entry in listing.entries} == {b"f", b"theirs"}
        asked = [
            *here.faults.times(Opcode.LIST_DIRECTORY_WITH_TIME),
            *here.faults.times(Opcode.LIST_DIRECTORY),
        ]
        assert len([at for at in asked if at < 20.0]) <= 2


@pytest.mark.parametrize("profile", ONE_SESSION)
async def test_while_other_clients_close_their_files_nobody_is_told_that_the_session_is_busy(
    profile: str,
) -> None:
    """Commands of ours at once: each waits for the ones before it, however many there are."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def others() -> None:
            for _ in range(5):
                await read_by_another(here, 12)

        nursery.start_soon(others)
        await trio.sleep(0.5)
        assert await read_file(connection, path(profile, "f")) == DATA
        assert trio.current_time() > DEFAULTS.op_deadline


@pytest.mark.parametrize("profile", ONE_SESSION)
async def test_a_command_waits_for_another_client_as_long_as_that_reads(profile: str) -> None:
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    options = ConnectOptions(patient=True)
    async with here.connected(options) as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_by_another, here, 90)
        await trio.sleep(0.5)
        await connection.store.list_directory(here.root + b"/d")
        assert await read_file(connection, path(profile, "f")) == DATA
        assert trio.current_time() > 90.0


async def test_a_user_that_waits_for_another_client_keeps_nobody_from_its_path() -> None:
    """The user's open was refused, so the user gave its turn back."""
    here = Rig("px4", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        sink = MemorySink(len(DATA))
        reader = await connection.store.open_reader(b"/d/f", sink, expected_size=len(DATA))
        nursery.start_soon(read_by_another, here, 12)
        reader.want(0, len(DATA), demand=True)
        await trio.sleep(1.0)
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        began = trio.current_time()
        await connection.store.rename(b"/d/f", b"/d/g")
        assert trio.current_time() - began < 1.0
        assert await sink.wait_for(0, len(DATA)) == DATA
        reader.close()


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ONE_SESSION)
@pytest.mark.parametrize("reads", [True, False])
async def test_another_clients_open_of_nothing_leaves_what_was_open(reads: bool, profile: str) -> None:
    """Programs ask so whether a name is free: nobody waits for them, but for the file that they read."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection:
        if reads:
            here.another_asks(Opcode.OPEN_FILE_RO, path(profile, "theirs"))
            await trio.sleep(0.5)
        here.another_asks(Opcode.OPEN_FILE_RO, path(profile, "nothing"))
        await trio.sleep(0.5)
        began = trio.current_time()
        assert await read_file(connection, path(profile, "f")) == DATA
        assert (trio.current_time() - began > LEFT_OPEN - 1.0) is reads


@pytest.mark.holds("promise 1", "promise 6")
@pytest.mark.parametrize("ours", ["reading", "writing"])
@pytest.mark.parametrize("profile", ["px4-2026", "mavsdk"])
async def test_a_session_that_another_client_took_is_its_own(profile: str, ours: str) -> None:
    """Only what was on its way goes into its file, which stays open, and ours is whole in the end."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/theirs": OTHER}, SLOW)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        if ours == "reading":
            _, sink = await begin_to_read(connection, path(profile, "f"), 10_000)
        else:
            nursery.start_soon(put, connection, path(profile, "new"), DATA)
            await trio.sleep(1.0)
        here.another_asks(Opcode.CREATE_FILE, path(profile, "its"))
        await trio.sleep(1.0)
        spoilt = here.data(b"/d/its")
        await trio.sleep(7.0)
        assert path(profile, "its") in here.server.open_paths
        assert here.data(b"/d/its") == spoilt
        here.another_asks(Opcode.TERMINATE_SESSION)
        if ours == "reading":
            assert await sink.wait_for(0, len(DATA)) == DATA
    if ours == "writing":
        assert here.data(b"/d/new") == DATA


def taken_behind(here: Rig, opcode: Opcode) -> trio.Event:
    """Have another client make a file right behind our first such request: both answers come at once, before
    the task that asked goes on."""
    handle, took = here.server.handle, trio.Event()

    def on_request(wire: bytes, source: Address, now: float) -> None:
        handle(wire, source, now)
        if wire[3] == opcode and source != STATION and not took.is_set():
            took.set()
            here.another_asks(Opcode.CREATE_FILE, path(here.profile, "its"))

    here.server.handle = on_request  # type: ignore[method-assign]
    return took


@pytest.mark.holds("promise 6")
async def test_also_one_that_it_took_right_behind_our_open() -> None:
    here = Rig("mavsdk", {b"/d": None}, LinkSettings(delay=0.02))
    took = taken_behind(here, Opcode.CREATE_FILE)
    async with here.connected() as connection:
        await put(connection, path("mavsdk", "new"), DATA[:500])
        assert took.is_set()
    assert here.data(b"/d/new") == DATA[:500]
    assert here.data(b"/d/its") == b""


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "mavsdk"])
async def test_a_terminate_whose_answer_is_lost_leaves_the_next_clients_file_open(profile: str) -> None:
    here = Rig(profile, {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        here.faults.lose_reply_to(Opcode.TERMINATE_SESSION)
        took = taken_behind(here, Opcode.TERMINATE_SESSION)
        assert await read_file(connection, path(profile, "f")) == DATA
        await took.wait()
        await trio.sleep(5.0)
        assert here.server.open_paths == [path(profile, "its")]
        here.another_asks(Opcode.TERMINATE_SESSION)
        assert await read_file(connection, path(profile, "f")) == DATA


async def test_an_open_that_finds_all_of_several_sessions_taken_is_told_in_time() -> None:
    """A server with several sessions is asked beside another client's file, whose close nobody awaits."""
    here = Rig("ardupilot5", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        assert await read_file(connection, b"/d/f") == DATA  # tells how session ids are given out

        async def load(session: int) -> None:
            here.another_asks(Opcode.OPEN_FILE_RO, b"/d/theirs", session=session)
            while True:
                await trio.sleep(1.0)
                here.another_asks(Opcode.READ_FILE, session=session)

        nursery.start_soon(load, 71)
        await trio.sleep(1.5)
        assert await read_file(connection, b"/d/f") == DATA
        await trio.sleep(4.0)
        for session in range(72, 76):
            nursery.start_soon(load, session)
        await trio.sleep(0.5)
        opens = here.count(Opcode.OPEN_FILE_RO)
        with trio.fail_after(30.0), pytest.raises(SessionBusy):
            await read_file(connection, b"/d/f")
        assert here.count(Opcode.OPEN_FILE_RO) - opens == 3, "at once, and after each silence"
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 6")
async def test_a_client_whose_file_our_open_ended_is_not_waited_for() -> None:
    """Two clients opened a file when a third one had closed its own. The first one notices, and closes
    nothing."""
    here = Rig("px4-2026", {b"/d/f": DATA, b"/d/theirs": OTHER}, LINK)
    handle, came = here.server.handle, trio.Event()

    def on_request(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == Opcode.OPEN_FILE_RO and source != STATION and not came.is_set():
            came.set()
            here.another_asks(Opcode.OPEN_FILE_RO, b"/d/theirs")
        handle(wire, source, now)

    here.server.handle = on_request  # type: ignore[method-assign]
    async with here.connected() as connection:
        began = trio.current_time()
        for _ in range(2):
            assert await read_file(connection, b"/d/f") == DATA
        assert came.is_set()
        assert trio.current_time() - began < LEFT_OPEN


@pytest.mark.holds("fault duplicate")
@pytest.mark.parametrize("profile", ["px4", "mavsdk", "ardupilot"])
async def test_the_answer_to_an_open_that_was_cancelled_is_no_reason_for_doubt(profile: str) -> None:
    here = Rig(profile, {b"/d/f": DATA}, LinkSettings(delay=0.1))
    async with here.connected() as connection:
        with trio.move_on_after(0.15):
            await connection.store.stat_size(path(profile, "f"))
        await trio.sleep(1.0)
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        assert not connection.store.in_doubt()


async def test_then_the_caller_that_opens_a_file_still_waits() -> None:
    """The caller keeps its place before later ones, and gets its error in time."""
    here = Rig("mavsdk", {b"/d/f": DATA}, LinkSettings(delay=0.02))
    took = taken_behind(here, Opcode.OPEN_FILE_RO)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        nursery.start_soon(read_file, connection, path("mavsdk", "f"))
        await took.wait()
        await trio.sleep(1.0)
        (user,) = connection.scheduler.users
        assert user.awaited_since is not None


@pytest.mark.holds("rule 14.9")
@pytest.mark.parametrize("outage", [3.2, 6.0])
async def test_after_a_silence_nothing_is_believed_before_the_file_was_opened_again(outage: float) -> None:
    """Meanwhile the session of a PX4, which all share, may have become another client's."""
    here = Rig("px4", {b"/d/f": DATA, b"/d/theirs": OTHER}, SLOW)
    async with here.connected() as connection:
        _, sink = await begin_to_read(connection, path("px4", "f"), 10_000)
        here.link.cut()
        await trio.sleep(0.2)
        here.another_asks(Opcode.TERMINATE_SESSION, heard=False)
        here.another_asks(Opcode.OPEN_FILE_RO, path("px4", "theirs"), heard=False)
        assert here.server.open_paths == [path("px4", "theirs")]
        assert outage > STALL + CHECK_PERIOD
        await trio.sleep(outage)
        here.link.restore()
        assert await sink.wait_for(0, len(DATA)) == DATA
        assert here.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_file_with_fewer_bytes_than_its_size_is_an_error_and_no_doubt(profile: str) -> None:
    """As those below `/sys` on Linux. PX4 ACKs the read of nothing, ArduPilot says that the file ends."""
    here = Rig(profile, {b"/d/f": b"nineteen bytes only"}, LINK)

    def lie(asked: Payload, reply: Payload) -> list[Payload]:
        if reply.req_opcode == Opcode.OPEN_FILE_RO:
            reply = reply._replace(data=(4096).to_bytes(4, "little"))
        if profile == "px4" and (reply.opcode, reply.req_opcode) == (Opcode.NAK, Opcode.READ_FILE):
            reply = reply._replace(opcode=int(Opcode.ACK), size=0, data=b"", offset=asked.offset)
        return [reply]

    here.server.change = lie
    async with here.connected() as connection:
        began = trio.current_time()
        with pytest.raises(SessionLost):
            await read_file(connection, path(profile, "f"))
        assert trio.current_time() - began == pytest.approx(DEFAULTS.op_deadline, abs=1.0)
        assert 4 < here.count(Opcode.OPEN_FILE_RO) < 16
        assert not connection.store.in_doubt()


@pytest.mark.holds("fault idle close")
async def test_a_session_that_is_lost_each_time_is_an_error_in_the_end_of_each_read() -> None:
    """The second one failed with the first session that it lost."""
    async with rig("px4", {b"/d/f": DATA}, link=LINK) as here:
        file = await here.mount().open(b"/d/f")
        here.faults.ignore(Opcode.READ_FILE)
        for _ in range(2):
            began = trio.current_time()
            with pytest.raises((SessionLost, RequestTimeout)):
                await file.read(0, 100)
            assert (
                DEFAULTS.op_deadline <= trio.current_time() - began < DEFAULTS.op_deadline + 2 * STALL + 1.0
            )
        await file.release()


@pytest.mark.holds("promise 5", "fault idle close")
@pytest.mark.parametrize(("profile", "outage"), [("px4", 12.0), ("ardupilot5", 23.0)])
async def test_a_server_that_closed_an_idle_session_during_an_outage(profile: str, outage: float) -> None:
    here = Rig(profile, {b"/d/f": DATA}, SLOW)
    async with here.connected() as connection:
        _, sink = await begin_to_read(connection, path(profile, "f"), 10_000)
        here.link.cut()
        await trio.sleep(outage)
        here.link.kick()
        await trio.sleep(0.01)
        assert here.server.open_sessions == 0
        here.link.restore()
        assert await sink.wait_for(0, len(DATA)) == DATA
        assert connection.store.epoch == -inf
        assert here.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.holds("rule 14.12", "fault growing file")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
@pytest.mark.parametrize("shrinks", [False, True])
async def test_a_session_is_closed_within_two_seconds_of_its_last_use(shrinks: bool, profile: str) -> None:
    """The file is opened again for more reads. A smaller one then is another file."""
    here = Rig(profile, {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        sink = MemorySink(len(DATA))
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        for offset in (0, 20_000):
            reader.want(offset, offset + 1000, demand=True)
            await sink.wait_for(offset, offset + 1000)
            await trio.sleep(1.0)
        assert here.count(Opcode.TERMINATE_SESSION) == 0
        await trio.sleep(5.0)
        assert here.faults.times(Opcode.TERMINATE_SESSION)[-1] - here.faults.times(Opcode.READ_FILE)[-1] < 2.0
        assert here.server.open_sessions == 0
        if shrinks:
            here.put(b"/d/f", OTHER[:50_000])
        reader.want(40_000, 41_000, demand=True)
        if shrinks:
            with pytest.raises(FileChanged):
                await sink.wait_for(40_000, 41_000)
            assert sink.have.total == 2000
        else:
            assert await sink.wait_for(40_000, 41_000) == DATA[40_000:41_000]
        assert here.count(Opcode.OPEN_FILE_RO) == 2
        await trio.sleep(5.0)
        assert here.server.open_sessions == 0


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_in_flight_a_file_that_nobody_has_open_is_closed_at_once(profile: str) -> None:
    here = Rig(profile, {b"/d/f": DATA}, LINK)
    async with here.connected() as connection:
        reader, sink = await begin_to_read(connection, path(profile, "f"), 1000)
        await sink.wait_for(0, 1000)
        await here.arm()
        await trio.sleep(0.5)
        assert here.count(Opcode.TERMINATE_SESSION) == 0, "it is still open here"
        reader.close()
        await trio.sleep(0.5)
        assert here.server.open_sessions == 0


@pytest.mark.holds("rule 14.31")
async def test_two_silences_prove_that_listings_show_no_times() -> None:
    """One may be loss; MAVSDK's server never answers an opcode that it does not know."""
    here = Rig("mavsdk", {b"/d/f": DATA}, LINK)
    here.faults.ignore(Opcode.LIST_DIRECTORY_WITH_TIME)
    async with here.connected() as connection:
        for known in (None, False, False):
            assert await _listed(connection) == [b"f"]
            assert connection.engine.traits.lists_times is known
        assert here.faults.requests[-1] == Opcode.LIST_DIRECTORY
        plain = here.faults.times(Opcode.LIST_DIRECTORY)
        assert here.faults.times(Opcode.LIST_DIRECTORY_WITH_TIME)[-1] < plain[-3]
        assert plain[-1] - plain[0] < 2 * TIME_PROBE_LIMIT


async def _listed(connection: Connection) -> list[bytes]:
    return [entry.name for entry in (await connection.store.list_directory(b"/d")).entries]


# --- what a killed client left keeps listings and changes out


def ardupilot() -> Rig:
    here = Rig("ardupilot")
    here.card.mkdir(b"/d")
    return here


def others_session(connection: Connection) -> int:
    """An id that this connection asks for never."""
    return connection.engine.home_session % 255 + 1


async def open_elsewhere(connection: Connection) -> None:
    """Leave a session open under an id that is not this connection's, as a killed client does."""
    await connection.driver.run(
        OpenRequest(Opcode.CREATE_FILE, b"/d/left", session=others_session(connection))
    )


async def test_a_session_in_use_is_told_in_time_and_is_not_asked_for_often() -> None:
    here = ardupilot()
    options = ConnectOptions(op_deadline=20.0)
    async with here.connected(options) as connection, trio.open_nursery() as nursery:
        await open_elsewhere(connection)

        async def keep_in_use() -> None:
            while True:
                here.another_asks(Opcode.NONE, session=others_session(connection), heard=False)
                await trio.sleep(1)

        nursery.start_soon(keep_in_use)
        began = trio.current_time()
        with pytest.raises(SessionBusy):
            await connection.store.list_directory(b"/d")
        assert 10 < trio.current_time() - began < 20
        with pytest.raises(NoFtp, match="another client keeps the only FTP session of vehicle 1/1"):
            await _list_root(connection, here.mount(), trio.current_time() + 30, Options())
        nursery.cancel_scope.cancel()


async def test_a_change_outlasts_it_too() -> None:
    here = ardupilot()
    async with here.connected() as connection:
        await open_elsewhere(connection)
        began = trio.current_time()
        await connection.store.make_directory(b"/d/new")
        assert 3 < trio.current_time() - began < 5
        listing = await connection.store.list_directory(b"/d")
        assert {entry.name for entry in listing.entries} == {b"left", b"new"}
