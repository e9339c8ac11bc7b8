"""Names that others changed since they were listed, and names that differ by case: nothing is lost."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import AlreadyExists, FtpNak, IsADirectory
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.fake_writer import write_file
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.worlds import GOOD_LINK, ROOTS, World

EVERY = sorted(PROFILES)
RENAMING = [name for name in EVERY if PROFILES[name].storage is not Storage.LITTLEFS]
TELLING_CASE = [name for name in EVERY if not PROFILES[name].case_fold]
NUTTX = {name for name in EVERY if PROFILES[name].storage is Storage.NUTTX_FAT}
LONG = 10.0
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)


class Scene:
    """A directory `d` with a file `a`."""

    def __init__(self, profile: str, settings: LinkSettings = GOOD_LINK) -> None:
        self.world = World(profile, settings)
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.a, self.b = self.root + b"/a", self.root + b"/b"
        self.world.tree.add(self.a, b"ours")

    @asynccontextmanager
    async def mounted(self, **options: float) -> AsyncIterator[Tree]:
        async with mounted(self.world, self.root, **options) as (_, tree):
            yield tree

    def names(self, path: bytes | None = None) -> list[bytes]:
        found = (entry.name for entry in self.world.tree.entries(path or self.root))
        return sorted(name for name in found if name not in (b".", b".."))


@pytest.mark.holds("rule 14.34")
@pytest.mark.parametrize("profile", RENAMING)
async def test_a_file_made_by_others_is_not_replaced_where_that_is_forbidden(
    profile: str, autojump: MockClock
) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        await trio.sleep(LONG)
        scene.world.tree.add(scene.b, b"THEIRS")
        with pytest.raises(AlreadyExists):
            await tree.rename(scene.a, scene.b, noreplace=True)
    assert (scene.world.tree.data(scene.a), scene.world.tree.data(scene.b)) == (b"ours", b"THEIRS")


@pytest.mark.holds("rule 14.34")
@pytest.mark.parametrize("profile", RENAMING)
@pytest.mark.parametrize("was_file", [False, True])
async def test_nothing_moves_into_what_became_a_directory(
    profile: str, was_file: bool, autojump: MockClock
) -> None:
    scene = Scene(profile)
    if was_file:
        scene.world.tree.add(scene.b, b"")
    async with scene.mounted() as tree:
        await trio.sleep(LONG)
        if was_file:
            scene.world.tree.remove(scene.b)
        scene.world.tree.add_directory(scene.b)
        with pytest.raises(IsADirectory):
            await tree.rename(scene.a, scene.b)
    assert (scene.names(), scene.names(scene.b)) == ([b"a", b"b"], [])


@pytest.mark.holds("rule 14.34")
@pytest.mark.parametrize("profile", EVERY)
@pytest.mark.parametrize("opened", [False, True])
async def test_what_became_a_directory_is_not_unlinked(
    profile: str, opened: bool, autojump: MockClock
) -> None:
    scene = Scene(profile)
    async with scene.mounted() as tree:
        file = await tree.open(scene.a) if opened else None
        await trio.sleep(LONG)
        scene.world.tree.remove(scene.a)
        scene.world.tree.add_directory(scene.a)
        with pytest.raises(IsADirectory):
            await tree.unlink(scene.a)
        if file is not None:
            file.close()
    assert scene.names() == [b"a"]


async def test_the_removal_of_many_files_lists_their_directory_seldom(autojump: MockClock) -> None:
    scene = Scene("px4", LinkSettings(rate=2000.0, delay=0.1))
    paths = [scene.root + b"/%03d" % number for number in range(100)]
    for path in paths:
        scene.world.tree.add(path, b"")
    faults = Faults(scene.world)
    async with scene.mounted() as tree:
        await trio.sleep(LONG)
        faults.requests.clear()
        began = trio.current_time()
        for path in paths:
            await tree.unlink(path)
        took = trio.current_time() - began
    removals = faults.requests.count(Opcode.REMOVE_FILE)
    assert removals == len(paths)
    sweeps = sum(faults.requests.count(opcode) for opcode in LISTS)
    assert sweeps <= 10 * (1 + took / 2)  # of up to ten requests each, one in two seconds


@pytest.mark.parametrize("profile", TELLING_CASE)
async def test_directories_that_differ_by_case_are_two_where_the_card_says_so(
    profile: str, autojump: MockClock
) -> None:
    """On NuttX those are whose names are long, as one is of small and capital letters."""
    scene = Scene(profile)
    scene.world.tree.add_directory(scene.root + b"/test")
    scene.world.tree.add_directory(scene.root + b"/more-of-it")
    async with scene.mounted() as tree:
        await tree.mkdir(scene.root + b"/Test")
        await write_file(tree, scene.root + b"/MORE-OF-IT", b"")
    assert scene.names() == [b"MORE-OF-IT", b"Test", b"a", b"more-of-it", b"test"]


@pytest.mark.parametrize("profile", sorted((set(EVERY) - set(TELLING_CASE)) | NUTTX))
async def test_they_are_one_elsewhere(profile: str, autojump: MockClock) -> None:
    scene = Scene(profile)
    scene.world.tree.add_directory(scene.root + b"/test")
    async with scene.mounted() as tree:
        if not profile.startswith("ardupilot"):  # where a directory looks like nothing; the rename is refused
            with pytest.raises((AlreadyExists, FtpNak)):
                await tree.create(scene.root + b"/TEST", exclusive=False)
        with pytest.raises((AlreadyExists, FtpNak)):
            await tree.create(scene.root + b"/A", exclusive=True)
        with pytest.raises((AlreadyExists, FtpNak)):
            await tree.mkdir(scene.root + b"/TEST")
        with pytest.raises((AlreadyExists, FtpNak)):
            await tree.rename(scene.a, scene.root + b"/TEST")
        with pytest.raises((AlreadyExists, FtpNak)):
            await tree.rename(scene.a, scene.root + b"/A")
    assert scene.names() == [b"a", b"test"]
