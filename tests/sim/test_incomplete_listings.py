"""A directory that was refused or not listed to its end is an error for every program that lists it (promise
10), and a size that only an open reply tells is not believed where it would make a copy short. Virtual time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import pytest
import trio

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import (
    DataUnproven,
    FtpNak,
    ListingIncomplete,
    MavftpfsError,
    NotFound,
    OutcomeUnknown,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.replies import ack, nak
from tests.support.rigs import Rig, read_file, rig
from tests.support.transfers import content

pytestmark = pytest.mark.holds("promise 10")

Spoil = Callable[[Payload, Payload], Payload]
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
KINDS = ["px4", "ardupilot", "mavsdk"]
SIXTY = {b"/d/file_%02d" % number: b"file_%02d" % number for number in range(60)}
WHOLE = content(60_000)
F = b"/d/f"


class FirstPageAgain:
    """Has each request for a page below the end answered by the first one."""

    def __init__(self, here: Rig, end: int) -> None:
        self.end = end
        self.first: bytes | None = None
        here.server.change = self.change

    def change(self, request: Payload, reply: Payload) -> Iterable[Payload]:
        if request.opcode not in LISTS or not request.data.startswith(b"/d\0"):
            return [reply]
        if reply.opcode == Opcode.ACK and request.offset == 0:
            self.first = reply.data
        if self.first is None or request.offset >= self.end:
            return [nak(request, NakCode.EOF)] if request.offset >= self.end else [reply]
        return [ack(request, self.first)]


@pytest.mark.parametrize("end", [60, 1 << 30])
async def test_a_server_that_repeats_its_first_page_is_not_believed(
    end: int, caplog: pytest.LogCaptureFixture
) -> None:
    async with rig(files=SIXTY) as here:
        FirstPageAgain(here, end)
        tree = here.mount()
        for _ in range(2):
            with pytest.raises(ListingIncomplete) as error:
                await tree.list(b"/d")
            assert 1 < len(dict(error.value.entries)) < len(SIXTY)
    lines = [line for line in caplog.records if line.levelno >= logging.WARNING]
    assert len(lines) == 1
    assert "/d" in lines[0].getMessage()


@pytest.mark.parametrize("profile", ["ardupilot", "littlefs", "mavsdk"])
async def test_a_name_that_fits_no_reply_does_not_hide_those_behind_it(
    profile: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Servers answer EOF at its offset; rsync --delete would remove the copies of what comes behind it."""
    files = {b"/d/a": b"1", b"/d/b" + b"n" * 240: b"2"} | {b"/d/%c" % letter: b"3" for letter in b"cdef"}
    async with rig(profile, files) as here:
        tree = here.mount()
        for _ in range(2):
            with pytest.raises(ListingIncomplete) as error:
                await tree.list(b"/d")
            assert {b"a", b"e", b"f"} <= dict(error.value.entries).keys()
            await trio.sleep(60.0)
        assert (await tree.stat(b"/d/f")).size == 1
        here.card.remove(here.root + b"/d/b" + b"n" * 240)
        await trio.sleep(60.0)
        assert set(dict(await tree.list(b"/d"))) == {b"a", b"c", b"d", b"e", b"f"}
    assert len([line for line in caplog.messages if "not listed to its end" in line]) == 1


@pytest.mark.parametrize("profile", KINDS)
async def test_behind_the_end_of_a_directory_is_looked_once_and_again_when_its_entries_changed(
    profile: str,
) -> None:
    asked: list[int] = []

    def note(request: Payload) -> None:
        if request.opcode in LISTS and request.data.startswith(b"/d\0"):
            asked.append(request.offset)

    async with rig(profile, {b"/d/a": b"1", b"/d/b": b"2"}) as here:
        here.server.answer = note
        tree = here.mount(dir_timeout=1.0)
        for expected in ([0, 2, 3], [0, 2], [0, 2], [0, 3, 4], [0, 3]):
            if expected == [0, 3, 4]:
                here.put(b"/d/c", b"3")
            asked.clear()
            await tree.list(b"/d")
            dots = asked[1] - expected[1]  # `.` and `..` count, too
            assert asked == [0, *(offset + dots for offset in expected[1:])]
            await trio.sleep(5.0)


async def test_a_name_that_an_incomplete_listing_lacks_is_an_error_and_not_absent() -> None:
    async with rig(files=SIXTY) as here:
        FirstPageAgain(here, 60)
        tree = here.mount()
        with pytest.raises(ListingIncomplete) as error:
            await tree.list(b"/d")
        shown = dict(error.value.entries)
        lacking = next(name for name in SIXTY.values() if name not in shown)
        with pytest.raises(ListingIncomplete):
            await tree.stat(b"/d/" + lacking)
        assert tree.negative_valid_for(b"/d/" + lacking) == 0


async def test_a_name_that_an_incomplete_listing_lacks_does_not_count_as_removed() -> None:
    """The rename that gives a file its name was not answered: what has the name is not known before."""
    async with rig(files=SIXTY | {F: b"before all"}, options=ConnectOptions(op_deadline=5.0)) as here:
        tree = here.mount()
        file = await tree.open(F, write=True)
        await file.write(0, b"Before all")
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), drop=True)
        with pytest.raises(OutcomeUnknown):
            await file.fsync()
        FirstPageAgain(here, 60)
        here.faults.cut_after(None)
        with pytest.raises(ListingIncomplete):
            await file.fsync()
        with pytest.raises(ListingIncomplete):
            await tree.unlink(b"/d/file_58")
        here.server.change = None
        await file.release()
        assert here.data(F) == b"Before all"


@pytest.mark.parametrize("profile", KINDS)
async def test_a_listing_that_is_refused_midway_is_an_error(profile: str) -> None:
    def refuse(request: Payload, reply: Payload) -> Iterable[Payload]:
        refused = request.opcode in LISTS and request.data.startswith(b"/d\0") and request.offset > 0
        return [nak(request, NakCode.FILE_NOT_FOUND) if refused else reply]

    async with rig(profile, SIXTY) as here:
        here.server.change = refuse
        with pytest.raises(FtpNak):
            await here.mount().list(b"/d")


@pytest.mark.parametrize("profile", KINDS)
@pytest.mark.parametrize("size", [0, 30_000, 59_999])
async def test_an_open_reply_that_tells_too_small_a_size_is_not_believed(profile: str, size: int) -> None:
    def claim(request: Payload, reply: Payload) -> Iterable[Payload]:
        opened = request.opcode == Opcode.OPEN_FILE_RO and reply.opcode == Opcode.ACK
        return [reply._replace(data=size.to_bytes(4, "little")) if opened else reply]

    async with rig(profile, {F: WHOLE}) as here:
        here.server.change = claim
        with pytest.raises(DataUnproven):
            await here.mount().open(F)


@pytest.mark.parametrize("profile", KINDS)
async def test_a_file_that_became_smaller_since_it_was_listed_is_read(profile: str) -> None:
    async with rig(profile, {F: WHOLE}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        await trio.sleep(1.0)
        here.put(F, WHOLE[:30_000])
        assert await read_file(tree, F) == WHOLE[:30_000]


def early_end(request: Payload, reply: Payload) -> Payload:
    return nak(request, NakCode.EOF) if request.offset >= 500 else reply


def empty_ack(request: Payload, reply: Payload) -> Payload:
    return ack(request, b"") if request.offset >= 239 else reply


def shifted(request: Payload, reply: Payload) -> Payload:
    return reply._replace(offset=reply.offset + 1)


def other_opcode(request: Payload, reply: Payload) -> Payload:
    return reply._replace(req_opcode=Opcode.LIST_DIRECTORY)


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("spoil", [early_end, empty_ack, shifted, other_opcode])
async def test_a_file_that_cannot_be_completed_is_an_error(spoil: Spoil) -> None:
    async with rig(files={F: WHOLE[:1000]}) as here:
        here.server.change = lambda request, reply: [
            spoil(request, reply) if request.opcode == Opcode.READ_FILE else reply
        ]
        file = await here.mount().open(F)
        with pytest.raises(MavftpfsError), trio.fail_after(150.0):
            await file.read(0, 1000)
        file.close()


async def test_with_dir_timeout_0_a_new_file_is_found_by_the_next_open() -> None:
    slow = LinkSettings(rate=5_000, delay=0.1)  # a listing takes long
    async with rig(files={b"/d/old": b"1"}, link=slow) as here:
        tree = here.mount(dir_timeout=0.0)
        with pytest.raises(NotFound):
            await tree.open(b"/d/new")
        assert tree.negative_valid_for(b"/d/new") == 0
        here.put(b"/d/new", b"2")
        assert await read_file(tree, b"/d/new") == b"2"
