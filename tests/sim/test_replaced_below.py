"""A file that others replace while changes of it wait here: what goes to the card is of one file.

Virtual time.
"""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import OpenFile
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged
from tests.sim.test_replaced import STEP
from tests.sim.test_replaced_between import IDLE, NEW, OLD, THEN, TIMED, Card
from tests.support.faults import Faults
from tests.support.mounting import mounted

MID = b"mid"
CHANGED = NEW[: len(OLD)]


async def require_refused(card: Card, writer: OpenFile, successor: bytes = CHANGED) -> None:
    """What was changed is not delivered, however often that is tried, and the successor stays as it is."""
    for _ in range(2):
        with pytest.raises(FileChanged):
            await writer.fsync()
    assert card.world.tree.data(card.path) == successor
    writer.give_up()


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


@pytest.mark.parametrize("many", [False, True], ids=["few names", "many names"])
@pytest.mark.parametrize("profile", TIMED)
async def test_what_only_writes_puts_no_part_into_a_successor(
    profile: str, many: bool, autojump: MockClock
) -> None:
    """Nothing was read that could be compared: the time at which it was opened decides."""
    card = Card(profile, others=many)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await trio.sleep(IDLE)
        card.replace()
        await writer.write(100, MID)
        await require_refused(card, writer)


@pytest.mark.parametrize("profile", TIMED)
async def test_a_listing_that_is_not_kept_tells_as_much(profile: str, autojump: MockClock) -> None:
    """Other deliveries in that directory ask for newer ones while it is under way."""
    card = Card(profile, others=True)
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):

        def others_ask() -> None:
            tree._dentries.expire(card.folder, trio.current_time())
            faults.at(Opcode.LIST_DIRECTORY_WITH_TIME, others_ask)

        writer = await tree.open(card.path, write=True)
        await trio.sleep(IDLE)
        card.replace()
        await writer.write(100, MID)
        others_ask()
        await require_refused(card, writer)


@pytest.mark.parametrize("many", [False, True], ids=["few names", "many names"])
@pytest.mark.parametrize("profile", TIMED)
async def test_what_waits_here_does_not_go_into_a_successor(
    profile: str, many: bool, autojump: MockClock
) -> None:
    card = Card(profile, others=many)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(100, MID)
        await trio.sleep(IDLE)
        card.replace()
        await require_refused(card, writer)


@pytest.mark.parametrize("part", [False, True], ids=["cut", "cut and changed"])
@pytest.mark.parametrize("successor", [CHANGED, CHANGED[:2000]], ids=["as long", "shorter"])
@pytest.mark.parametrize("profile", TIMED)
async def test_a_successor_is_not_cut(
    profile: str, successor: bytes, part: bool, autojump: MockClock
) -> None:
    card = Card(profile, others=True)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await trio.sleep(IDLE)
        card.replace(successor)
        await writer.truncate(1000)
        await writer.write(100, MID * part)
        await require_refused(card, writer, successor)


@pytest.mark.parametrize("profile", TIMED)
async def test_what_is_written_after_a_delivery_among_many_names(profile: str, autojump: MockClock) -> None:
    """Its delivery was verified without a listing."""
    card = Card(profile, others=True)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(card.path, write=True)
        await writer.write(100, MID)
        await writer.fsync()
        await trio.sleep(IDLE)
        card.replace()
        await writer.write(300, MID)
        await require_refused(card, writer)


@pytest.mark.parametrize("profile", TIMED)
async def test_what_was_read_from_the_cache_decides_nothing_about_a_successor(
    profile: str, autojump: MockClock
) -> None:
    """The cache may be older than the file by dir_timeout; what is written by it is for the old one."""
    card = Card(profile, others=True)
    async with mounted(card.world) as (_, tree):
        reader = await tree.open(card.path)
        assert bytes(await reader.read(0, STEP)) == OLD[:STEP]
        await reader.release()
        await trio.sleep(IDLE)
        card.replace()
        writer = await tree.open(card.path, write=True)
        try:
            assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
        except FileChanged:
            pass
        else:
            await writer.write(100, MID)
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert card.world.tree.data(card.path) == CHANGED
        writer.give_up()


@pytest.mark.parametrize("successor", [CHANGED, OLD + b"more"], ids=["as long", "grown"])
@pytest.mark.parametrize("many", [False, True], ids=["few names", "many names"])
async def test_one_that_comes_while_the_whole_file_is_sent_is_not_replaced(
    many: bool, successor: bytes, autojump: MockClock
) -> None:
    """The server truncates what it opens, so a part that is changed means to send all of it."""
    card = Card("mavsdk", others=many)
    faults = Faults(card.world)
    async with mounted(card.world, card.folder) as (_, tree):
        writer = await tree.open(card.path, write=True)
        assert bytes(await writer.read(0, len(OLD))) == OLD
        await writer.write(100, MID)
        await trio.sleep(IDLE)
        faults.at(Opcode.WRITE_FILE, lambda: faults.after(500, lambda: card.replace(successor)))
        with pytest.raises(FileChanged):
            await writer.fsync()
        assert card.world.tree.data(card.path) == successor
        assert not [entry for entry in card.world.tree.entries(card.folder) if is_reserved(entry.name)]
        writer.give_up()


@pytest.mark.parametrize("profile", TIMED)
async def test_what_was_known_of_a_file_before_is_not_of_the_next(profile: str, autojump: MockClock) -> None:
    """Who has the old one open to read keeps what is remembered of its name."""
    card = Card(profile)
    async with mounted(card.world, card.folder) as (_, tree):
        reader = await tree.open(card.path)
        await trio.sleep(30.0)
        await tree.list(card.folder)
        assert bytes(await reader.read(0, STEP)) == OLD[:STEP]
        card.replace()
        with pytest.raises(FileChanged):
            await tree.truncate(card.path, 1000)
        card.replace(b"", THEN + 200)
        await trio.sleep(30.0)
        writer = await tree.open(card.path, write=True, truncate=True)
        await trio.sleep(30.0)
        await tree.list(card.folder)
        await writer.write(0, MID)
        await writer.release()
        assert card.world.tree.data(card.path) == MID
        await reader.release()
