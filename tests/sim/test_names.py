"""Names that others changed, that differ by case, that a card takes for another, that are long."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    FileBusy,
    FtpNak,
    IsADirectory,
    PathTooLong,
)
from mavftpfs.shared.model import RENAME_ROOM, join, split
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind
from tests.support.fake_store import read_file
from tests.support.fake_writer import write_file
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.takingturns import taking_turns
from tests.support.trees import content
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
    async def mounted(self, **options: Any) -> AsyncIterator[Tree]:
        async with mounted(self.world, **options) as (connection, tree):
            await connection.store.list_directory(self.root)  # it tries opcode 16 too
            await tree.list(self.root)
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


# --- beyond ASCII, on a card that takes their bytes for a code page

FATFS = [name for name, profile in PROFILES.items() if profile.storage is Storage.FATFS]

ONE, OTHER, THIRD = "/d/ä".encode(), "/d/å".encode(), "/d/ö".encode()

OLD_PAGE, NEW_PAGE = b"old" * 500, b"new" * 400


@pytest.mark.parametrize("profile", FATFS)
async def test_a_new_name_empties_none_that_the_card_takes_for_it(profile: str, autojump: MockClock) -> None:
    world = World(profile)
    world.tree.add(ONE, OLD_PAGE)
    world.tree.add(b"/d/plain", NEW_PAGE)
    async with mounted(world, b"/d") as (_, tree):
        with pytest.raises(AlreadyExists):
            await tree.create(OTHER, exclusive=False)
        with pytest.raises(AlreadyExists):
            await tree.rename(b"/d/plain", OTHER)
        await write_file(tree, THIRD, NEW_PAGE)
        await write_file(tree, ONE, NEW_PAGE)
    assert [world.tree.data(path) for path in (ONE, THIRD, b"/d/plain")] == [NEW_PAGE] * 3


@pytest.mark.parametrize("profile", FATFS)
async def test_nor_one_that_others_made_meanwhile(profile: str, autojump: MockClock) -> None:
    world = World(profile)
    world.tree.add(b"/d/plain", NEW_PAGE)
    async with mounted(world, b"/d") as (_, tree):
        file = await tree.create(OTHER, exclusive=True)
        await file.write(0, NEW_PAGE)
        world.tree.add(ONE, OLD_PAGE)
        await tree.list(b"/d")
        await trio.sleep(21.0)
        await tree.list(b"/d")
        with pytest.raises(AlreadyExists):
            await file.release()
        assert world.tree.data(ONE) == OLD_PAGE


# --- rm of an open file where nothing can be renamed

FOLDER, FILE = b"/d", b"/d/file"

OPENED = content("old", 6000)

GOOD = LinkSettings(rate=50_000.0, delay=0.02)


def card() -> World:
    world = World("littlefs", GOOD)
    world.tree.add(FILE, OPENED)
    world.tree.add(FILE + b".other", b"it")
    return world


def names_left(world: World) -> set[bytes]:
    return {entry.name for entry in world.tree.entries(FOLDER)} - {b".", b".."}


async def test_what_only_the_card_has_stays(autojump: MockClock) -> None:
    world = card()
    async with mounted(world) as (_, tree):
        file = await tree.open(FILE)
        with pytest.raises(FileBusy):
            await tree.unlink(FILE)
        assert bytes(await file.read(0, len(OPENED))) == OPENED
        await file.release()
        await tree.unlink(FILE)
        assert names_left(world) == {b"file.other"}


async def test_what_is_written_here_goes_on_without_a_name(autojump: MockClock) -> None:
    world = card()
    async with mounted(world) as (_, tree):
        file = await tree.open(FILE, write=True)
        await file.write(0, OPENED)
        await tree.unlink(FILE)
        assert names_left(world) == {b"file.other"}
        assert bytes(await file.read(0, len(OPENED))) == OPENED
        await file.write(0, b"more")
        assert bytes(await file.read(0, len(OPENED))) == b"more" + OPENED[4:]
        await file.release()
        assert names_left(world) == {b"file.other"}
        assert tree.undelivered() == []


# --- paths so long that requests do not carry what short ones do

OLD = random.Random(1).randbytes(700)

NEW = random.Random(2).randbytes(900)

CHANGING = {
    Opcode.CREATE_FILE,
    Opcode.OPEN_FILE_WO,
    Opcode.WRITE_FILE,
    Opcode.REMOVE_FILE,
    Opcode.CREATE_DIRECTORY,
    Opcode.REMOVE_DIRECTORY,
    Opcode.TRUNCATE_FILE,
    Opcode.RENAME,
}


def long_path(profile: str, length: int, last: bytes = b"x", name: int = 40) -> bytes:
    """A path of `length` bytes in many directories, with a name of at most `name` bytes."""
    path = ROOTS.get(profile, b"") + b"/d"
    while length - len(path) > name:
        path += b"/directory-%02d" % (len(path) % 100)
    return path + b"/" + b"n" * (length - len(path) - 2) + last


def everything(here: World, directory: bytes = b"/") -> list[bytes]:
    found = []
    for entry in here.tree.entries(directory):
        path = join(directory, entry.name)
        if entry.name in (b".", b".."):
            continue
        found.append(path)
        if here.tree.stat(path).kind is Kind.DIRECTORY:
            found += everything(here, path)
    return found


def watched(here: World) -> list[tuple[int, bytes]]:
    """The opcodes and data of requests from now on."""
    server = here.vehicle.server
    requests: list[tuple[int, bytes]] = []
    handle = server.handle

    def watch(wire: bytes, source: Address, now: float) -> None:
        requests.append((wire[3], wire[12 : 12 + wire[4]]))
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]
    return requests


async def append(tree: Tree, path: bytes, data: bytes) -> None:
    file = await tree.open(path, write=True)
    await file.write(file.size, data)
    await file.release()


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize(("length", "name"), [(118, 40), (119, 40), (200, 198)])
@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_everything_works_up_to_200_bytes(
    profile: str, length: int, name: int, autojump: MockClock
) -> None:
    here = World(profile)
    path, other = long_path(profile, length, name=name), long_path(profile, length, b"y", name=name)
    here.tree.add_directory(split(path)[0])
    before = set(everything(here))
    async with mounted(here) as (_, tree):
        await write_file(tree, path, OLD)
        assert here.tree.data(path) == OLD
        await write_file(tree, path, NEW)
        assert here.tree.data(path) == NEW
        await append(tree, path, OLD)
        assert here.tree.data(path) == NEW + OLD
        await tree.truncate(path, 1000)
        assert here.tree.data(path) == (NEW + OLD)[:1000]
        await tree.truncate(path, 0)
        await write_file(tree, path, NEW)
        if 2 * length + 1 <= RENAME_ROOM:
            await tree.rename(path, other, noreplace=False)
            assert here.tree.data(other) == NEW
            assert path not in everything(here)
            await write_file(tree, path, OLD)
            await tree.rename(path, other, noreplace=False)
        else:
            with pytest.raises(CrossDevice):  # mv copies then
                await tree.rename(path, other, noreplace=False)
            await write_file(tree, other, OLD)
            await tree.unlink(path)
        reading = await tree.open(other)
        await tree.unlink(other)
        await reading.release()
        for directory in [p for p in everything(here) if here.tree.stat(p).kind is Kind.DIRECTORY]:
            await tree.list(directory)
    assert set(everything(here)) == before


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize(("length", "name"), [(118, 40), (119, 90), (200, 198)])
@pytest.mark.parametrize("profile", taking_turns(PROFILES))
async def test_the_first_change_may_be_an_append(
    profile: str, length: int, name: int, autojump: MockClock
) -> None:
    """What is tried out beforehand needs names of its own."""
    here = World(profile)
    path = long_path(profile, length, name=name)
    here.tree.add(path, OLD)
    before = set(everything(here))
    async with mounted(here, inplace=True) as (_, tree):
        await append(tree, path, NEW)
    assert here.tree.data(path) == OLD + NEW
    assert set(everything(here)) == before


@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_a_path_too_long_for_names_beside_it_is_not_written(profile: str, autojump: MockClock) -> None:
    here = World(profile)
    path, new = long_path(profile, 150), long_path(profile, 150, b"y")
    here.tree.add(path, OLD)
    before = set(everything(here))
    async with mounted(here) as (_, tree):
        with pytest.raises(PathTooLong):
            await append(tree, path, b"more")
        with pytest.raises(PathTooLong):
            await write_file(tree, new, NEW)
        assert await read_file(tree, path) == OLD
    assert here.tree.data(path) == OLD
    assert set(everything(here)) == before


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_230_bytes_are_refused_before_anything_is_changed(profile: str, autojump: MockClock) -> None:
    here = World(profile)
    path, new = long_path(profile, 230), long_path(profile, 230, b"y")
    here.tree.add(path, OLD)
    requests = watched(here)
    short = ROOTS.get(profile, b"") + b"/d/short"
    here.tree.add(short, NEW)

    async def replace(tree: Tree) -> None:
        await write_file(tree, path, NEW)

    acts: list[Callable[[Tree], Awaitable[object]]] = [
        replace,
        lambda tree: tree.create(new, exclusive=True),
        lambda tree: append(tree, path, b"more"),
        lambda tree: tree.truncate(path, 10),
        lambda tree: tree.truncate(path, 0),
        lambda tree: tree.rename(path, short, noreplace=False),
        lambda tree: tree.rename(short, new, noreplace=False),
        lambda tree: tree.unlink(path),
        lambda tree: tree.mkdir(new),
        lambda tree: read_file(tree, path),
    ]
    async with mounted(here) as (_, tree):
        for act in acts:
            with pytest.raises(PathTooLong):
                await act(tree)
        assert tree.undelivered() == []
    assert not CHANGING & {opcode for opcode, _ in requests}
    assert here.tree.data(path) == OLD


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", taking_turns(EVERY))
async def test_a_known_directory_does_not_wait_for_a_silent_vehicle(
    profile: str, autojump: MockClock
) -> None:
    """Nor until a request has timed out."""
    scene = Scene(profile)
    async with scene.mounted() as tree:
        known = dict(await tree.list(scene.root))
        await trio.sleep(60.0)
        scene.world.link.cut()
        began = trio.current_time()
        assert dict(await tree.list(scene.root)).keys() == known.keys()
        assert trio.current_time() - began < 10.0
