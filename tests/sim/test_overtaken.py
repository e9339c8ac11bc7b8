"""A file that is removed, renamed over or emptied while it is on its way: what sends it is called off.

A local disk does that at once, whatever the size, and fsync and close of what lost its name succeed.
Here it costs a few round trips, at any moment of a delivery, and nothing of what is gone comes back or stays.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import product

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import CrossDevice, MavftpfsError
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.deliveries import (
    BAD,
    GOOD,
    LONG,
    MOMENTS,
    NEW,
    NO_RENAME,
    OLD,
    PROFILES,
    PROMPT,
    SLOW,
    Write,
    at_each_request,
    change,
    create,
    in_the_middle,
    long_file,
    names_on_card,
    names_shown,
    replace,
)
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.trees import content
from tests.support.worlds import ROOTS, World

OTHER = content("other", 500)

Take = Callable[[Tree, bytes], Awaitable[None]]


async def empty(tree: Tree, path: bytes) -> OpenFile:
    await tree.unlink(path)
    return await tree.create(path, exclusive=True)


WRITES: dict[str, tuple[Write, bytes]] = {
    "create": (create, NEW),
    "replace": (replace, NEW),
    "change": (change, OLD[:100] + NEW[100:]),
    "empty": (empty, b""),
}


async def unlink(tree: Tree, path: bytes) -> None:
    await tree.unlink(path)


async def rename_over(tree: Tree, path: bytes) -> None:
    await tree.rename(path + b".other", path)


TAKES: dict[str, tuple[Take, bytes | None]] = {"unlink": (unlink, None), "rename": (rename_over, OTHER)}


async def take_after(count: int, profile: str, write: str, take: str, settings: LinkSettings) -> float | None:
    """Take the name away when `count` requests of its delivery came; return how long that took, or None if
    the delivery needed fewer."""
    world = World(profile, settings, seed=count + 1)
    folder = ROOTS.get(profile, b"") + b"/d"
    path = folder + b"/file"
    world.tree.add(path, OLD)
    world.tree.add(path + b".other", OTHER)
    faults = Faults(world)
    taken: float | None = None
    async with mounted(world, inplace=profile == NO_RENAME) as (_, tree), trio.open_nursery() as nursery:
        await tree.list(folder)
        file = await WRITES[write][0](tree, path)
        now = trio.Event()
        faults.after(count, now.set)
        delivered = trio.Event()

        async def flush() -> None:
            await file.fsync()
            delivered.set()

        nursery.start_soon(flush)
        with trio.move_on_after(60):
            await now.wait()
            if not delivered.is_set():
                began = trio.current_time()
                await TAKES[take][0](tree, path)
                taken = trio.current_time() - began
        await delivered.wait()
        if taken is not None:
            await look(tree, file, path, write, take)
        nursery.cancel_scope.cancel()
    if taken is not None:
        expected = {b"file.other"} if TAKES[take][1] is None else {b"file"}
        assert names_on_card(world, folder) == expected, f"after request {count}"
    return taken


async def look(tree: Tree, file: OpenFile, path: bytes, write: str, take: str) -> None:
    """What the program, others and the card have of it."""
    expected = WRITES[write][1]
    assert bytes(await file.read(0, len(expected) + 1)) == expected
    await file.write(len(expected), b"more")
    assert bytes(await file.read(len(expected), 5)) == b"more"
    await file.flush()
    await file.fsync()
    await file.release()
    assert tree.undelivered() == []
    names = await names_shown(tree, path.rpartition(b"/")[0])
    assert (b"file" in names) == (TAKES[take][1] is not None)
    if TAKES[take][1] is not None:
        other = await tree.open(path, write=False)
        assert bytes(await other.read(0, 10_000)) == TAKES[take][1]
        await other.release()


SHORT = {
    ("px4", "change", "rename"),
    ("px4-nuttx", "replace", "unlink"),
    ("ardupilot", "empty", "rename"),
    ("littlefs", "change", "unlink"),
    ("mavsdk", "replace", "unlink"),
}

CASES = [
    pytest.param(*case, marks=() if case in SHORT else pytest.mark.soak)
    for case in product(PROFILES, WRITES, TAKES)
    if case[0] != NO_RENAME  # what is open and not all known here keeps its name there
]


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(("profile", "write", "take"), CASES)
async def test_a_name_goes_at_any_request_of_its_delivery(
    profile: str, write: str, take: str, autojump: MockClock
) -> None:
    await at_each_request(lambda count: take_after(count, profile, write, take, GOOD), most=PROMPT)


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(("profile", "write", "take"), CASES)
async def test_a_name_goes_on_a_bad_link(profile: str, write: str, take: str, autojump: MockClock) -> None:
    await at_each_request(lambda count: take_after(count, profile, write, take, BAD), step=3)


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("take", TAKES)
@pytest.mark.parametrize("profile", PROFILES)
async def test_a_name_goes_in_a_few_round_trips_whatever_the_size(
    profile: str, take: str, autojump: MockClock
) -> None:
    if (profile, take) == (NO_RENAME, "rename"):
        return
    for moment in MOMENTS:
        async with long_file(profile, other=OTHER) as (_, tree, path, file):
            async with in_the_middle(file, waiting=3, after=moment):
                began = trio.current_time()
                await TAKES[take][0](tree, path)
                assert trio.current_time() - began < PROMPT
            assert trio.current_time() - began < PROMPT
            assert bytes(await file.read(0, len(LONG) + 1)) == LONG


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(
    "profile",
    [
        pytest.param(name, marks=() if name in {"px4-nuttx", "mavsdk"} else pytest.mark.soak)
        for name in PROFILES
    ],
)
async def test_a_file_gets_another_name_while_it_is_written(profile: str, autojump: MockClock) -> None:
    """What was accepted is on the card then, and the program goes on; on some servers that means all anew."""
    world = World(profile, SLOW)
    folder = ROOTS.get(profile, b"") + b"/d"
    path, other = folder + b"/file", folder + b"/other"
    world.tree.add(folder + b"/z", b"")
    piece = content("piece", 32768)
    async with mounted(world, dirty_max=65536) as (_, tree), trio.open_nursery() as nursery:
        file = await tree.create(path, exclusive=True)

        async def write() -> None:
            for number in range(8):
                await file.write(number * len(piece), piece)
            await file.flush()
            await file.release()

        nursery.start_soon(write)
        await trio.sleep(10)
        if profile == NO_RENAME:
            with pytest.raises(CrossDevice):  # mv copies then
                await tree.rename(path, other)
            other = path
        else:
            await tree.rename(path, other)
            assert len(world.tree.data(other)) >= 2 * len(piece)
    assert world.tree.data(other) == 8 * piece


# --- emptied

NEXT, LONGER = content("next", 700), content("longer", 5000)


async def cut(tree: Tree, path: bytes) -> OpenFile:
    file = await tree.open(path, write=True)
    await file.truncate(1000)
    return file


EMPTIED_WRITES: dict[str, Write] = {"create": create, "replace": replace, "change": change, "cut": cut}

NEXTS = {"nothing": b"", "shorter": NEXT, "longer": LONGER}


def card_has(world: World, path: bytes) -> bytes | None:
    """Return what the card has under the name, None if it has none."""
    folder, _, name = path.rpartition(b"/")
    return world.tree.data(path) if name in names_on_card(world, folder) else None


async def empty_after(
    count: int, profile: str, write: str, then: str, settings: LinkSettings
) -> float | None:
    """Open the file with O_TRUNC when `count` requests of its delivery came; return how long that took, or
    None if the delivery needed fewer."""
    world = World(profile, settings, seed=count + 1)
    folder = ROOTS.get(profile, b"") + b"/d"
    path = folder + b"/file"
    world.tree.add(path, OLD)
    faults = Faults(world)
    taken: float | None = None
    async with mounted(world, inplace=profile == NO_RENAME) as (_, tree), trio.open_nursery() as nursery:
        await tree.list(folder)
        file = await EMPTIED_WRITES[write](tree, path)
        now, delivered = trio.Event(), trio.Event()
        faults.after(count, now.set)

        async def flush() -> None:
            await file.fsync()
            if not delivered.is_set() and other is not None:
                assert card_has(world, path) in (b"", NEXTS[then])  # what the file was by then
            delivered.set()

        other: OpenFile | None = None
        nursery.start_soon(flush)
        with trio.move_on_after(60):
            await now.wait()
            if not delivered.is_set():
                began = trio.current_time()
                opened = await tree.open(path, write=True, truncate=True)
                taken = trio.current_time() - began
                other = None if delivered.is_set() else opened
                await opened.write(0, NEXTS[then])
                await delivered.wait()
                await opened.release()
        await delivered.wait()
        await file.release()
        if taken is not None:
            assert tree.undelivered() == []
            await names_shown(tree, folder)
            assert (await tree.stat(path)).size == len(NEXTS[then])
        nursery.cancel_scope.cancel()
    if taken is not None:
        assert names_on_card(world, folder) == {b"file"}, f"after request {count}"
        assert world.tree.data(path) == NEXTS[then], f"after request {count}"
    return taken


EMPTIED_SHORT = {
    ("px4", "change", "longer"),
    ("px4-nuttx", "replace", "shorter"),
    ("ardupilot", "cut", "shorter"),
    ("littlefs", "replace", "nothing"),
    ("mavsdk", "create", "longer"),
}

EMPTIED_CASES = [
    pytest.param(*case, marks=() if case in EMPTIED_SHORT else pytest.mark.soak)
    for case in product(PROFILES, EMPTIED_WRITES, NEXTS)
]


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(("profile", "write", "then"), EMPTIED_CASES)
async def test_emptied_at_any_request_of_its_delivery(
    profile: str, write: str, then: str, autojump: MockClock
) -> None:
    await at_each_request(lambda count: empty_after(count, profile, write, then, GOOD), step=2, most=PROMPT)


@pytest.mark.parametrize(("profile", "write", "then"), EMPTIED_CASES)
async def test_emptied_on_a_bad_link(profile: str, write: str, then: str, autojump: MockClock) -> None:
    await at_each_request(lambda count: empty_after(count, profile, write, then, BAD), step=3)


async def by_opening(tree: Tree, path: bytes) -> None:
    file = await tree.open(path, write=True, truncate=True)
    file.close()


async def by_name(tree: Tree, path: bytes) -> None:
    await tree.truncate(path, 0)


@pytest.mark.parametrize("empty", [by_opening, by_name])
@pytest.mark.parametrize("profile", PROFILES)
async def test_emptying_costs_no_more_whatever_the_size(
    profile: str, empty: Callable[[Tree, bytes], Awaitable[None]], autojump: MockClock
) -> None:
    for moment in MOMENTS:
        async with long_file(profile) as (world, tree, path, file):
            async with in_the_middle(file, waiting=3, after=moment):
                began = trio.current_time()
                await empty(tree, path)
                assert trio.current_time() - began < PROMPT
            assert trio.current_time() - began < 3 * PROMPT
            assert world.tree.data(path) == b""


@pytest.mark.parametrize("profile", [name for name in PROFILES if name != NO_RENAME])
async def test_the_old_file_stays_while_nobody_waits(profile: str, autojump: MockClock) -> None:
    """A delivery that is tried again by itself, over a link that was cut, is called off for good."""
    world = World(profile, SLOW)
    path = ROOTS.get(profile, b"") + b"/d/file"
    world.tree.add(path, OLD)
    faults = Faults(world)
    async with mounted(world) as (_, tree):
        await tree.list(path.rpartition(b"/")[0])
        file = await tree.open(path, write=True, truncate=True)
        await file.write(0, LONG)
        faults.cut_after(60)
        with pytest.raises(MavftpfsError):
            await file.release()
        faults.cut_after(None)
        await trio.sleep(5)
        began = trio.current_time()
        file = await tree.open(path, write=True, truncate=True)
        assert trio.current_time() - began < PROMPT
        await trio.sleep(100)
        assert world.tree.data(path) == OLD
        await file.write(0, NEXT)
        await file.release()
        assert world.tree.data(path) == NEXT
