"""Every call ends: with an error if the vehicle brings nothing for `op_deadline` (promise 4).

The clock of a reader or an upload goes on across its turns, and what others do does not stop it.
"""

from __future__ import annotations

from collections.abc import Awaitable
from dataclasses import replace
from functools import partial

import pytest
import trio

from mavftpfs.client.connect import Attached
from mavftpfs.client.files import session_of
from mavftpfs.client.progress import waits_told
from mavftpfs.client.watcher import Watcher
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.session.scheduler import MAYBE_OPEN_CLOSE
from mavftpfs.shared.errors import MavftpfsError, RequestTimeout
from mavftpfs.shared.options import Options
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.latecomers import come_again
from tests.support.rigs import DEFAULTS, Rig, rig
from tests.support.transfers import MemorySink, MemorySource, content, know, path, read_file, start

EVERY_PROFILE = sorted(PROFILES)
NEAR = LinkSettings(delay=0.02)
LATEST = DEFAULTS.op_deadline + 2.0
"""Seconds after which a call must have ended."""

DATA = content(9_000)


async def ended(call: Awaitable[object]) -> float:
    """Return after how many seconds a call ended with an error."""
    began = trio.current_time()
    with pytest.raises(MavftpfsError):
        await call
    return trio.current_time() - began


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_request_waits_no_longer_because_an_earlier_open_was_not_answered(profile: str) -> None:
    """Between turns the Terminate of that open is not answered either."""
    here = Rig(profile, {b"/d/f": DATA}, NEAR)
    async with here.connected() as connection:
        here.faults.cut_after(0)
        for _ in range(2):
            began = trio.current_time()
            with pytest.raises(RequestTimeout):
                await connection.store.stat_size(path(profile, "f"))
            assert trio.current_time() - began < LATEST
            await trio.sleep(MAYBE_OPEN_CLOSE + 0.5)


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_request_that_finds_a_file_open_waits_no_longer(profile: str) -> None:
    """Neither the Terminate of the open file nor anything else is answered."""
    here = Rig(profile, {b"/d/f": DATA, b"/d/g": DATA}, NEAR)
    async with here.connected() as connection:
        assert await read_file(connection, path(profile, "f")) == DATA
        here.faults.cut_after(0)
        began = trio.current_time()
        with pytest.raises(RequestTimeout):
            await connection.store.stat_size(path(profile, "g"))
        assert trio.current_time() - began < LATEST


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_an_upload_whose_terminate_is_not_answered_ends_in_time(profile: str) -> None:
    here = Rig(profile, {b"/d": None}, NEAR)
    async with here.connected() as connection:
        source = MemorySource(DATA[:2000])
        upload = await start(connection, profile, source)
        here.faults.ignore(Opcode.TERMINATE_SESSION)
        began = trio.current_time()
        with pytest.raises(RequestTimeout):
            await upload.finish()
        assert trio.current_time() - began < LATEST
        assert source.proven.empty
        here.faults.call_off()
        await upload.finish()
        assert source.all_proven
        await upload.end()


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "ardupilot5", "mavsdk"])
async def test_an_upload_whose_writes_nobody_answers_ends(profile: str, known: bool) -> None:
    """Each turn is opened and terminated without trouble."""
    async with rig(profile, {b"/d": None}, link=NEAR) as here:
        if known:
            know(here.connection, profile)
        here.faults.ignore(Opcode.WRITE_FILE)
        upload = await start(here.connection, profile, MemorySource(DATA))
        assert await ended(upload.finish()) < LATEST + 2.0


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "ardupilot5", "mavsdk"])
async def test_two_readers_whose_reads_nobody_answers_end(profile: str) -> None:
    """Their turns alternate, and each open is answered."""
    async with rig(profile, {b"/d/a": DATA, b"/d/b": DATA}, link=NEAR) as here:
        here.faults.ignore(Opcode.READ_FILE)
        took: list[float] = []

        async def read(name: str) -> None:
            took.append(await ended(read_file(here.connection, path(profile, name))))

        with trio.move_on_after(300):
            async with trio.open_nursery() as nursery:
                nursery.start_soon(read, "a")
                nursery.start_soon(read, "b")
        assert len(took) == 2
        assert max(took) < LATEST + 6.0  # the second one had its first turn after that of the first


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("requests", [0, 2, 4])
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_an_upload_ends_in_time_where_the_server_falls_silent(profile: str, requests: int) -> None:
    async with rig(profile, {b"/d": None}, link=NEAR) as here:
        here.faults.cut_after(requests)
        upload = await start(here.connection, profile, MemorySource(DATA))
        assert await ended(upload.finish()) < LATEST


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_request_behind_a_silent_turn_ends_in_time(profile: str) -> None:
    async with rig(profile, {b"/d/a": DATA, b"/d/b": DATA}, link=NEAR) as here:
        here.faults.cut_after(0)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(partial(ended, read_file(here.connection, path(profile, "a"))))
            await trio.sleep(0.1)
            assert await ended(read_file(here.connection, path(profile, "b"))) < LATEST


@pytest.mark.holds("promise 4")
async def test_a_request_in_a_silence_ends_in_time() -> None:
    """The silence waits for the end of another client's session."""
    async with rig("px4", {b"/d": None}, link=NEAR) as here, trio.open_nursery() as nursery:
        here.faults.cut_after(0)
        nursery.start_soon(here.connection.driver.be_silent, 10.5)
        await trio.sleep(0.1)
        assert await ended(here.connection.store.list_directory(b"/d")) < LATEST


@pytest.mark.parametrize("rtt", [0.7, 1.5])
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_copy_goes_on_beside_small_files_far_away(profile: str, rtt: float) -> None:
    small = {b"/d/s%d" % index: bytes([index]) * 100 for index in range(200)}
    here = Rig(profile, {b"/d/big": content(1_200_000), **small}, LinkSettings(rate=60_000.0, delay=rtt / 2))
    async with here.connected() as connection, trio.open_nursery() as nursery:
        sink = MemorySink(1_200_000)
        reader = await connection.store.open_reader(path(profile, "big"), sink)
        reader.want(0, 1_200_000, demand=True)
        await trio.sleep(10)
        before = sink.have.total
        with trio.move_on_after(60):
            for name, data in small.items():
                assert await read_file(connection, name) == data
        assert sink.have.total > before
        nursery.cancel_scope.cancel()


@pytest.mark.parametrize("rtt", [1.5, 4.0])
async def test_two_copies_go_on_far_away(rtt: float) -> None:
    files = {b"/d/a": content(20_000), b"/d/b": content(20_000, 1)}
    here = Rig("px4", files, LinkSettings(rate=60_000.0, delay=rtt / 2))
    async with here.connected() as connection:

        async def fetch(name: bytes) -> None:
            assert await read_file(connection, name) == files[name]

        with trio.move_on_after(300) as scope:
            async with trio.open_nursery() as nursery:
                for name in files:
                    nursery.start_soon(fetch, name)
        assert not scope.cancelled_caught


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "ardupilot5"])
async def test_an_open_that_comes_late_leaves_no_file_open(profile: str) -> None:
    """A program that looks into a directory all the time keeps PX4 from closing it."""
    async with rig(profile, {b"/d/f": b"hello"}, link=NEAR) as here:
        come_again(here, 4.0, lambda wire: wire[3] == Opcode.OPEN_FILE_RO)
        assert await read_file(here.connection, path(profile, "f")) == b"hello"
        await trio.sleep(6.0)
        for _ in range(25):
            await here.connection.store.list_directory(path(profile, "f").rsplit(b"/", 1)[0])
            await trio.sleep(1.0)
        assert not here.server.open_sessions


@pytest.mark.holds("promise 4")
async def test_a_listing_beside_a_rename_that_nobody_answers_ends_in_time() -> None:
    async with rig("px4-nuttx", {b"/d/f": b"hello"}, link=NEAR) as here:
        store, folder = here.connection.store, here.root + b"/d"
        await store.list_directory(folder)
        for opcode in (Opcode.RENAME, Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME):
            here.faults.ignore(opcode)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(partial(ended, store.rename(folder + b"/f", folder + b"/gg")))
            await trio.sleep(0.1)
            assert await ended(store.list_directory(folder)) < LATEST


@pytest.mark.holds("promise 4")
async def test_a_low_limit_does_not_hide_that_one_request_is_not_answered() -> None:
    options = ConnectOptions(bwlimit=20_000)
    async with rig("px4", {b"/d/big": content(1_200_000)}, link=NEAR, options=options) as here:
        reader = await here.connection.store.open_reader(b"/d/big", MemorySink(1_200_000))
        reader.want(0, 1_200_000, demand=True)
        await trio.sleep(2)
        here.faults.ignore(Opcode.CREATE_DIRECTORY)
        assert await ended(here.connection.store.make_directory(b"/d/x")) < LATEST + 4.0
        reader.close()


@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk", "px4"])
async def test_a_command_says_why_it_waits(profile: str) -> None:
    """ArduPilot refuses even listings while another client has a file open."""
    async with rig(
        profile, {b"/d/f": DATA, b"/d/theirs": DATA}, options=replace(DEFAULTS, patient=True)
    ) as here:
        tree, connection = here.mount(), here.connection
        session = session_of(Attached(connection, tree, Watcher(connection.status, writing=False)), Options())
        told: list[tuple[float, str]] = []
        here.another_asks(Opcode.OPEN_FILE_RO, path(profile, "theirs"))
        async with trio.open_nursery() as nursery:

            async def keep_it() -> None:
                for _ in range(10):
                    here.another_asks(Opcode.READ_FILE)
                    await trio.sleep(1.0)
                here.another_asks(Opcode.TERMINATE_SESSION)

            nursery.start_soon(keep_it)
            await trio.sleep(0.5)
            began = trio.current_time()
            async with waits_told(session, lambda line: told.append((trio.current_time() - began, line))):
                await tree.crc32(b"/d/f")
                file = await tree.open(b"/d/f")
                assert bytes(await file.read(0, len(DATA))) == DATA
        [(after, line)] = told
        assert line == "waiting: another FTP client may have a file open on the vehicle"
        assert 2.0 <= after < 3.0
        assert trio.current_time() - began > 8.0
