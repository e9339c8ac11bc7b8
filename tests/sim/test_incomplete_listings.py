"""A directory that was refused or not listed to its end is an error for whoever lists it (promise 10), and a
size that only an open reply tells is not believed where it would make a copy short. Virtual time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.shared.errors import DataUnproven, FtpNak, ListingIncomplete, MavftpfsError, NotFound
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.lying import lie_for
from tests.support.mounting import mounted
from tests.support.replies import ack, nak
from tests.support.worlds import World, content, path, world

pytestmark = pytest.mark.holds("promise 10")

Spoil = Callable[[Payload, Payload], Payload]
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
NAMES = [f"file_{number:02}" for number in range(60)]
WHOLE = content(60_000)


def sixty(profile: str = "px4") -> World:
    made = world(profile)
    for name in NAMES:
        made.tree.add(path(profile, name), name.encode())
    return made


def names_in(error: pytest.ExceptionInfo[ListingIncomplete]) -> set[bytes]:
    return {name for name, _ in error.value.entries}


class FirstPageAgain:
    """Has each request for a page below the end answered by the first one."""

    def __init__(self, made: World, end: int) -> None:
        self.end = end
        self.first: bytes | None = None
        self.server = lie_for(made)
        self.server.change = self.change

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
    end: int, autojump: MockClock, caplog: pytest.LogCaptureFixture
) -> None:
    made = sixty()
    FirstPageAgain(made, end)
    async with mounted(made) as (_, tree):
        for _ in range(2):
            with pytest.raises(ListingIncomplete) as error:
                await tree.list(b"/d")
            assert 1 < len(names_in(error)) < len(NAMES)
    lines = [line for line in caplog.records if line.levelno >= logging.WARNING]
    assert len(lines) == 1
    assert "/d" in lines[0].getMessage()


async def test_names_that_an_incomplete_listing_lacks_are_asked_for(autojump: MockClock) -> None:
    made = sixty()
    FirstPageAgain(made, 60)
    async with mounted(made) as (_, tree):
        with pytest.raises(ListingIncomplete) as error:
            await tree.list(b"/d")
        lacking = next(name.encode() for name in NAMES if name.encode() not in names_in(error))
        assert (await tree.stat(b"/d/" + lacking)).size == len(lacking)
        file = await tree.open(b"/d/" + lacking)
        assert bytes(await file.read(0, 100)) == lacking
        file.close()
        made.tree.add(b"/d/later", b"12345")
        assert (await tree.stat(b"/d/later")).size == 5
        with pytest.raises(NotFound):
            await tree.stat(b"/d/never")
        assert tree.negative_valid_for(b"/d/never") == 0
        made.tree.add(b"/d/never", b"123")
        assert (await tree.stat(b"/d/never")).size == 3


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_listing_that_is_refused_midway_is_an_error(profile: str, autojump: MockClock) -> None:
    made = sixty(profile)

    def refuse(request: Payload, reply: Payload) -> Iterable[Payload]:
        refused = request.opcode in LISTS and request.data.startswith(b"/d\0") and request.offset > 0
        return [nak(request, NakCode.FILE_NOT_FOUND) if refused else reply]

    lie_for(made).change = refuse
    async with mounted(made) as (_, tree):
        with pytest.raises(FtpNak):
            await tree.list(b"/d")


def claim(made: World, size: int) -> None:
    """Have open replies tell this size."""

    def change(request: Payload, reply: Payload) -> Iterable[Payload]:
        opened = request.opcode == Opcode.OPEN_FILE_RO and reply.opcode == Opcode.ACK
        return [reply._replace(data=size.to_bytes(4, "little")) if opened else reply]

    lie_for(made).change = change


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
@pytest.mark.parametrize("size", [0, 30_000, 59_999])
async def test_an_open_reply_that_tells_too_small_a_size_is_not_believed(
    profile: str, size: int, autojump: MockClock
) -> None:
    made = world(profile, f=WHOLE)
    claim(made, size)
    async with mounted(made, path(profile, "")[:-1]) as (_, tree):
        with pytest.raises(DataUnproven):
            await tree.open(path(profile, "f"))


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_file_that_became_smaller_since_it_was_listed_is_read(
    profile: str, autojump: MockClock
) -> None:
    made = world(profile, f=WHOLE)
    async with mounted(made, path(profile, "")[:-1]) as (_, tree):
        await trio.sleep(1.0)
        made.tree.add(path(profile, "f"), WHOLE[:30_000])
        file = await tree.open(path(profile, "f"))
        assert file.size == 30_000
        assert bytes(await file.read(0, 60_000)) == WHOLE[:30_000]
        file.close()


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
async def test_a_file_that_cannot_be_completed_is_an_error(spoil: Spoil, autojump: MockClock) -> None:
    made = world("px4", f=WHOLE[:1000])
    lie_for(made).change = lambda request, reply: [
        spoil(request, reply) if request.opcode == Opcode.READ_FILE else reply
    ]
    async with mounted(made) as (_, tree):
        file = await tree.open(path("px4", "f"))
        with pytest.raises(MavftpfsError), trio.fail_after(150.0):
            await file.read(0, 1000)
        file.close()


async def test_with_dir_timeout_0_a_new_file_is_found_by_the_next_open(autojump: MockClock) -> None:
    made = World("px4", LinkSettings(rate=5_000, delay=0.1))  # a listing takes long
    made.tree.add(b"/d/old", b"1")
    async with mounted(made, b"/d", dir_timeout=0.0) as (_, tree):
        with pytest.raises(NotFound):
            await tree.open(b"/d/new")
        assert tree.negative_valid_for(b"/d/new") == 0
        made.tree.add(b"/d/new", b"2")
        file = await tree.open(b"/d/new")
        assert bytes(await file.read(0, 9)) == b"2"
        file.close()
