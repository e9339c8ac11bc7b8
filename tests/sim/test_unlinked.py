"""rm of an open file where nothing can be renamed: it goes on from what is known here, or stays: EBUSY."""

from __future__ import annotations

import pytest
from trio.testing import MockClock

from mavftpfs.shared.errors import FileBusy
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.mounting import mounted
from tests.support.trees import content
from tests.support.worlds import World

FOLDER, FILE = b"/d", b"/d/file"
OLD = content("old", 6000)
GOOD = LinkSettings(rate=50_000.0, delay=0.02)


def card() -> World:
    world = World("littlefs", GOOD)
    world.tree.add(FILE, OLD)
    world.tree.add(FILE + b".other", b"it")
    return world


def names(world: World) -> set[bytes]:
    return {entry.name for entry in world.tree.entries(FOLDER)} - {b".", b".."}


async def test_what_is_not_all_known_here_stays(autojump: MockClock) -> None:
    world = card()
    async with mounted(world) as (_, tree):
        file = await tree.open(FILE)
        with pytest.raises(FileBusy):
            await tree.unlink(FILE)
        assert bytes(await file.read(0, len(OLD))) == OLD
        await file.release()
        await tree.unlink(FILE)
        assert names(world) == {b"file.other"}


@pytest.mark.parametrize("write", [False, True])
async def test_what_is_all_known_here_goes_on_without_a_name(write: bool, autojump: MockClock) -> None:
    world = card()
    async with mounted(world) as (_, tree):
        file = await tree.open(FILE, write=write)
        assert bytes(await file.read(0, len(OLD))) == OLD
        if write:
            await file.write(0, OLD)
        await tree.unlink(FILE)
        assert names(world) == {b"file.other"}
        assert bytes(await file.read(0, len(OLD))) == OLD
        if write:
            await file.write(0, b"more")
            assert bytes(await file.read(0, len(OLD))) == b"more" + OLD[4:]
        await file.release()
        assert names(world) == {b"file.other"}
        assert tree.undelivered() == []
