"""A file of which no listing told the time when it was opened: others replace it, and it is one version or an
error all the same. Virtual time.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged
from tests.sim.test_replaced import STEP
from tests.sim.test_replaced_between import IDLE, NEW, OLD, THEN, Card, read_on
from tests.support.mounting import mounted

MID = b"mid"
IN_PLACE = ["spec", "ardupilot5", "px4-2026"]
"""Vehicles that tell times, and where the rest of a file that is changed is not sent."""

OURS = OLD[:100] + MID + OLD[103:]
GROWN = NEW[:450_000]
OTHER = NEW[::-1]
CASES = {"changed here": OURS, "larger than listed": GROWN}


class Scene:
    """A file that is opened in one of the cases. then: what it holds; listings: how often one was begun."""

    def __init__(self, card: Card, case: str) -> None:
        self.card = card
        self.then = CASES[case]
        self._changes = case == "changed here"

    @property
    def listings(self) -> int:
        requests = self.card.world.vehicle.server.requests
        return requests[Opcode.LIST_DIRECTORY_WITH_TIME] + requests[Opcode.LIST_DIRECTORY]

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[tuple[Tree, OpenFile]]:
        async with mounted(self.card.world) as (_, tree):
            assert (await tree.stat(self.card.path)).mtime == THEN
            if self._changes:
                writer = await tree.open(self.card.path, write=True)
                await writer.write(100, MID)
                await writer.release()
            else:
                self.card.replace(GROWN)
            reader = await tree.open(self.card.path)
            yield tree, reader
            await reader.release()

    def replace(self) -> None:
        self.card.replace(OTHER[: len(self.then)], THEN + 200)


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("profile", IN_PLACE)
async def test_an_open_descriptor_gets_no_bytes_of_a_successor(
    profile: str, case: str, autojump: MockClock
) -> None:
    scene = Scene(Card(profile), case)
    async with scene.opened() as (_, reader):
        assert bytes(await reader.read(0, STEP)) == scene.then[:STEP]
        await trio.sleep(IDLE)
        scene.replace()
        with pytest.raises(FileChanged):
            await read_on(reader, STEP)


@pytest.mark.parametrize("profile", IN_PLACE)
async def test_it_is_read_on_and_listed_once_for_that(profile: str, case: str, autojump: MockClock) -> None:
    scene = Scene(Card(profile), case)
    async with scene.opened() as (tree, reader):
        assert bytes(await reader.read(0, STEP)) == scene.then[:STEP]
        before = scene.listings
        assert bytes(await reader.read(STEP, STEP)) == scene.then[STEP : 2 * STEP]
        other = await tree.open(scene.card.path)
        assert bytes(await other.read(0, STEP)) == scene.then[:STEP]
        assert scene.listings == before
        await other.release()
        await trio.sleep(IDLE)
        assert await read_on(reader, 2 * STEP) == scene.then[2 * STEP :]
