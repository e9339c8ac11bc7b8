"""A file that others replace while changes of it wait here: what goes to the card is of one file.

Virtual time.
"""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.shared.errors import FileChanged
from tests.sim.test_replaced import STEP
from tests.sim.test_replaced_between import IDLE, NEW, OLD, TIMED, Card
from tests.support.mounting import mounted

MID = b"mid"
CHANGED = NEW[: len(OLD)]


@pytest.mark.parametrize("profile", TIMED)
async def test_no_part_of_each_gets_its_place(profile: str, autojump: MockClock) -> None:
    """Where a change of a part means to send all of it, the rest was fetched of the successor."""
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
        await writer.write(100, MID)
        await trio.sleep(IDLE)
        card.replace()
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert card.world.tree.data(card.path) == CHANGED
        await writer.truncate(0)
        await writer.write(0, b"whole")
        await writer.release()
        assert card.world.tree.data(card.path) == b"whole"


@pytest.mark.parametrize("profile", TIMED)
async def test_the_same_file_is_completed(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
        await writer.write(100, MID)
        await trio.sleep(IDLE)
        await writer.release()
        assert card.world.tree.data(card.path) == OLD[:100] + MID + OLD[103:]


@pytest.mark.parametrize("profile", TIMED)
async def test_what_may_be_of_two_files_is_not_kept_of_one_that_is_unlinked(
    profile: str, autojump: MockClock
) -> None:
    """All of it is held here, but of two sessions of the server, which were not compared yet."""
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        reader = await tree.open(card.path)
        assert bytes(await reader.read(0, STEP)) == OLD[:STEP]
        version = reader._handle._version  # type: ignore[attr-defined]
        version.blocks.openings.look_at = float("inf")  # as while readers take turns
        await trio.sleep(IDLE)
        card.replace()
        for at in range(STEP, len(OLD) - STEP, STEP):
            await reader.read(at, STEP)
        await trio.sleep(IDLE)
        assert version.blocks.complete
        await tree.unlink(card.path)
        with pytest.raises(FileChanged):
            await reader.read(0, len(OLD))
        await reader.release()


@pytest.mark.parametrize("profile", TIMED)
async def test_what_was_written_is_not_read_among_bytes_of_a_successor(
    profile: str, autojump: MockClock
) -> None:
    """The rest of the file is opened anew after its delivery."""
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(100, MID)
        await writer.fsync()
        written = OLD[:100] + MID + OLD[103:]
        await trio.sleep(IDLE)
        card.replace()
        try:
            assert bytes(await writer.read(0, len(OLD))) == written
        except FileChanged:
            with pytest.raises(FileChanged):
                await writer.write(0, MID)
        await writer.release()
        assert card.world.tree.data(card.path) == CHANGED


@pytest.mark.parametrize("profile", TIMED)
async def test_what_was_written_is_read_among_the_rest(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        for at in (100, 300):
            await writer.write(at, MID)
            await writer.fsync()
            await trio.sleep(IDLE)
            expected = OLD[:100] + MID + OLD[103:]
            expected = expected if at == 100 else expected[:300] + MID + expected[303:]
            assert bytes(await writer.read(0, len(OLD))) == expected
            await trio.sleep(30.0)
        await writer.release()
        assert card.world.tree.data(card.path) == expected


@pytest.mark.parametrize("profile", TIMED)
async def test_what_is_written_after_a_delivery_does_not_go_into_a_successor(
    profile: str, autojump: MockClock
) -> None:
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(100, MID)
        await writer.fsync()
        await trio.sleep(IDLE)
        card.replace()
        await writer.write(300, MID)
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert card.world.tree.data(card.path) == CHANGED
        await writer.truncate(0)
        await writer.write(0, b"whole")
        await writer.release()
        assert card.world.tree.data(card.path) == b"whole"
