"""A file that is removed, renamed over or emptied while it is on its way: what sends it is called off.

A local disk does that at once, whatever the size, and fsync and close of what lost its name succeed. Here it
costs a few round trips, at any moment of a delivery; the old file stays until there is another one, and
nothing of what is gone comes back or stays on the card.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import MavftpfsError
from tests.support.deliveries import (
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
RENAMING = [name for name in PROFILES if name != NO_RENAME]


async def empty(tree: Tree, path: bytes) -> OpenFile:
    await tree.unlink(path)
    return await tree.create(path, exclusive=True)


async def cut(tree: Tree, path: bytes) -> OpenFile:
    file = await tree.open(path, write=True)
    await file.truncate(1000)
    return file


WRITES: dict[str, tuple[Write, bytes]] = {
    "create": (create, NEW),
    "replace": (replace, NEW),
    "change": (change, OLD[:100] + NEW[100:]),
    "empty": (empty, b""),
    "cut": (cut, OLD[:1000]),
}
"""How a file is written, and what it is then."""

Take = Callable[[Tree, bytes], Awaitable[None]]


async def unlink(tree: Tree, path: bytes) -> None:
    await tree.unlink(path)


async def rename_over(tree: Tree, path: bytes) -> None:
    await tree.rename(path + b".other", path)


TAKES: dict[str, tuple[Take, bytes | None]] = {"unlink": (unlink, None), "rename": (rename_over, OTHER)}
"""How it loses its name, and what has the name then."""

NEXTS = {"nothing": b"", "shorter": content("next", 700), "longer": content("longer", 5000)}
"""What is written after it was emptied."""


async def overtake(
    count: int, profile: str, write: str, act: Callable[[Tree, bytes, OpenFile, trio.Event], Awaitable[float]]
) -> tuple[World, float | None]:
    """Act when `count` requests of a delivery came; return how long that took, None if it needed fewer.

    act: is given the tree, the path, the file and what tells that it is delivered; returns how long it took.
    """
    world = World(profile, GOOD, seed=count + 1)
    path = ROOTS.get(profile, b"") + b"/d/file"
    world.tree.add(path, OLD)
    world.tree.add(path + b".other", OTHER)
    faults = Faults(world)
    taken: float | None = None
    async with mounted(world, inplace=profile == NO_RENAME) as (_, tree), trio.open_nursery() as nursery:
        await tree.list(path.rpartition(b"/")[0])
        file = await WRITES[write][0](tree, path)
        now, delivered = trio.Event(), trio.Event()
        faults.after(count, now.set)

        async def flush() -> None:
            await file.fsync()
            delivered.set()

        nursery.start_soon(flush)
        with trio.move_on_after(60):
            await now.wait()
            if not delivered.is_set():
                taken = await act(tree, path, file, delivered)
        await delivered.wait()
        await file.release()
        if taken is not None:
            assert tree.undelivered() == []
            await names_shown(tree, path.rpartition(b"/")[0])
        nursery.cancel_scope.cancel()
    return world, taken


async def take_after(count: int, profile: str, write: str, take: str) -> float | None:
    """Take the name away when `count` requests came."""

    async def act(tree: Tree, path: bytes, file: OpenFile, delivered: trio.Event) -> float:
        began = trio.current_time()
        await TAKES[take][0](tree, path)
        took = trio.current_time() - began
        await delivered.wait()
        expected = WRITES[write][1]
        assert bytes(await file.read(0, len(expected) + 1)) == expected
        await file.write(len(expected), b"more")
        assert bytes(await file.read(len(expected), 5)) == b"more"
        await file.flush()
        if TAKES[take][1] is not None:
            other = await tree.open(path, write=False)
            assert bytes(await other.read(0, 10_000)) == TAKES[take][1]
            await other.release()
        return took

    world, taken = await overtake(count, profile, write, act)
    if taken is not None:
        left = {b"file.other"} if TAKES[take][1] is None else {b"file"}
        assert names_on_card(world, ROOTS.get(profile, b"") + b"/d") == left, f"after request {count}"
    return taken


async def empty_after(count: int, profile: str, write: str, then: str) -> float | None:
    """Open the file with O_TRUNC when `count` requests came, and write something else."""

    async def act(tree: Tree, path: bytes, file: OpenFile, delivered: trio.Event) -> float:
        began = trio.current_time()
        opened = await tree.open(path, write=True, truncate=True)
        took = trio.current_time() - began
        await opened.write(0, NEXTS[then])
        await delivered.wait()
        await opened.release()
        assert (await tree.stat(path)).size == len(NEXTS[then])
        return took

    world, taken = await overtake(count, profile, write, act)
    if taken is not None:
        folder = ROOTS.get(profile, b"") + b"/d"
        assert names_on_card(world, folder) == {b"file", b"file.other"}, f"after request {count}"
        assert world.tree.data(folder + b"/file") == NEXTS[then], f"after request {count}"
    return taken


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(
    ("profile", "write", "take"),
    [
        ("px4", "change", "rename"),
        ("px4-nuttx", "replace", "unlink"),
        ("ardupilot", "empty", "rename"),
        ("mavsdk", "create", "unlink"),
    ],
)
async def test_a_name_goes_at_any_request_of_its_delivery(
    profile: str, write: str, take: str, autojump: MockClock
) -> None:
    await at_each_request(lambda count: take_after(count, profile, write, take), most=PROMPT)


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(
    ("profile", "write", "then"),
    [
        ("px4", "change", "longer"),
        ("px4-nuttx", "replace", "shorter"),
        ("ardupilot", "cut", "shorter"),
        ("littlefs", "replace", "nothing"),
        ("mavsdk", "create", "longer"),
    ],
)
async def test_emptied_at_any_request_of_its_delivery(
    profile: str, write: str, then: str, autojump: MockClock
) -> None:
    await at_each_request(lambda count: empty_after(count, profile, write, then), step=2, most=PROMPT)


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("take", TAKES)
@pytest.mark.parametrize("profile", RENAMING)
async def test_a_name_goes_in_a_few_round_trips_whatever_the_size(
    profile: str, take: str, autojump: MockClock
) -> None:
    for moment in MOMENTS:
        async with long_file(profile, other=OTHER) as (_, tree, path, file):
            async with in_the_middle(file, waiting=3, after=moment):
                began = trio.current_time()
                await TAKES[take][0](tree, path)
                assert trio.current_time() - began < PROMPT
            assert trio.current_time() - began < PROMPT
            assert bytes(await file.read(0, len(LONG) + 1)) == LONG


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", ["px4-nuttx", "mavsdk"])
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
        await tree.rename(path, other)
        assert len(world.tree.data(other)) >= 2 * len(piece)
    assert world.tree.data(other) == 8 * piece


@pytest.mark.parametrize("profile", RENAMING)
async def test_the_old_file_stays_while_nobody_waits(profile: str, autojump: MockClock) -> None:
    """A delivery that is tried again by itself, over a link that was cut, is called off for good."""
    world = World(profile, SLOW)
    path = ROOTS.get(profile, b"") + b"/d/file"
    world.tree.add(path, OLD)
    faults = Faults(world)
    async with mounted(world, path.rpartition(b"/")[0]) as (_, tree):
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
        await file.write(0, NEW)
        await file.release()
        assert world.tree.data(path) == NEW
