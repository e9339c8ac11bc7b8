"""A vehicle that is armed, or falls silent, while a file is replaced: its name never stays without a file."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.compose import subscribe
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.profiles import PROFILES
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World

OLD = random.Random(1).randbytes(3000)
NEW = random.Random(2).randbytes(4000)
RENAMING = [name for name in PROFILES if name != "littlefs"]
SILENCE = 40.0


class Scene:
    """A directory with two files on a simulated card."""

    def __init__(self, profile: str) -> None:
        self.world = World(profile)
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.file, self.other = self.root + b"/file", self.root + b"/other"
        self.world.tree.add(self.file, OLD)
        self.world.tree.add(self.other, NEW)

    @asynccontextmanager
    async def mounted(self) -> AsyncIterator[Tree]:
        """Give a tree that hears the news as a mount does."""
        async with mounted(self.world) as (connection, tree):
            subscribe(connection, tree)
            yield tree

    def before_rename(self, number: int, act: Callable[[], None]) -> None:
        """Have something happen as the server gets a rename."""
        server, left = self.world.vehicle.server, number
        handle = server.handle

        def watch(wire: bytes, source: Address, now: float) -> None:
            nonlocal left
            if wire[3] == Opcode.RENAME:
                left -= 1
                if left == 0:
                    act()
            handle(wire, source, now)

        server.handle = watch  # type: ignore[method-assign]

    def arm(self) -> None:
        """Be armed; the news travels with the next reply."""
        self.world.vehicle.arm()
        self.world.link.kick()

    def names(self) -> set[bytes]:
        """Return what the card has in the directory."""
        return {entry.name for entry in self.world.tree.entries(self.root)}

    def content(self) -> bytes:
        """Return what the card has under the name."""
        return self.world.tree.data(self.file)


async def replace(scene: Scene, tree: Tree) -> None:
    file = await tree.open(scene.file, write=True, truncate=True)
    try:
        await file.write(0, NEW)
        await file.release()
    finally:
        file.close()


async def move(scene: Scene, tree: Tree) -> None:
    await tree.rename(scene.other, scene.file)


JOBS = {"replace": replace, "move": move}


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("job", sorted(JOBS))
@pytest.mark.parametrize("profile", RENAMING)
async def test_armed_at_any_rename(profile: str, job: str, number: int, autojump: MockClock) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        await tree.list(scene.root)
        scene.before_rename(number, scene.arm)
        try:
            await JOBS[job](scene, tree)
            done = True
        except MavftpfsError:
            done = False
        await trio.sleep(5)
        assert scene.content() in (OLD, NEW), "there is a file all the flight long"
        assert not done or scene.content() == NEW
        scene.world.vehicle.disarm()
        scene.world.link.kick()
        await trio.sleep(30)
        tree.forget_caches()
        await tree.list(scene.root)
        assert scene.content() == (NEW if done or job == "replace" else OLD)
        assert not [name for name in scene.names() if is_reserved(name)]


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("job", sorted(JOBS))
@pytest.mark.parametrize("armed", [False, True])
async def test_a_link_lost_at_any_rename(job: str, number: int, armed: bool, autojump: MockClock) -> None:
    """On the card that refuses to rename over files."""
    scene = Scene("ardupilot5")
    async with scene.mounted() as tree:
        await tree.list(scene.root)
        scene.before_rename(number, scene.world.link.cut)
        try:
            await JOBS[job](scene, tree)
        except MavftpfsError:
            assert (await tree.stat(scene.file)).size in (len(OLD), len(NEW))
        await trio.sleep(SILENCE)
        if armed:
            scene.world.vehicle.arm()
        scene.world.link.restore()
        await trio.sleep(10)
        assert scene.content() in (OLD, NEW)
        assert armed or job == "move" or scene.content() == NEW
        assert scene.other.rpartition(b"/")[2] in scene.names() or scene.content() == NEW
