"""A file that is emptied while what it held is on its way: at any moment of it, and on every server.

A local disk empties at once, whatever the size of the file. Here opening with O_TRUNC costs no more than what
cannot be called off, the old file stays until there is another one, and whoever waits for the card hears 0
when that has what the file is by then.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import product

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.deliveries import (
    BAD,
    GOOD,
    LONG,
    MOMENTS,
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

NEXT, LONGER = content("next", 700), content("longer", 5000)


async def cut(tree: Tree, path: bytes) -> OpenFile:
    file = await tree.open(path, write=True)
    await file.truncate(1000)
    return file


WRITES: dict[str, Write] = {"create": create, "replace": replace, "change": change, "cut": cut}
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
        file = await WRITES[write](tree, path)
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


SHORT = {
    ("px4", "change", "longer"),
    ("px4-nuttx", "replace", "shorter"),
    ("ardupilot", "cut", "shorter"),
    ("littlefs", "replace", "nothing"),
    ("mavsdk", "create", "longer"),
}
CASES = [
    pytest.param(*case, marks=() if case in SHORT else pytest.mark.soak)
    for case in product(PROFILES, WRITES, NEXTS)
]


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize(("profile", "write", "then"), CASES)
async def test_emptied_at_any_request_of_its_delivery(
    profile: str, write: str, then: str, autojump: MockClock
) -> None:
    await at_each_request(lambda count: empty_after(count, profile, write, then, GOOD), step=2, most=PROMPT)


@pytest.mark.parametrize(("profile", "write", "then"), CASES)
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
