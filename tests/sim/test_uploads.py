"""Uploads, and what interrupts them: the link, the vehicle, other clients, a full card, arming."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial

import pytest
import trio

from mavftpfs.cache.uploads import START_AT
from mavftpfs.link.messages import Address
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.session.upload import Upload
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import Armed, FtpNak, MavftpfsError, SpoolFailed
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Family
from tests.support.faults import STATION
from tests.support.replies import request
from tests.support.rigs import Rig, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import MemorySource, content, know, path, read_file, start, under_way

EVERY_PROFILE = sorted(PROFILES)


@pytest.mark.parametrize("size", [START_AT, 200_000])
async def test_the_first_large_file_is_sent_once_where_the_card_cannot_rename(size: int) -> None:
    here = Rig("littlefs", {b"/d": None})
    target, data = path("littlefs", "new"), content(size)
    async with here.mounted(target[:-4]) as tree:
        await write_file(tree, target, data)
        assert here.count(Opcode.WRITE_FILE) == -(-size // MAX_DATA)
        assert here.card.data(target) == data
    assert {entry.name for entry in here.card.entries(target[:-4])} == {b".", b"..", b"new"}


PLAIN = LinkSettings(rate=20_000.0, delay=0.02)


@asynccontextmanager
async def uploading(
    data: bytes, *, profile: str = "px4", link: LinkSettings = PLAIN, known: bool = True
) -> AsyncIterator[tuple[Rig, MemorySource, Upload]]:
    """Begin to upload `new`. known: it is known what OpenFileWO does."""
    here = Rig(profile, {b"/d": None}, link)
    async with here.connected() as connection:
        if known:
            know(connection, profile)
        source = MemorySource(data)
        yield here, source, await start(connection, profile, source)


async def cut(here: Rig, connection: Connection, length: float) -> None:
    here.link.cut()
    await trio.sleep(length)
    here.link.restore()


async def reboot(here: Rig, connection: Connection) -> None:
    here.vehicle.reboot(trio.current_time(), downtime=4.0)


async def take_session(here: Rig, connection: Connection) -> None:
    """Another ground station terminates whatever it finds, as MAVSDK and QGroundControl do."""
    for source in (STATION, connection.vehicle.own):
        steal(here, connection, source)


def steal(here: Rig, connection: Connection, source: Address = STATION) -> None:
    """Have the session terminated; nobody hears it."""
    session = connection.scheduler.server.opened
    wire = request(77, Opcode.TERMINATE_SESSION, session=session.id if session else 0).encode()
    here.vehicle.foreign_request(wire, source, trio.current_time(), audible=False)


INTERRUPTIONS: dict[str, Callable[[Rig, Connection], Awaitable[None]]] = {
    "cut": partial(cut, length=3.0),
    "long cut": partial(cut, length=14.0),  # PX4 closes an idle session after 10 s
    "reboot": reboot,
    "taken": take_session,
}


@pytest.mark.holds("promise 5")
@pytest.mark.parametrize("interruption", INTERRUPTIONS)
@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_interrupts_it_is_bridged(profile: str, probed: bool, interruption: str) -> None:
    data = content(60_000)
    here = Rig(profile, {b"/d": None}, PLAIN)
    async with here.connected() as connection:
        if probed:
            know(connection, profile)
        await trio.sleep(5)
        async with under_way(connection, profile, data) as source:
            await INTERRUPTIONS[interruption](here, connection)
        assert source.all_proven
        if interruption == "cut":
            assert source.beginnings == 1
            resumable = probed and not PROFILES[profile].write_only_truncates
            assert source.checkpoints == 1 + resumable  # what is in doubt is terminated, not believed
    assert here.data(b"/d/new") == data


async def test_a_write_that_is_refused_for_no_error_goes_on_in_a_new_session() -> None:
    """PX4 says NAK 2 with errno 0 to a write whose session another ground station reset meanwhile."""
    async with uploading(content(3000)) as (here, source, upload):
        here.faults.refuse(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 0, nth=3)
        await upload.finish()
        assert source.all_proven
    assert here.data(b"/d/new") == bytes(source.content)


@pytest.mark.holds("rule 14.23")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_full_card_is_told(profile: str) -> None:
    here = Rig(profile, {b"/d": None}, PLAIN)
    here.card.capacity = 5_000
    async with here.connected() as connection:
        source = MemorySource(content(9_000))
        upload = await start(connection, profile, source)
        silent = PROFILES[profile].family is Family.ARDUPILOT  # partly written, ACKed: the size tells later
        with pytest.raises(FtpNak) as refusal:
            await upload.finish()
        assert refusal.value.opcode == Opcode.WRITE_FILE
        assert errno_for(refusal.value) in (5, 28)
        assert here.count(Opcode.CREATE_FILE) <= 16
        assert not source.all_proven
        assert source.proven.end <= 5_000 + (238 if silent else 0) + 239
        here.card.capacity = None
        await upload.finish()
        assert source.all_proven or profile.startswith("mavsdk")
        await upload.end()
    assert here.server.open_sessions == 0


@pytest.mark.parametrize("bad", [0, 5_000])
async def test_a_local_disk_that_fails_ends_one_upload_and_nothing_else(bad: int) -> None:
    """The local disk cannot read the bytes from `bad` on."""

    class Failing(MemorySource):
        fails = True

        def read(self, start: int, stop: int) -> bytes:
            if self.fails and stop > bad:
                raise SpoolFailed("the local disk fails")
            return super().read(start, stop)

    here = Rig("px4", {b"/d/other": b"of another file"}, PLAIN)
    async with here.connected() as connection:
        source = Failing(content(9_000))
        upload = await start(connection, "px4", source)
        for _ in range(2):
            with pytest.raises(SpoolFailed):
                await upload.finish()
            assert not source.acked.total + source.in_flight.total
        assert await read_file(connection, path("px4", "other")) == b"of another file"
        source.fails = False
        await upload.finish()
        assert source.all_proven
        await upload.end()
    assert here.data(b"/d/new") == bytes(source.content)
    assert here.server.open_sessions == 0


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_arming_ends_it_and_disarming_lets_it_go_on(profile: str) -> None:
    data = content(60_000)
    here = Rig(profile, {b"/d": None}, PLAIN)
    async with here.connected() as connection:
        source = MemorySource(data)
        upload = await start(connection, profile, source)
        async with trio.open_nursery() as nursery:

            async def finish() -> None:
                with pytest.raises(Armed):
                    await upload.finish()

            async def finish_other() -> None:
                other = await start(connection, profile, MemorySource(content(60_000)), "third")
                with pytest.raises(Armed):
                    await other.finish()
                await other.end()

            nursery.start_soon(finish)
            nursery.start_soon(finish_other)
            await trio.sleep(1.5)
            here.vehicle.arm()
            began = trio.current_time()
        assert trio.current_time() - began < 1
        await trio.sleep(0.5)
        assert here.server.open_sessions == 0
        with pytest.raises(Armed):
            await upload.finish()
        with pytest.raises(Armed):
            await connection.store.remove(path(profile, "new"))
        with pytest.raises(Armed):
            await start(connection, profile, MemorySource(b"x"), "other")
        written = len(here.data(b"/d/new"))
        await trio.sleep(20)
        assert len(here.data(b"/d/new")) == written
        here.vehicle.disarm()
        await trio.sleep(20)  # by itself
        assert source.acked.total + source.proven.total == len(data)
        await upload.finish()
        assert source.all_proven
        here.vehicle.arm()
        await trio.sleep(0.5)
        source.add(b"more")
        with pytest.raises(Armed):
            await upload.finish()
        await upload.end()
        assert source.in_flight.empty
    assert here.data(b"/d/new") == data


async def test_in_flight_no_reader_makes_way_for_an_upload() -> None:
    """The upload has bytes that it may not send, and a turn for it would cost the reader its open file."""
    here = Rig("px4", {b"/d/f": content(200_000)}, PLAIN)
    async with here.connected() as connection:
        upload = await start(connection, "px4", MemorySource(content(60_000)))
        upload.wake()
        await trio.sleep(1.5)
        here.vehicle.arm()
        here.link.kick()
        await trio.sleep(1.0)
        here.faults.requests.clear()
        await read_file(connection, path("px4", "f"))
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        await upload.end()


@pytest.mark.holds("promise 9")
async def test_arming_ends_it_while_it_waits_to_give_way() -> None:
    """Requests in flight are not answered, so the reader that should be first still waits."""
    here = Rig("px4", {b"/d/f": content(1000)}, PLAIN)
    async with here.connected() as connection, trio.open_nursery() as nursery:
        upload = await start(connection, "px4", MemorySource(content(60_000)))

        async def finish() -> None:
            with pytest.raises(Armed):
                await upload.finish()

        nursery.start_soon(finish)
        await trio.sleep(1.5)
        here.faults.ignore(Opcode.WRITE_FILE)
        nursery.start_soon(read_file, connection, path("px4", "f"))
        await trio.sleep(1.0)
        here.vehicle.arm()
        await trio.sleep(0.2)
        assert connection.scheduler.server.opened is None


@pytest.mark.parametrize("more", [b"", b"more"])
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_link_that_is_reopened_and_stays_silent_ends_the_wait(profile: str, more: bytes) -> None:
    """No request was in flight just then, and mavftpfs sends none before it knows who is at the other end."""
    here = Rig(profile, {b"/d": None}, PLAIN)
    here.link.is_stream = True
    here.vehicle.set_stream(True)
    async with here.connected() as connection:
        await trio.sleep(3)  # it told who it is
        source = MemorySource(content(2_000))
        upload = await start(connection, profile, source)
        await trio.sleep(0.5)
        assert connection.scheduler.server.opened is not None
        assert source.todo.empty
        assert source.in_flight.empty
        here.link.cut()
        here.link.restore()
        here.link.cut()
        await trio.sleep(0.1)
        source.add(more)
        upload.wake()
        with trio.fail_after(100.0), pytest.raises(MavftpfsError):
            await upload.finish()


async def test_an_error_at_close_is_the_callers() -> None:
    """ArduPilot with five sessions reports at Terminate that the card did not take the data."""
    async with uploading(content(3000), profile="ardupilot5", known=False) as (here, source, upload):

        def break_close() -> None:
            slot = next(slot for slot in here.server.firmware._slots if slot.file is not None)  # type: ignore[attr-defined]
            opened = slot.file

            def close() -> None:
                type(opened).close(opened)
                raise OSError(5, "flush failed")

            opened.close = close

        here.faults.at(Opcode.TERMINATE_SESSION, break_close)
        with pytest.raises(FtpNak) as refusal:
            await upload.finish()
        assert refusal.value.opcode == Opcode.TERMINATE_SESSION
        assert not source.all_proven
        await upload.finish()
        assert source.all_proven
    assert here.card.data(b"/d/new") == bytes(source.content)


async def test_a_long_upload_proves_what_it_has_from_time_to_time() -> None:
    link = LinkSettings(rate=1_000.0, delay=0.05)
    async with uploading(content(200_000), link=link) as (_, source, upload):
        await trio.sleep(130)
        assert source.checkpoints == 2
        assert 40_000 < source.proven.total < 130_000
        await upload.end()


@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
async def test_with_another_client_about_silence_is_not_survived(probed: bool) -> None:
    """After a gap the one session may be the other client's: writing on would damage its file."""
    data = content(60_000)
    here = Rig("mavsdk", {b"/d": None}, PLAIN)
    async with here.connected() as connection:
        if probed:
            know(connection, "mavsdk")
        async with under_way(connection, "mavsdk", data) as source:
            here.another_asks(Opcode.LIST_DIRECTORY, b"/")
            await trio.sleep(0.2)
            here.link.cut()
            await trio.sleep(3)
            here.link.restore()
        assert source.all_proven
        assert source.checkpoints == 2
        assert source.beginnings == 2
    assert here.data(b"/d/new") == data


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_server_that_always_loses_the_session_is_given_up(profile: str) -> None:
    """A write that is refused wherever it is tried ends in its refusal, after few attempts."""
    here = Rig(profile, {b"/d": None}, PLAIN)
    async with here.connected() as connection:

        async def steal_always() -> None:
            while True:
                if connection.scheduler.server.opened is not None:
                    steal(here, connection, connection.vehicle.own)
                await trio.sleep(0.3)

        async with trio.open_nursery() as nursery:
            nursery.start_soon(steal_always)
            upload = await start(connection, profile, MemorySource(content(100_000)))
            with pytest.raises(MavftpfsError):
                await upload.finish()
            nursery.cancel_scope.cancel()
        assert here.count(Opcode.CREATE_FILE) < 30
        await upload.end()


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_finish_again_after_success_sends_only_what_is_new(profile: str, probed: bool) -> None:
    """Unless opening the file anew empties it, as is found out then at the latest."""
    here = Rig(profile, {b"/d": None}, PLAIN)
    empties = PROFILES[profile].write_only_truncates
    async with here.connected() as connection:
        if probed:
            know(connection, profile)
        source = MemorySource(content(1000))
        upload = await start(connection, profile, source)
        await upload.finish()
        here.faults.requests.clear()
        await upload.finish()
        upload.wake()
        await upload.finish()
        assert here.faults.requests == []
        source.add(b"more")
        upload.wake()
        await upload.finish()
        assert connection.store.traits.wo_truncates is empties
        assert (source.rollbacks, source.beginnings) == (0, 1 + empties)
        assert here.count(Opcode.CREATE_FILE) == empties
        assert here.count(Opcode.WRITE_FILE) <= (5 if empties else 1)
        assert source.all_proven
    assert here.data(b"/d/new") == bytes(source.content)
    assert here.server.open_sessions == 0


async def test_each_finish_waits_for_what_it_was_called_for() -> None:
    """Bytes that come while another caller's Terminate is under way are not covered by it."""
    link = LinkSettings(rate=60_000.0, delay=0.3)
    proven: list[int] = []
    async with uploading(b"first", link=link) as (here, source, upload):

        async def late() -> None:
            source.add(b" second")
            upload.wake()
            await upload.finish()
            proven.append(source.proven.total)

        async with trio.open_nursery() as nursery:
            here.faults.at(Opcode.TERMINATE_SESSION, lambda: nursery.start_soon(late))
            await upload.finish()
            proven.append(source.proven.total)
    assert proven == [5, 12]
    assert here.card.data(b"/d/new") == b"first second"


async def test_nothing_is_created_before_there_is_something() -> None:
    async with uploading(b"", known=False) as (here, _, upload):
        await trio.sleep(10)
        assert [entry.name for entry in here.card.entries(b"/d")][2:] == []
        await upload.finish()  # an empty file was wanted, then
        assert here.card.data(b"/d/new") == b""


async def test_a_file_that_shrank_between_two_openings_is_sent_again() -> None:
    async with uploading(content(3000)) as (here, source, upload):
        await upload.finish()
        here.card.open(b"/d/new", write=True).resize(100)
        source.add(b"more")
        upload.wake()
        await upload.finish()
        assert source.beginnings == 2
    assert here.card.data(b"/d/new") == bytes(source.content)


@pytest.mark.parametrize("code", [NakCode.FILE_NOT_FOUND, NakCode.UNKNOWN_COMMAND])
@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
async def test_a_file_that_cannot_be_opened_again_is_sent_again(probed: bool, code: NakCode) -> None:
    """The file is gone, or the server empties a file when it opens it for writing. The refusal adds no
    knowledge about the server."""
    async with uploading(content(3000), known=probed) as (here, source, upload):
        await upload.finish()
        here.faults.refuse(Opcode.OPEN_FILE_WO, code)
        source.add(b"more")
        upload.wake()
        await upload.finish()
        assert (source.all_proven, source.beginnings) == (True, 2)
        assert here.connection.store.traits.wo_truncates is (False if probed else None)
    assert here.card.data(b"/d/new") == bytes(source.content)


async def test_what_was_abandoned_during_a_silence_is_not_sent_after_it() -> None:
    """A taken session is waited out between the open and the first WriteFile; what is open may be another's
    file by then."""
    async with uploading(content(3000)) as (here, source, upload), trio.open_nursery() as nursery:
        here.faults.requests.clear()
        here.faults.at(Opcode.CREATE_FILE, lambda: nursery.start_soon(here.connection.driver.be_silent, 3.5))
        nursery.start_soon(upload.finish)
        await trio.sleep(2.0)
        here.connection.scheduler.server.leave()
        await trio.sleep(20.0)
        assert source.all_proven
        requests = here.faults.requests
        assert requests[:2] == [Opcode.CREATE_FILE, Opcode.TERMINATE_SESSION]
    assert here.card.data(b"/d/new") == bytes(source.content)


async def test_a_finish_with_nothing_to_send_leaves_no_early_place() -> None:
    """Later bytes in the background have waited since they were written, not since that call."""
    async with uploading(content(3000)) as (_, _, upload):
        await upload.finish()
        await upload.finish()
        assert upload.waiting_since is None


@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
async def test_a_session_that_is_gone_at_the_end_proves_nothing(probed: bool) -> None:
    async with uploading(content(3000), known=probed) as (here, source, upload):
        here.faults.at(Opcode.TERMINATE_SESSION, lambda: steal(here, here.connection))
        await upload.finish()
        assert (source.rollbacks, source.beginnings) == (1, 2)
        assert source.checkpoints == 1
        assert source.all_proven


async def test_so_does_one_whose_place_other_clients_took() -> None:
    """ArduPilot closes a session that was idle for long, and has none left for the id of the Terminate."""
    async with uploading(content(3000), profile="ardupilot5", known=False) as (here, source, upload):
        here.faults.refuse(Opcode.TERMINATE_SESSION, NakCode.NO_SESSIONS_AVAILABLE)
        await upload.finish()
        assert source.rollbacks == 1
        assert source.all_proven


@pytest.mark.parametrize("between", [Opcode.LIST_DIRECTORY, Opcode.CREATE_DIRECTORY])
async def test_a_terminate_done_twice_is_done(between: Opcode) -> None:
    """The first one's reply is lost, and another request in between ends PX4's replay: NAK 4 to the second,
    or 8, as to a CreateDirectory of what exists."""
    async with uploading(content(3000), known=False) as (here, source, upload):
        here.faults.lose_reply_to(Opcode.TERMINATE_SESSION)

        async def ask_soon() -> None:
            await trio.sleep(0.01)
            with suppress(FtpNak):
                await here.connection.driver.run(Simple(between, b"/d"))

        async with trio.open_nursery() as nursery:
            here.faults.at(Opcode.TERMINATE_SESSION, lambda: nursery.start_soon(ask_soon))
            await upload.finish()
        assert Opcode.TERMINATE_SESSION in here.faults.refused
        assert source.rollbacks == 0
        assert source.all_proven


@pytest.mark.parametrize("pause", [0.02, 1.0], ids=["while it is opened", "while it is sent"])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_an_upload_that_is_given_up_is_closed_soon(profile: str, pause: float) -> None:
    here = Rig(profile, {b"/d": None}, PLAIN)
    async with here.connected() as connection:
        source = MemorySource(content(60_000))
        upload = await start(connection, profile, source)
        await trio.sleep(pause)
        began = trio.current_time()
        await upload.end()
        await upload.end()
        assert trio.current_time() == began
        assert source.in_flight.empty
        left = source.todo.total
        await trio.sleep(6)
        assert here.server.open_sessions == 0
        assert source.todo.total == left
        assert upload not in connection.scheduler.users
