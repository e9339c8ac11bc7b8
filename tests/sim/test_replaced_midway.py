"""A file that others replace in the middle of an upload in place, while it is not open on the vehicle.

Our own writes moved its time, and its size is right: bytes that were written tell. Virtual time.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FileChanged
from mavftpfs.sim.linkmodel import LinkSettings
from tests.sim.test_doubted_bytes import KEEPING
from tests.sim.test_replaced_between import NEW, OLD, Card
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.takingturns import taking_turns
from tests.support.worlds import World

PART = random.Random(4).randbytes(300_000)
SUCCESSOR = NEW[: len(OLD)]
RADIO = LinkSettings(rate=40_000.0, delay=0.02)


class Copying:
    """Changes most of a file in place while another one is copied in turns with that."""

    def __init__(self, profile: str, link: LinkSettings = RADIO) -> None:
        self.card = Card(profile, link=link)
        self.faults = Faults(self.card.world)
        self.other = self.card.folder.rstrip(b"/") + b"/another"
        self.card.world.tree.add(self.other, OLD)

    async def change(self, tree: Tree, meanwhile: Callable[[], None], data: bytes = PART) -> OpenFile:
        """Write it; `meanwhile` when the other one is opened for the first time."""
        writer = await tree.open(self.card.path, write=True)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self._copy, tree, meanwhile)
            with suppress(FileChanged):  # a write that waits for room hears of it, too
                await writer.write(0, data)
                await writer.write(len(data) - 1, data[-1:])
        return writer

    async def _copy(self, tree: Tree, meanwhile: Callable[[], None]) -> None:
        await trio.sleep(3.0)
        self.faults.at(Opcode.OPEN_FILE_RO, meanwhile)
        await self.copy(tree)

    async def copy_for(self, tree: Tree, seconds: float) -> None:
        """Copy the other file again and again."""
        stop = trio.current_time() + seconds
        while trio.current_time() < stop:
            await self.copy(tree)
            tree.forget_caches()

    async def copy(self, tree: Tree) -> None:
        """Read all of the other file."""
        reader = await tree.open(self.other)
        assert bytes(await reader.read(0, len(OLD))) == OLD
        await reader.release()


@pytest.mark.parametrize("profile", KEEPING)
async def test_nothing_goes_into_a_successor(profile: str, autojump: MockClock) -> None:
    both = Copying(profile)
    async with mounted(both.card.world, both.card.folder) as (_, tree):
        writer = await both.change(tree, lambda: both.card.replace(SUCCESSOR))
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert both.card.world.tree.data(both.card.path) == SUCCESSOR
        writer.give_up()


@pytest.mark.parametrize("profile", KEEPING)
async def test_the_same_file_is_completed(profile: str, autojump: MockClock) -> None:
    both, opened = Copying(profile), []
    async with mounted(both.card.world, both.card.folder) as (_, tree):
        writer = await both.change(tree, lambda: opened.append(both.card.world.tree.data(both.card.path)))
        await writer.release()
        assert both.card.world.tree.data(both.card.path) == PART + OLD[len(PART) :]
    assert opened[0][:1000] == PART[:1000]  # it was in the middle
    assert opened[0][-200_000:] == OLD[-200_000:]


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(2, 40))]
)
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_what_is_written_again_and_again_is_taken_for_ours(
    profile: str, seed: int, autojump: MockClock
) -> None:
    """Nobody else is there, but bytes are sent that differ from those sent before to the same place."""
    rng = random.Random(seed)
    link = LinkSettings(rate=40_000.0, delay=rng.choice([0.02, 0.2]), loss=0.03, duplicate=0.05)
    both = Copying(profile, link)
    model = bytearray(OLD)
    async with mounted(both.card.world, both.card.folder) as (_, tree), trio.open_nursery() as nursery:
        nursery.start_soon(both.copy_for, tree, 60.0)
        writer = await tree.open(both.card.path, write=True)
        for _ in range(12):
            at, data = rng.randrange(300_000), rng.randbytes(rng.choice([10, 3000, 90_000]))
            model[at : at + len(data)] = data
            await writer.write(at, data)
            await trio.sleep(rng.choice([0.0, 0.5, 6.0]))
        await writer.release()
        nursery.cancel_scope.cancel()
    assert both.card.world.tree.data(both.card.path) == model


@pytest.mark.parametrize("profile", KEEPING)
async def test_a_successor_of_a_file_that_is_written_all_over_stays(
    profile: str, autojump: MockClock
) -> None:
    both = Copying(profile)
    async with mounted(both.card.world, both.card.folder) as (_, tree):
        writer = await both.change(tree, lambda: both.card.replace(SUCCESSOR), NEW[-len(OLD) :])
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert both.card.world.tree.data(both.card.path) == SUCCESSOR
        writer.give_up()


def answer_reads(world: World, change: Callable[[bytes], bytes]) -> None:
    """Have the answers to ReadFile changed."""
    server = world.vehicle.server
    outgoing = server.outgoing

    def changed(now: float) -> list[tuple[Address, bytes]]:
        return [(to, change(w) if w[5] == Opcode.READ_FILE else w) for to, w in outgoing(now)]

    server.outgoing = changed  # type: ignore[method-assign]


def cut_short(wire: bytes) -> bytes:
    """Answer with at most 100 bytes."""
    return wire if wire[4] <= 100 else wire[:4] + bytes([100]) + wire[5:112] + bytes(139)


@pytest.mark.parametrize("profile", KEEPING)
async def test_a_server_that_sends_less_than_is_asked_for(profile: str, autojump: MockClock) -> None:
    both = Copying(profile)
    answer_reads(both.card.world, cut_short)
    async with mounted(both.card.world, both.card.folder) as (_, tree):
        writer = await both.change(tree, lambda: None)
        await writer.release()
        assert both.card.world.tree.data(both.card.path) == PART + OLD[len(PART) :]


@pytest.mark.parametrize("profile", KEEPING)
async def test_a_session_that_is_gone_before_the_look_is_opened_anew(
    profile: str, autojump: MockClock
) -> None:
    both = Copying(profile)
    path, refused = both.card.path, list[bytes]()

    def refuse(wire: bytes) -> bytes:
        session = connection.scheduler.session
        awaited = any(upload.finishing for upload in connection.scheduler.uploads)
        if refused or not awaited or session is None or session.path != path:
            return wire
        refused.append(wire)
        return wire[:3] + bytes([Opcode.NAK, 1]) + wire[5:12] + bytes([NakCode.INVALID_SESSION]) + bytes(238)

    answer_reads(both.card.world, refuse)
    mount = mounted(both.card.world, both.card.folder)
    async with mount as (connection, tree), trio.open_nursery() as nursery:
        nursery.start_soon(both.copy_for, tree, 60.0)
        writer = await tree.open(path, write=True)
        await writer.write(0, PART)
        await writer.release()
        nursery.cancel_scope.cancel()
        assert both.card.world.tree.data(path) == PART + OLD[len(PART) :]
    assert refused
