"""A file that is kept open and sent piece by piece, and that others replace while its program rests.

What was sent so far is delivered then, so that a successor is told by its time before more is. Virtual time.
"""

from __future__ import annotations

import random
from functools import partial

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.background import START_AT
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged, RequestTimeout
from tests.sim.test_replaced_between import NEW, OLD, THEN, TIMED, UNTIMED, Card
from tests.support.faults import Faults
from tests.support.mounting import mounted

REST = 30.0
"""Seconds: longer than the vehicle's file stays open, and than it takes to learn its time."""

BYTES = random.Random(3).randbytes(START_AT + 1000)
MID = b"mid"
RESUMING = [name for name in TIMED if name != "mavsdk"]
"""Those whose OpenFileWO leaves a file as it is."""


@pytest.mark.parametrize("later", [MID, BYTES, b""], ids=["little", "much", "nothing"])
@pytest.mark.parametrize("profile", TIMED)
async def test_what_is_sent_piece_by_piece_does_not_go_on_in_a_successor(
    profile: str, later: bytes, autojump: MockClock
) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await trio.sleep(REST)
        await writer.write(1000, BYTES)
        await trio.sleep(REST)
        successor = NEW[: len(OLD)]
        card.replace(successor)
        await writer.write(200_000, later)
        if later or profile == "mavsdk":
            with pytest.raises(FileChanged):
                await writer.fsync()
        else:
            await writer.fsync()  # it was on the card before
        assert card.world.tree.data(card.path) == successor
        writer.give_up()


@pytest.mark.parametrize("profile", TIMED)
async def test_what_is_appended_piece_by_piece_does_not_go_on_in_a_successor(
    profile: str, autojump: MockClock
) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(len(OLD), BYTES)
        await trio.sleep(REST)
        successor = NEW[: len(card.world.tree.data(card.path))]
        card.replace(successor)
        await writer.write(len(OLD) + len(BYTES), BYTES)
        await trio.sleep(REST)
        with pytest.raises(FileChanged):
            await writer.fsync()
        assert card.world.tree.data(card.path) == successor
        writer.give_up()


@pytest.mark.parametrize("profile", [*TIMED, *UNTIMED])
async def test_one_that_nobody_replaces_is_completed(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        now = bytearray(OLD)
        for at in (1000, 50_000, 120_000, 121_000):
            await writer.write(at, BYTES)
            now[at : at + len(BYTES)] = BYTES
            await trio.sleep(REST)
            await writer.write(300_000, MID)
            now[300_000:300_003] = MID
        await writer.release()
        assert card.world.tree.data(card.path) == bytes(now)


@pytest.mark.parametrize("profile", TIMED)
async def test_one_that_is_emptied_while_it_is_delivered_stays_on_the_card_for_now(
    profile: str, autojump: MockClock
) -> None:
    """Its program is about to write it anew: who reads the card meanwhile finds the file before."""
    for delay in (0.0, 1.9, 1.95, 2.0, 2.05, 2.1, 2.15, 2.2, 2.3, 2.5, 3.0):
        card = Card(profile)
        async with mounted(card.world) as (_, tree):
            writer = await tree.open(card.path, write=True)
            await writer.write(1000, BYTES)
            await trio.sleep(delay)
            await writer.truncate(0)
            await trio.sleep(REST)
            assert len(card.world.tree.data(card.path)) == len(OLD)
            await writer.write(0, MID)
            await writer.release()
            assert card.world.tree.data(card.path) == MID


@pytest.mark.parametrize("profile", RESUMING)
async def test_a_new_one_that_is_emptied_is_not_made_anew_before_it_is_closed(
    profile: str, autojump: MockClock
) -> None:
    card = Card(profile)
    path = card.path + b"-new"
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(1000, BYTES)
        await writer.release()  # what OpenFileWO does is known from now on
        new = await tree.create(path, exclusive=True)
        await new.write(0, BYTES)
        await trio.sleep(1.0)
        await new.truncate(0)
        await trio.sleep(REST)
        assert card.world.tree.data(path)
        await new.release()
        assert card.world.tree.data(path) == b""


@pytest.mark.parametrize("profile", RESUMING)
async def test_a_new_one_does_not_take_the_place_of_a_successor(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    path = card.path + b"-new"
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(1000, BYTES)
        await writer.release()
        new = await tree.create(path, exclusive=True)
        await new.write(0, BYTES)
        await trio.sleep(REST)
        successor = NEW[: len(BYTES)]
        card.world.tree.add(card.path + b"-other", successor, THEN)
        card.world.tree.rename(card.path + b"-other", path)
        await new.write(len(BYTES), MID)
        with pytest.raises(FileChanged):
            await new.fsync()
        assert card.world.tree.data(path) == successor
        new.give_up()


@pytest.mark.parametrize("profile", RESUMING)
async def test_who_writes_does_not_wait_for_that_delivery(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    faults = Faults(card.world)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(1000, BYTES)
        await trio.sleep(1.5)  # the next listing tells whether all is there
        faults.at(Opcode.LIST_DIRECTORY_WITH_TIME, partial(faults.cut_after, 0))
        await trio.sleep(4.0)
        began = trio.current_time()
        await writer.write(300_000, MID)
        assert trio.current_time() == began
        faults.cut_after(None)
        await trio.sleep(REST)
        await writer.release()
        assert card.world.tree.data(card.path)[300_000:300_003] == MID


async def test_what_fails_is_tried_ever_more_seldom(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    card, tries = Card("spec"), 0

    async def fail(*_: object) -> bool:
        nonlocal tries
        tries += 1
        raise RequestTimeout("silence")

    async with mounted(card.world, card.folder) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(1000, MID)
        await writer.fsync()  # what OpenFileWO does is known from now on
        monkeypatch.setattr(Deliverer, "deliver_locked", fail)
        await writer.write(1000, BYTES)
        await trio.sleep(600.0)
        assert 3 <= tries <= 30
        monkeypatch.undo()
        await writer.release()
        assert card.world.tree.data(card.path)[1000 : 1000 + len(BYTES)] == BYTES
