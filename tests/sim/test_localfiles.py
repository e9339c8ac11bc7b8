"""Names that never reach the vehicle."""

from __future__ import annotations

import pytest

from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    NoSpace,
    NotADirectory,
    NotFound,
    NotSupported,
)
from mavftpfs.shared.model import EntryKind
from tests.support.rigs import Rig, card, read_file, rig, write_file

FILE = b"/scripts/hover.lua"
SWAP = b"/scripts/.hover.lua.swp"
TRASH = b"/.Trash-1000"


here = card({FILE: b"-- old"}, profiles=["ardupilot5"])


@pytest.fixture
def tree(here: Rig) -> Tree:
    """A mount with the default patterns."""
    return here.mount()


@pytest.mark.parametrize(
    "name", [b".x.swp", b".x.swo", b".x.swpx", b"4913", b".~lock.a.odt#", b"._x", b".Trash-0"]
)
async def test_default_patterns(here: Rig, tree: Tree, name: bytes) -> None:
    await write_file(tree, b"/scripts/" + name, b"data")
    assert await read_file(tree, b"/scripts/" + name) == b"data"
    assert [n for n, _ in await tree.list(b"/scripts")] == [b"hover.lua", name]
    assert here.files() == {FILE: b"-- old"}
    await tree.unlink(b"/scripts/" + name)
    with pytest.raises(NotFound):
        await tree.stat(b"/scripts/" + name)


async def test_names_that_look_alike_are_the_vehicles(here: Rig, tree: Tree) -> None:
    for name in (b"x.swp", b"49131", b"lock", b".swp"):
        await write_file(tree, b"/scripts/" + name, b"data")
        assert b"/scripts/" + name in here.files()


async def test_without_patterns_all_names_are_the_vehicles(here: Rig) -> None:
    await write_file(here.mount(local=False), SWAP, b"data")
    assert here.data(SWAP) == b"data"


async def test_what_the_card_has_under_such_a_name_is_the_cards() -> None:
    """As from a Mac, or from a file manager, in whose computer the card was."""
    there = {b"/d/._f": b"of a Mac", b"/.Trash-1000/files/old": b"removed", b"/d/f": b"f"}
    async with rig("ardupilot5", there) as here:
        tree = here.mount()
        assert await read_file(tree, b"/d/._f") == b"of a Mac"
        assert (await tree.stat(b"/.Trash-1000")).kind is EntryKind.DIRECTORY
        assert await read_file(tree, b"/.Trash-1000/files/old") == b"removed"
        await write_file(tree, b"/d/._f", b"new")
        assert here.data(b"/d/._f") == b"new"
        await tree.rename(b"/d/._f", b"/d/g")
        await write_file(tree, b"/d/._f", b"here")
        assert b"/d/._f" not in here.files()
        await tree.unlink(b"/d/._f")
        await tree.unlink(b"/.Trash-1000/files/old")
        await tree.rmdir(b"/.Trash-1000/files")
        await tree.rmdir(b"/.Trash-1000")
        assert here.files() == {b"/d/f": b"f", b"/d/g": b"new"}


async def test_commands_make_files_of_such_names_on_the_card(here: Rig, tree: Tree) -> None:
    file = await tree.create(SWAP, exclusive=True, on_card=True)
    await file.write(0, b"put")
    await file.release()
    await tree.mkdir(TRASH, on_card=True)
    await tree.rename(SWAP, TRASH + b"/f", on_card=True)
    assert here.data(TRASH + b"/f") == b"put"
    assert await read_file(tree, TRASH + b"/f") == b"put"


async def test_a_file_is_not_renamed_between_here_and_the_vehicle(here: Rig, tree: Tree) -> None:
    """The two are different devices to programs, so mv(1) copies and removes."""
    await write_file(tree, SWAP, b"local")
    for old, new in ((SWAP, FILE), (SWAP, b"/scripts/new"), (FILE, SWAP), (b"/scripts", TRASH)):
        with pytest.raises(CrossDevice):
            await tree.rename(old, new)
    assert await read_file(tree, SWAP) == b"local"
    assert here.files() == {FILE: b"-- old"}


async def test_a_trash_is_refused(here: Rig, tree: Tree) -> None:
    """The trash would be lost with the mount. After the refusal file managers offer to delete."""
    with pytest.raises(NotSupported):
        await tree.mkdir(TRASH)
    with pytest.raises(NotFound):
        await write_file(tree, TRASH + b"/files/hover.lua", b"copy")
    await write_file(tree, SWAP, b"")
    with pytest.raises(NotADirectory):
        await tree.list(SWAP)
    with pytest.raises(NotADirectory):
        await tree.rmdir(SWAP)
    with pytest.raises(NotADirectory):
        await write_file(tree, SWAP + b"/x", b"")
    assert here.files() == {FILE: b"-- old"}


async def test_local_renames_obey_the_rules(tree: Tree) -> None:
    await write_file(tree, SWAP, b"one")
    await write_file(tree, b"/scripts/._a", b"two")
    with pytest.raises(AlreadyExists):
        await tree.rename(SWAP, b"/scripts/._a", noreplace=True)
    await tree.rename(SWAP, b"/scripts/._a")
    assert await read_file(tree, b"/scripts/._a") == b"one"
    await tree.rename(b"/scripts/._a", b"/scripts/._a")
    with pytest.raises(NotFound):
        await tree.rename(b"/scripts/._a", b"/none/._a")
    assert await read_file(tree, b"/scripts/._a") == b"one"


async def test_a_directory_with_local_names_is_not_empty_and_takes_them_along(here: Rig, tree: Tree) -> None:
    await write_file(tree, SWAP, b"swap")
    await tree.unlink(FILE)
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/scripts")
    await tree.rename(b"/scripts", b"/programs")
    assert await read_file(tree, b"/programs/.hover.lua.swp") == b"swap"
    await tree.unlink(b"/programs/.hover.lua.swp")
    await tree.rmdir(b"/programs")
    assert here.directories() == []


async def test_they_are_bounded_also_those_that_are_open_without_a_name(here: Rig) -> None:
    tree = here.mount(local_max=1000)
    open_files = []
    for _ in range(3):
        file = await tree.create(SWAP, exclusive=True)
        await file.write(0, b"x" * 100)
        await tree.unlink(SWAP)
        for at in range(100, 300, 100):
            await file.write(at, b"x" * 100)
        open_files.append(file)
    assert tree.status()["bytes_local"] == 900
    with pytest.raises(NoSpace):
        await file.write(300, b"x" * 101)
    with pytest.raises(NoSpace):
        await write_file(tree, SWAP, b"x" * 101)
    for file in open_files:
        assert await file.read(0, 300) == b"x" * 300
        await file.release()
        file.close()
    await tree.unlink(SWAP)
    assert tree.status()["bytes_local"] == 0
    swap = await tree.create(SWAP, exclusive=True)
    await swap.write(0, b"x" * 1000)
    await swap.truncate(0)
    await tree.set_times(SWAP, 7 * 10**9 + 5)
    assert (await tree.stat(SWAP)).mtime_ns == 7_000_000_005
