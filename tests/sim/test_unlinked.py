"""rm of an open file where nothing can be renamed: what is not known of it is fetched before it goes.

A local disk goes on giving the bytes to who has the file open. If they cannot be fetched the file stays.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileBusy, LinkError, RequestTimeout
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.trees import content
from tests.support.worlds import World

PROFILE = "littlefs"
FOLDER, FILE = b"/d", b"/d/file"
OLD, NEW = content("old", 6000), content("new", 1500)
AT = 2500
GOOD = LinkSettings(rate=50_000.0, delay=0.02)
BAD = LinkSettings(rate=50_000.0, delay=0.02, loss=0.1, duplicate=0.05, reorder=0.05)
RADIO = LinkSettings(rate=5760.0, delay=0.05, duplex=Duplex.HALF)
LONG = content("long", 400_000)
"""More than a radio brings within op_deadline."""

DEADLINE = 30.0
CHANGE_ENDS = DEADLINE + 4.0
"""Seconds after which a change of names that nobody answers is given up."""

Open = Callable[[Tree], Awaitable[tuple[OpenFile, bytes]]]


async def read(tree: Tree) -> tuple[OpenFile, bytes]:
    file = await tree.open(FILE)
    assert bytes(await file.read(300, 10)) == OLD[300:310]
    return file, OLD


async def change(tree: Tree) -> tuple[OpenFile, bytes]:
    file = await tree.open(FILE, write=True)
    await file.write(AT, NEW)
    return file, OLD[:AT] + NEW + OLD[AT + len(NEW) :]


async def change_on_its_way(tree: Tree) -> tuple[OpenFile, bytes]:
    file, expected = await change(tree)
    await trio.sleep(0.4)
    return file, expected


async def shrink_and_extend(tree: Tree) -> tuple[OpenFile, bytes]:
    file, expected = await change(tree)
    await file.truncate(AT + 100)
    await file.truncate(AT + 2000)
    return file, expected[: AT + 100] + bytes(1900)


OPENS: list[Open] = [read, change, change_on_its_way, shrink_and_extend]
opens = pytest.mark.parametrize("opened", OPENS)
most_opens = pytest.mark.parametrize(
    "opened", [pytest.param(each, marks=() if each is change else pytest.mark.soak) for each in OPENS]
)


async def whole(file: OpenFile) -> bytes:
    return bytes(await file.read(0, 1_000_000))


async def left(tree: Tree) -> set[bytes]:
    tree.forget_caches()
    return {name for name, _ in await tree.list(FOLDER)}


def card(settings: LinkSettings, seed: int = 1) -> World:
    world = World(PROFILE, settings, seed=seed)
    world.tree.add(FILE, OLD)
    world.tree.add(FILE + b".other", b"it")
    return world


def names(world: World) -> set[bytes]:
    return {entry.name for entry in world.tree.entries(FOLDER)} - {b".", b".."}


@opens
@pytest.mark.parametrize("settings", [GOOD, BAD])
async def test_who_has_it_open_goes_on(opened: Open, settings: LinkSettings, autojump: MockClock) -> None:
    for seed in range(1, 6):
        world = card(settings, seed)
        async with mounted(world) as (_, tree):
            file, expected = await opened(tree)
            await tree.unlink(FILE)
            assert names(world) == {b"file.other"}
            assert await whole(file) == expected
            if file.writable:
                await file.write(0, b"more")
                assert await whole(file) == b"more" + expected[4:]
                await file.fsync()
            await file.release()
            assert await left(tree) == {b"file.other"}
            assert tree.undelivered() == []


@most_opens
async def test_the_link_is_cut_at_any_request(opened: Open, autojump: MockClock) -> None:
    """rm ends in time, and the bytes are there whether the file went or stayed."""
    ends = set()
    for count in range(1, 200):
        world = card(GOOD)
        faults = Faults(world)
        async with mounted(world) as (_, tree):
            file, expected = await opened(tree)
            faults.cut_after(count)
            began, error = trio.current_time(), None
            try:
                await tree.unlink(FILE)
            except (RequestTimeout, LinkError, FileBusy) as caught:
                error = caught
            assert trio.current_time() - began < 2 * CHANGE_ENDS
            ends.add(type(error))
            removed = FILE.rpartition(b"/")[2] not in names(world)
            faults.cut_after(None)
            await trio.sleep(5)
            assert await whole(file) == expected, f"after request {count}"
            if error is not None and not removed:
                again = await tree.open(FILE)
                assert await whole(again) == expected
                await again.release()
                if len(expected) == len(OLD):  # it cannot be cut there
                    await file.fsync()
                    assert world.tree.data(FILE) == expected
            file.close()
        if error is None:
            break
    else:
        raise AssertionError("it was never removed")
    assert len(ends) > 1


@pytest.mark.parametrize("write", [False, True])
async def test_what_a_radio_does_not_bring_in_time_stays(write: bool, autojump: MockClock) -> None:
    world = card(RADIO)
    world.tree.add(FILE, OLD + LONG)
    async with mounted(world) as (_, tree):
        file = await tree.open(FILE, write=write)
        expected = OLD + LONG
        if write:
            await file.write(AT, NEW)
            expected = expected[:AT] + NEW + expected[AT + len(NEW) :]
        began = trio.current_time()
        with pytest.raises(FileBusy):
            await tree.unlink(FILE)
        assert trio.current_time() - began < DEADLINE + 5
        assert FILE.rpartition(b"/")[2] in names(world)
        assert await whole(file) == expected
        await tree.unlink(FILE)  # it is known now
        assert names(world) == {b"file.other"}
        assert await whole(file) == expected
        await file.release()
