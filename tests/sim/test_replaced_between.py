"""A file that others replace by one of the same size while nothing is open there: one version or an error.

The server's session is closed when nobody wanted bytes for a while. Virtual time.
"""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.shared.errors import FileChanged
from mavftpfs.sim.linkmodel import LinkSettings
from tests.sim.test_replaced import STEP, copy, mounted
from tests.support.worlds import ROOTS, World

OLD = random.Random(1).randbytes(400_000)
NEW = random.Random(2).randbytes(500_000)
THEN = 1_700_000_000
LINK = LinkSettings(rate=200_000.0, delay=0.01)
IDLE = 4.0
"""Seconds after which the session is closed."""

TIMED = ["mavsdk", "spec", "ardupilot5", "px4-2026"]
UNTIMED = ["px4", "mavsdk-old"]


class Card:
    """One vehicle with one file, and with `others` beside it, so that a listing takes several requests."""

    def __init__(self, profile: str, *, others: bool = False, link: LinkSettings = LINK) -> None:
        self.world = World(profile, link)
        self.folder = ROOTS.get(profile, b"") or b"/"
        self.path = ROOTS.get(profile, b"") + b"/big"
        self.world.tree.add(self.path, OLD, THEN)
        for number in range(30 * others):
            self.world.tree.add(b"%s-%d" % (self.path, number), b"", THEN)

    def replace(self, data: bytes = NEW[: len(OLD)], mtime: int = THEN + 100) -> None:
        """Move another file over it, as others would."""
        folder = self.path[: self.path.rindex(b"/") + 1]
        self.world.tree.add(folder + b"other", data, mtime)
        self.world.tree.rename(folder + b"other", self.path)

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[tuple[Tree, OpenFile]]:
        """Mount it and open the file."""
        async with self.world.connection() as connection:
            tree = mounted(connection)
            handle = await tree.open(self.path)
            yield tree, handle
            handle.close()

    @asynccontextmanager
    async def opened_late(self) -> AsyncIterator[tuple[Tree, OpenFile]]:
        """Mount it and list the file; open it, and read its head, right after it was replaced."""
        async with self.world.connection() as connection:
            tree = mounted(connection)
            assert (await tree.stat(self.path)).mtime == THEN
            self.replace()
            handle = await tree.open(self.path)
            assert await handle.read(0, STEP) == NEW[:STEP]
            yield tree, handle
            handle.close()


async def read_head(handle: OpenFile) -> None:
    """Read the first bytes, and wait until the session is closed."""
    assert await handle.read(0, STEP) == OLD[:STEP]
    await trio.sleep(IDLE)


async def read_on(handle: OpenFile, start: int) -> bytes:
    """Read from there to the end."""
    return b"".join([bytes(await handle.read(at, STEP)) for at in range(start, handle.size, STEP)])


@pytest.mark.parametrize("profile", TIMED)
async def test_an_open_descriptor_gets_no_bytes_of_a_successor(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (tree, handle):
        await read_head(handle)
        card.replace()
        with pytest.raises(FileChanged):
            await read_on(handle, STEP)
        handle.close()
        assert await copy(tree, card.path) == NEW[: len(OLD)]


@pytest.mark.parametrize("profile", TIMED)
async def test_a_copy_is_not_of_a_cached_head_and_another_file(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (tree, handle):
        assert await handle.read(0, STEP) == OLD[:STEP]
        handle.close()
        await trio.sleep(IDLE)
        card.replace()
        with pytest.raises(FileChanged):
            await copy(tree, card.path)
        assert await copy(tree, card.path) == NEW[: len(OLD)]


@pytest.mark.parametrize("profile", TIMED)
async def test_what_nobody_got_yet_is_read_anew(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (_, handle):
        blocks = handle._version.blocks  # type: ignore[attr-defined]
        with trio.move_on_after(0.01):  # a read that is given up
            await handle.read(0, STEP)
        await trio.sleep(IDLE)
        assert not blocks.empty
        assert not blocks.given
        assert blocks.missing(0, len(OLD))
        card.replace()
        assert await handle.read(0, len(OLD)) == NEW[: len(OLD)]
        await trio.sleep(IDLE)
        assert await read_on(handle, 0) == NEW[: len(OLD)]


@pytest.mark.parametrize("profile", [*TIMED, *UNTIMED])
async def test_the_same_file_is_read_on(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (_, handle):
        parts = []
        for start in range(0, len(OLD), 100_000):
            await trio.sleep(IDLE)
            parts.append(bytes(await handle.read(start, 100_000)))
        handle.close()
        assert b"".join(parts) == OLD


@pytest.mark.parametrize("profile", TIMED)
async def test_a_file_that_grew_is_read_to_its_opened_size(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (_, handle):
        await read_head(handle)
        card.replace(OLD + b"more")
        assert await read_on(handle, STEP) == OLD[STEP:]


@pytest.mark.parametrize("profile", TIMED)
async def test_a_newer_listing_ends_what_it_contradicts(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (tree, handle):
        assert await read_on(handle, 0) == OLD
        card.replace()
        await trio.sleep(30.0)
        assert (await tree.stat(card.path)).mtime == THEN + 100
        with pytest.raises(FileChanged):
            await handle.read(0, STEP)


@pytest.mark.parametrize("profile", UNTIMED)
async def test_without_times_nothing_more_is_asked(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    async with card.opened() as (tree, handle):
        sweeps = tree.status()["listings_asked"]
        await read_head(handle)
        assert await read_on(handle, STEP) == OLD[STEP:]
        handle.close()
        assert tree.status()["listings_asked"] == sweeps


@pytest.mark.parametrize("profile", TIMED)
async def test_turns_of_two_readers_cost_few_listings(profile: str, autojump: MockClock) -> None:
    card = Card(profile)
    second = card.path + b"2"
    card.world.tree.add(second, OLD, THEN)
    got: list[bytes] = []
    async with card.world.connection() as connection:
        tree = mounted(connection)
        await tree.stat(card.path)
        sweeps = tree.status()["listings_asked"]
        began = trio.current_time()

        async def one(path: bytes) -> None:
            got.append(await copy(tree, path))

        async with trio.open_nursery() as nursery:
            nursery.start_soon(one, card.path)
            nursery.start_soon(one, second)
        assert got == [OLD, OLD]
        asked = tree.status()["listings_asked"]
        assert isinstance(asked, int)
        assert isinstance(sweeps, int)
        assert asked - sweeps <= 2 * ((trio.current_time() - began) / 2.0 + 2)


@pytest.mark.parametrize("profile", TIMED)
async def test_the_end_of_a_copy_by_turns_is_compared(profile: str, autojump: MockClock) -> None:
    """Between two comparisons bytes go out unproven, but for the last."""
    card = Card(profile)
    async with card.opened() as (_, handle):
        await read_head(handle)
        assert await handle.read(200_000, STEP) == OLD[200_000 : 200_000 + STEP]
        handle._version.compare_after = float("inf")  # type: ignore[attr-defined]
        await trio.sleep(IDLE)
        card.replace()
        with pytest.raises(FileChanged):
            await read_on(handle, 200_000)


@pytest.mark.parametrize("profile", TIMED)
async def test_one_that_was_replaced_again_after_it_was_opened_is_not(
    profile: str, autojump: MockClock
) -> None:
    card = Card(profile)
    async with card.opened_late() as (tree, handle):
        await trio.sleep(IDLE)
        card.replace(NEW[-len(OLD) :], THEN + 200)
        with pytest.raises(FileChanged):
            await read_on(handle, STEP)
        handle.close()
        assert await copy(tree, card.path) == NEW[-len(OLD) :]
