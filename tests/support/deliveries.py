"""Files on their way to each server, for the tests of what happens to them in mid-delivery."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from math import inf

import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.mounting import mounted
from tests.support.trees import content
from tests.support.worlds import ROOTS, World

OLD, NEW = content("old", 3000), content("new", 3500)
GOOD = LinkSettings(rate=50_000.0, delay=0.02)
SLOW = LinkSettings(rate=6000.0, delay=0.05)
LONG = content("long", 60_000)
MOMENTS = (0.1, 1.0, 5.0, 9.0)
"""Seconds since the delivery of that began; it takes 11 and more on the slow link."""

PROMPT = 2.0
"""Seconds for a few round trips on that link, with what is in its queue at the time."""

PROFILES = ("px4", "px4-nuttx", "ardupilot", "littlefs", "mavsdk")
NO_RENAME = "littlefs"
MOST_REQUESTS = 120

Write = Callable[[Tree, bytes], Awaitable[OpenFile]]
"""Makes a file, or changes the one that is there (OLD); nothing of that is delivered."""


async def create(tree: Tree, path: bytes) -> OpenFile:
    await tree.unlink(path)
    file = await tree.create(path, exclusive=True)
    await file.write(0, NEW)
    return file


async def replace(tree: Tree, path: bytes) -> OpenFile:
    file = await tree.open(path, write=True, truncate=True)
    await file.write(0, NEW)
    return file


async def change(tree: Tree, path: bytes) -> OpenFile:
    file = await tree.open(path, write=True)
    await file.write(100, NEW[100:])
    return file


async def names_shown(tree: Tree, folder: bytes) -> set[bytes]:
    """Return the names that a program sees once all that follows by itself did; none of them is ours."""
    for _ in range(2):
        names = {name for name, _ in await tree.list(folder)}
        await trio.sleep(5)
        tree.forget_caches()
    assert not any(is_reserved(name) for name in names)
    return names


async def at_each_request(
    attempt: Callable[[int], Awaitable[float | None]], *, step: int = 1, most: float = inf
) -> None:
    """Try something when so many requests of a delivery came, until it needs fewer (None). attempt: returns
    how long that took, at most `most` seconds."""
    for count in range(1, MOST_REQUESTS, step):
        taken = await attempt(count)
        if taken is None:
            assert count > 2
            return
        assert taken < most, f"after request {count}"
    raise AssertionError("it was never delivered")


@asynccontextmanager
async def in_the_middle(file: OpenFile, waiting: int = 1, *, after: float = 1.05) -> AsyncIterator[None]:
    """Enter when so many waited for the delivery for so many seconds; leaving waits for its end."""
    async with trio.open_nursery() as nursery:
        for _ in range(waiting):  # one delivers, the others wait for their turn
            nursery.start_soon(file.fsync)
        await trio.sleep(after)
        yield


@asynccontextmanager
async def long_file(
    profile: str, *, other: bytes = b""
) -> AsyncIterator[tuple[World, Tree, bytes, OpenFile]]:
    """Mount a vehicle over the slow link, and write a new file there (LONG); nothing of it is delivered.

    other: what another file holds, whose path is the same and `.other`.
    """
    world = World(profile, SLOW)
    path = ROOTS.get(profile, b"") + b"/d/file"
    world.tree.add(path + b".other", other)
    async with mounted(world) as (_, tree):
        file = await tree.create(path, exclusive=True)
        await file.write(0, LONG)
        yield world, tree, path, file
        await file.release()


def names_on_card(world: World, folder: bytes) -> set[bytes]:
    return {entry.name for entry in world.tree.entries(folder)} - {b".", b".."}
