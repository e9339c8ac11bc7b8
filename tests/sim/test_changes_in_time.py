"""A change of names ends in time, whatever does not answer, and waits for nobody whom it does not concern."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.pathlocks import SLACK
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileBusy, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.worlds import World

LIMIT = CacheOptions().op_deadline + SLACK
PROFILES = ("px4", "ardupilot5", "mavsdk")
RADIO = LinkSettings(rate=5760.0, delay=0.05)
D = b"/d"

CHANGES: dict[str, Callable[[Tree], Awaitable[None]]] = {
    "mkdir": lambda tree: tree.mkdir(D + b"/new"),
    "unlink": lambda tree: tree.unlink(D + b"/a"),
    "rename": lambda tree: tree.rename(D + b"/a", D + b"/z"),
    "rename over": lambda tree: tree.rename(D + b"/a", D + b"/b"),
    "rmdir": lambda tree: tree.rmdir(D + b"/empty"),
}


def made(profile: str, settings: LinkSettings | None = None) -> World:
    world = World(profile, settings or LinkSettings())
    for name in (b"/a", b"/b"):
        world.tree.add(D + name, b"x" * 30)
    world.tree.add_directory(D + b"/empty")
    return world


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
async def test_silence_ends_a_change_in_time(
    profile: str, change: Callable[[Tree], Awaitable[None]], autojump: MockClock
) -> None:
    world = made(profile)
    faults = Faults(world)
    async with mounted(world, D) as (_, tree):
        faults.cut_after(0)  # heartbeats go on
        began = trio.current_time()
        with pytest.raises(RequestTimeout):
            await change(tree)
        assert trio.current_time() - began <= LIMIT


@pytest.mark.parametrize("same", [False, True])
async def test_six_changes_are_not_answered_in_the_time_of_one(same: bool, autojump: MockClock) -> None:
    world = made("px4")
    faults = Faults(world)
    async with mounted(world, D) as (_, tree):
        faults.cut_after(0)

        async def one(number: int) -> None:
            await trio.sleep(3 * number)
            began = trio.current_time()
            with pytest.raises(RequestTimeout):
                await tree.mkdir(D + b"/new%d" % (0 if same else number))
            assert trio.current_time() - began <= LIMIT

        async with trio.open_nursery() as nursery:
            for number in range(6):
                nursery.start_soon(one, number)


@pytest.mark.holds("promise 4")
async def test_nobody_else_waits_for_a_long_delivery(autojump: MockClock) -> None:
    world = made("mavsdk", RADIO)
    world.tree.add(D + b"/long", bytes(1_500_000))
    async with mounted(world, D) as (_, tree):
        file = await tree.open(D + b"/long", write=True)
        await file.write(100, b"s" * 1000)

        async def deliver() -> None:
            await file.flush()

        async def timed(change: Awaitable[None], limit: float) -> None:
            began = trio.current_time()
            await change
            assert trio.current_time() - began <= limit

        async def busy(change: Awaitable[None]) -> None:
            with pytest.raises(FileBusy):
                await change

        async with trio.open_nursery() as outer:
            outer.start_soon(deliver)
            await trio.sleep(20)
            async with trio.open_nursery() as nursery:
                nursery.start_soon(timed, busy(tree.rename(D + b"/long", D + b"/other")), LIMIT)
                await trio.sleep(1)
                nursery.start_soon(timed, tree.mkdir(D + b"/new"), 5.0)
                nursery.start_soon(timed, tree.unlink(D + b"/a"), 5.0)
            await timed(tree.unlink(D + b"/long"), 5.0)  # for it the delivery is called off
        await file.release()


async def test_changes_that_concern_one_another_take_turns(autojump: MockClock) -> None:
    world = made("px4", LinkSettings(delay=0.5))
    async with mounted(world, D) as (_, tree):
        async with trio.open_nursery() as nursery:
            nursery.start_soon(tree.rename, D, b"/e")
            await trio.sleep(0.1)
            with pytest.raises(Exception, match="does not exist"):
                await tree.mkdir(D + b"/new")
        await tree.mkdir(b"/e/new")
        assert b"new" in {entry.name for entry in world.tree.entries(b"/e")}
