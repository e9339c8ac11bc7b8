"""A file that others replace while changes of it wait here: what goes to the card is of one file.

Virtual time.
"""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged
from tests.sim.test_replaced import IDLE, NEW, OLD, PATH, STEP, TIMED, Card
from tests.support.faults import Faults
from tests.support.mounting import mounted

pytestmark = pytest.mark.holds("fault replaced file")

MID = b"mid"
SUCCESSOR = NEW[: len(OLD)]


async def wait_and_replace(card: Card) -> None:
    """Have the server's session closed, and the file replaced."""
    await trio.sleep(IDLE)
    card.replace()


async def read_and_write(card: Card, tree: Tree, writer: OpenFile) -> None:
    assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
    await writer.write(100, MID)
    await wait_and_replace(card)


async def write_only(card: Card, tree: Tree, writer: OpenFile) -> None:
    await writer.write(100, MID)
    await wait_and_replace(card)


async def write_late(card: Card, tree: Tree, writer: OpenFile) -> None:
    """Nothing was read that could be compared: the time at which it was opened decides."""
    await wait_and_replace(card)
    await writer.write(100, MID)


async def write_again(card: Card, tree: Tree, writer: OpenFile) -> None:
    await writer.write(100, MID)
    await writer.fsync()
    await wait_and_replace(card)
    await writer.write(300, MID)


async def write_and_list(card: Card, tree: Tree, writer: OpenFile) -> None:
    """The listing is the first one that shows a time of what was delivered, and it is the successor's."""
    await writer.write(100, MID)
    await writer.fsync()
    await trio.sleep(30.0)
    card.replace()
    await tree.list(b"/")
    await writer.write(300, MID)


async def cut(card: Card, tree: Tree, writer: OpenFile) -> None:
    await wait_and_replace(card)
    await writer.truncate(1000)


async def cut_and_write(card: Card, tree: Tree, writer: OpenFile) -> None:
    await cut(card, tree, writer)
    await writer.write(100, MID)


@pytest.mark.parametrize(
    "change", [read_and_write, write_only, write_late, write_again, write_and_list, cut, cut_and_write]
)
@pytest.mark.parametrize("profile", TIMED)
async def test_a_change_of_the_old_file_does_not_go_into_its_successor(
    profile: str, change: object, autojump: MockClock
) -> None:
    """What is written whole does."""
    card = Card(profile)
    async with mounted(card.world, b"/") as (_, tree):
        writer = await tree.open(PATH, write=True)
        await change(card, tree, writer)  # type: ignore[operator]
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert card.world.tree.data(PATH) == SUCCESSOR
        await writer.truncate(0)
        await writer.write(0, b"whole")
        await writer.release()
        assert card.world.tree.data(PATH) == b"whole"


@pytest.mark.parametrize("profile", TIMED)
async def test_the_same_file_is_completed_and_read_on(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    expected = bytearray(OLD)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(PATH, write=True)
        assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
        for at in (100, 300):
            await writer.write(at, MID)
            await trio.sleep(IDLE)
            await writer.fsync()
            expected[at : at + 3] = MID
            await trio.sleep(IDLE)
            assert bytes(await writer.read(0, len(OLD))) == expected
            await trio.sleep(30.0)
        await writer.release()
        assert card.world.tree.data(PATH) == expected


@pytest.mark.parametrize("successor", [SUCCESSOR, OLD + b"more"], ids=["as long", "grown"])
async def test_one_that_comes_while_the_whole_file_is_sent_is_not_replaced(
    successor: bytes, autojump: MockClock
) -> None:
    card = Card("mavsdk")
    faults = Faults(card.world)
    async with mounted(card.world, b"/") as (_, tree):
        writer = await tree.open(PATH, write=True)
        await writer.write(100, MID)
        faults.at(Opcode.WRITE_FILE, lambda: faults.after(100, lambda: card.replace(successor)))
        with pytest.raises(FileChanged):
            await writer.fsync()
        assert card.world.tree.data(PATH) == successor
        assert not [entry for entry in card.world.tree.entries(b"/") if is_reserved(entry.name)]
        writer.give_up()


@pytest.mark.parametrize("profile", TIMED)
async def test_what_was_written_is_not_read_among_bytes_of_a_successor(
    profile: str, autojump: MockClock
) -> None:
    """The rest of the file is opened anew after its delivery."""
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        writer = await tree.open(PATH, write=True)
        await writer.write(100, MID)
        await writer.fsync()
        await wait_and_replace(card)
        try:
            assert bytes(await writer.read(0, len(OLD))) == OLD[:100] + MID + OLD[103:]
        except FileChanged:
            with pytest.raises(FileChanged):
                await writer.write(0, MID)
        await writer.release()
        assert card.world.tree.data(PATH) == SUCCESSOR


@pytest.mark.parametrize("profile", TIMED)
async def test_what_may_be_of_two_files_is_not_kept_of_one_that_is_unlinked(
    profile: str, autojump: MockClock
) -> None:
    """All of it is held here, but of two sessions of the server, which were not compared yet."""
    card = Card(profile)
    async with mounted(card.world) as (_, tree):
        reader = await tree.open(PATH)
        assert bytes(await reader.read(0, STEP)) == OLD[:STEP]
        version = reader._handle._version  # type: ignore[attr-defined]
        version.compare_after = float("inf")  # as while readers take turns
        await wait_and_replace(card)
        for at in range(STEP, len(OLD) - STEP, STEP):
            await reader.read(at, STEP)
        await trio.sleep(IDLE)
        assert version.complete
        await tree.unlink(PATH)
        with pytest.raises(FileChanged):
            await reader.read(0, len(OLD))
        await reader.release()
