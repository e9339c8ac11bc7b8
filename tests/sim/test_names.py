"""Names that others changed, that differ by case, that a card takes for another, that are long."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    FtpNak,
    IsADirectory,
    NotFound,
    PathTooLong,
    VehicleLost,
)
from mavftpfs.shared.model import RENAME_ROOM
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.rigs import RENAMING, Rig, card, read_file, rig, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import content

EVERY = sorted(PROFILES)
FOLDING_CASE = [
    name for name in EVERY if PROFILES[name].case_fold or PROFILES[name].storage is Storage.NUTTX_FAT
]
LONG = 10.0
D, A, B = b"/d", b"/d/a", b"/d/b"


async def listed(here: Rig) -> Tree:
    """Mount, and list the directory; return the tree when that listing has expired."""
    tree = here.mount()
    await tree.list(D)
    await trio.sleep(LONG)
    return tree


@pytest.mark.holds("rule 14.34")
@pytest.mark.parametrize("profile", RENAMING)
@pytest.mark.parametrize("was_file", [False, True])
async def test_nothing_moves_into_what_became_a_directory(profile: str, was_file: bool) -> None:
    async with rig(profile, {A: b"ours"} | ({B: b""} if was_file else {})) as here:
        tree = await listed(here)
        if was_file:
            here.take(B)
        here.put_directory(B)
        with pytest.raises(IsADirectory):
            await tree.rename(A, B)
        assert (here.files(), here.directories()) == ({A: b"ours"}, [D, B])


@pytest.mark.holds("rule 14.34")
@pytest.mark.parametrize("profile", EVERY)
@pytest.mark.parametrize("opened", [False, True])
async def test_what_became_a_directory_is_not_unlinked(profile: str, opened: bool) -> None:
    async with rig(profile, {A: b"ours"}) as here:
        tree = await listed(here)
        file = await tree.open(A) if opened else None
        await trio.sleep(LONG)
        here.take(A)
        here.put_directory(A)
        with pytest.raises(IsADirectory):
            await tree.unlink(A)
        if file is not None:
            file.close()
        assert here.directories() == [D, A]


@pytest.mark.parametrize("profile", FOLDING_CASE)
async def test_names_that_differ_by_case_are_one_where_the_card_says_so(profile: str) -> None:
    async with rig(profile, {A: b"ours"}) as here:
        here.put_directory(b"/d/test")
        tree = await listed(here)
        acts = [
            tree.create(b"/d/A", exclusive=True),
            tree.mkdir(b"/d/TEST"),
            tree.rename(A, b"/d/TEST"),
            tree.rename(A, b"/d/A"),
        ]
        if not profile.startswith("ardupilot"):  # where a directory looks like nothing; the rename is refused
            acts.append(tree.create(b"/d/TEST", exclusive=False))
        for act in acts:
            with pytest.raises((AlreadyExists, FtpNak)):
                await act
        assert (here.files(), here.directories()) == ({A: b"ours"}, [D, b"/d/test"])


# --- beyond ASCII, on a card that takes their bytes for a code page

FATFS = [name for name, profile in PROFILES.items() if profile.storage is Storage.FATFS]
ONE, OTHER, THIRD, PLAIN = "/d/ä".encode(), "/d/å".encode(), "/d/ö".encode(), b"/d/plain"
OLD_PAGE, NEW_PAGE = b"old" * 500, b"new" * 400


@pytest.mark.parametrize("profile", FATFS)
async def test_a_new_name_empties_none_that_the_card_takes_for_it(profile: str) -> None:
    async with rig(profile, {ONE: OLD_PAGE, PLAIN: NEW_PAGE}) as here:
        tree = await listed(here)
        with pytest.raises(AlreadyExists):
            await tree.create(OTHER, exclusive=False)
        with pytest.raises(AlreadyExists):
            await tree.rename(PLAIN, OTHER)
        await write_file(tree, THIRD, NEW_PAGE)
        await write_file(tree, ONE, NEW_PAGE)
        assert here.files() == dict.fromkeys((ONE, THIRD, PLAIN), NEW_PAGE)


@pytest.mark.parametrize("profile", FATFS)
async def test_nor_one_that_others_made_meanwhile(profile: str) -> None:
    async with rig(profile, {PLAIN: NEW_PAGE}) as here:
        tree = await listed(here)
        file = await tree.create(OTHER, exclusive=True)
        await file.write(0, NEW_PAGE)
        here.put(ONE, OLD_PAGE)
        await trio.sleep(21.0)
        await tree.list(D)
        with pytest.raises(AlreadyExists):
            await file.release()
        assert here.data(ONE) == OLD_PAGE
        told = tree.status()["errors"]
        assert isinstance(told, dict)
        assert told["/d/å"].startswith("'/d/å' "), "a name, not its bytes"


# --- rm of an open file

OPENED = content(6000, 3)

opened = card({A: OPENED, B: b"it"}, profiles=("px4", "littlefs"))


async def test_what_is_written_here_goes_on_without_a_name(opened: Rig) -> None:
    tree = opened.mount()
    file = await tree.open(A, write=True)
    await file.write(0, OPENED)
    await tree.unlink(A)
    assert opened.files() == {B: b"it"}
    assert bytes(await file.read(0, len(OPENED))) == OPENED
    await file.write(0, b"more")
    assert bytes(await file.read(0, len(OPENED))) == b"more" + OPENED[4:]
    await file.release()
    assert opened.files() == {B: b"it"}
    assert tree.undelivered() == []


# --- paths so long that requests do not carry what short ones do

OLD = content(700, 1)
NEW = content(900, 2)
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


def long_path(here: Rig, length: int, last: bytes = b"x", name: int = 40) -> bytes:
    """A path of `length` bytes on the vehicle, in many directories, with a name of at most `name` bytes."""
    length -= len(here.root)
    path = D
    while length - len(path) > name:
        path += b"/directory-%02d" % ((len(here.root) + len(path)) % 100)
    return path + b"/" + b"n" * (length - len(path) - 2) + last


async def append(tree: Tree, path: bytes, data: bytes) -> None:
    file = await tree.open(path, write=True)
    await file.write(file.size, data)
    await file.release()


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize(("length", "name"), [(118, 40), (119, 40), (200, 198)])
@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_everything_works_up_to_200_bytes(profile: str, length: int, name: int) -> None:
    async with rig(profile) as here:
        path, other = long_path(here, length, name=name), long_path(here, length, b"y", name=name)
        here.put_directory(path.rpartition(b"/")[0])
        tree = here.mount()
        await write_file(tree, path, OLD)
        assert here.files() == {path: OLD}
        await write_file(tree, path, NEW)
        assert here.files() == {path: NEW}
        await append(tree, path, OLD)
        assert here.files() == {path: NEW + OLD}
        await tree.truncate(path, 1000)
        assert here.files() == {path: (NEW + OLD)[:1000]}
        await tree.truncate(path, 0)
        await write_file(tree, path, NEW)
        if 2 * length + 1 <= RENAME_ROOM:
            await tree.rename(path, other)
            assert here.files() == {other: NEW}
            await write_file(tree, path, OLD)
            await tree.rename(path, other)
        else:
            with pytest.raises(CrossDevice):  # mv copies then
                await tree.rename(path, other)
            await write_file(tree, other, OLD)
            await tree.unlink(path)
        assert here.files() == {other: OLD}
        reading = await tree.open(other)
        await tree.unlink(other)
        await reading.release()
        for directory in here.directories():
            await tree.list(directory)
        assert here.files() == {}


@pytest.mark.parametrize("profile", taking_turns(RENAMING))
async def test_a_path_too_long_for_names_beside_it_is_not_written(profile: str) -> None:
    async with rig(profile) as here:
        path = long_path(here, 150)
        here.put(path, OLD)
        tree = here.mount()
        with pytest.raises(PathTooLong):
            await append(tree, path, b"more")
        with pytest.raises(PathTooLong):
            await write_file(tree, long_path(here, 150, b"y"), NEW)
        assert await read_file(tree, path) == OLD
        assert here.files() == {path: OLD}


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize("profile", EVERY)
async def test_230_bytes_are_refused_before_anything_is_changed(profile: str) -> None:
    async with rig(profile, {A: NEW}) as here:
        path, new = long_path(here, 230), long_path(here, 230, b"y")
        here.put(path, OLD)
        tree = here.mount()
        acts = [
            write_file(tree, path, NEW),
            tree.create(new, exclusive=True),
            append(tree, path, b"more"),
            tree.truncate(path, 10),
            tree.truncate(path, 0),
            tree.rename(path, A),
            tree.rename(A, new),
            tree.unlink(path),
            tree.mkdir(new),
            read_file(tree, path),
        ]
        for act in acts:
            with pytest.raises(PathTooLong):
                await act
        assert tree.undelivered() == []
        assert not CHANGING & set(here.faults.requests)
        assert here.files() == {path: OLD, A: NEW}


DEEP = [D + b"/e" * depth for depth in range(6)]
UNKNOWN = D + b"/unknown"


async def deep(here: Rig) -> Tree:
    """Mount, and list six levels of directories; return the tree when they have expired."""
    for folder in DEEP:
        here.put(folder + b"/a", b"ours")
    here.put(UNKNOWN + b"/a", b"ours")
    tree = here.mount()
    for folder in DEEP:
        await tree.list(folder)
    await trio.sleep(60.0)
    return tree


async def show(tree: Tree) -> None:
    """As `ls -l` of each directory does, without the kernel's cache."""
    for folder in DEEP:
        for name, _ in await tree.list(folder):
            await tree.stat(folder + b"/" + name)
            with pytest.raises(NotFound):
                await tree.stat(folder + b"/none")


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", taking_turns(EVERY))
async def test_while_the_vehicle_is_lost_nothing_is_waited_for(profile: str) -> None:
    """The heartbeats have stopped; no request has timed out yet."""
    async with rig(profile) as here:
        tree = await deep(here)
        here.link.cut()
        await trio.sleep(20.0)
        began, asked = trio.current_time(), tree.status()["listings_asked"]
        await tree.list(b"/")
        await show(tree)
        acts = [
            tree.list(UNKNOWN),
            tree.stat(UNKNOWN + b"/a"),
            tree.open(A),
            tree.open(b"/@PARAM/param.pck"),
            tree.crc32(A),
            tree.mkdir(B),
            tree.rmdir(UNKNOWN),
            tree.unlink(A),
            tree.rename(A, B),
            tree.truncate(A, 1),
        ]
        for act in acts:
            with pytest.raises(VehicleLost):
                await act
        assert trio.current_time() == began
        assert tree.status()["listings_asked"] == asked
        here.link.restore()
        await trio.sleep(3.0)
        assert await read_file(tree, UNKNOWN + b"/a") == b"ours"


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("profile", taking_turns(EVERY))
async def test_known_directories_wait_until_the_vehicle_is_lost_and_no_longer(profile: str) -> None:
    async with rig(profile) as here:
        tree = await deep(here)
        here.link.cut()
        began = trio.current_time()
        await show(tree)
        assert 4.0 < trio.current_time() - began < 7.0
