"""What it costs to know the time of a file that stays open for writing. Virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.dentries import COST_FACTOR
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from tests.sim.test_replaced_between import TIMED, UNTIMED, Card
from tests.support.faults import Faults
from tests.support.mounting import mounted

LISTINGS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
HOUR = 3600.0
RADIO = LinkSettings(rate=5760.0, delay=0.05, duplex=Duplex.HALF)


def listings(faults: Faults) -> int:
    """Return how many pages of listings were asked for, and forget them."""
    count = sum(opcode in LISTINGS for opcode in faults.requests)
    faults.requests.clear()
    return count


@pytest.mark.parametrize("profile", TIMED)
async def test_one_listing_once_it_is_open_for_a_while(profile: str, autojump: MockClock) -> None:
    card = Card(profile, others=True)
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        whole = listings(faults)
        files = [await tree.open(card.path, write=True) for _ in range(3)]
        await trio.sleep(1.0)
        assert listings(faults) == 0
        await trio.sleep(HOUR)
        assert listings(faults) == whole
        for file in files:
            await file.release()


@pytest.mark.parametrize("profile", [*TIMED, *UNTIMED])
async def test_none_where_it_is_closed_sooner_or_no_times_are_told(profile: str, autojump: MockClock) -> None:
    card = Card(profile, others=True)
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        listings(faults)
        reader = await tree.open(card.path)
        file = await tree.open(card.path, write=True)
        await trio.sleep(HOUR if profile in UNTIMED else 1.0)
        await file.release()
        await trio.sleep(HOUR)
        assert listings(faults) == 0
        await reader.release()


@pytest.mark.parametrize("profile", TIMED)
async def test_a_link_that_is_cut_just_then_is_no_reason_not_to_know(
    profile: str, autojump: MockClock
) -> None:
    card = Card(profile, others=True)
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        file = await tree.open(card.path, write=True)
        faults.cut_after(0)
        await trio.sleep(60.0)
        faults.cut_after(None)
        await trio.sleep(60.0)
        card.replace()
        await file.write(100, b"mid")
        with pytest.raises(FileChanged):
            await file.fsync()
        file.give_up()


@pytest.mark.parametrize("profile", TIMED)
async def test_a_listing_asked_for_by_others_is_enough(profile: str, autojump: MockClock) -> None:
    """It shows that the file is another one before anybody writes: who has it open hears that by then."""
    card = Card(profile, others=True)
    async with mounted(card.world, card.folder) as (_, tree):
        file = await tree.open(card.path, write=True)
        await trio.sleep(HOUR)
        card.replace()
        await tree.list(card.folder)
        with pytest.raises(FileChanged):
            await file.write(100, b"mid")
        again = await tree.open(card.path, write=True)
        await again.write(100, b"mid")
        await again.release()
        assert card.world.tree.data(card.path)[100:103] == b"mid"
        file.give_up()


@pytest.mark.parametrize("profile", TIMED)
async def test_who_delivers_again_and_again_over_a_radio(profile: str, autojump: MockClock) -> None:
    """A listing that takes long is asked for the more seldom: twice in 50 times as long, or so."""
    card = Card(profile, others=True, link=RADIO)
    card.world.tree.add(card.path, bytes(1000))
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        listed = tree._dentries.known(card.folder)
        assert listed is not None
        whole, took = listings(faults), listed.ended_at - listed.listed_at
        file = await tree.open(card.path, write=True)
        while trio.current_time() < HOUR:
            await file.write(0, b"mid")
            await file.fsync()
            await trio.sleep(4.0)
        assert listings(faults) < 3 * whole * HOUR / (COST_FACTOR * took)
        await file.release()


@pytest.mark.parametrize("profile", TIMED)
async def test_a_directory_that_is_gone_is_not_asked_for_again(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    path = card.folder.rstrip(b"/") + b"/d/file"
    card.world.tree.add(path, bytes(1000))
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        file = await tree.open(path, write=True)
        card.world.tree.remove(path)
        card.world.tree.rmdir(split(path)[0])
        await trio.sleep(60.0)
        listings(faults)
        await trio.sleep(HOUR)
        assert listings(faults) == 0
        await file.release()
