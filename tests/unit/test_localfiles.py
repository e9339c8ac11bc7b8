"""Names that never reach the vehicle."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    FileBusy,
    FtpNak,
    IsADirectory,
    NoSpace,
    NotADirectory,
    NotFound,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, card, make_writable, write_file

FILE = b"/scripts/hover.lua"
SWAP = b"/scripts/.hover.lua.swp"
TRASH = b"/.Trash-1000"


store = card({FILE: b"-- old"}, kinds=["fat"])
posix = card({}, directories=[b"/scripts"])


@pytest.mark.parametrize(
    "name", [b".x.swp", b".x.swo", b".x.swpx", b"4913", b".~lock.a.odt#", b"._x", b".Trash-0"]
)
async def test_default_patterns(store: FakeWriter, tree: Tree, name: bytes) -> None:
    await write_file(tree, b"/scripts/" + name, b"data")
    assert await read_file(tree, b"/scripts/" + name) == b"data"
    assert [n for n, _ in await tree.list(b"/scripts")] == [b"hover.lua", name]
    assert store.requests == 0
    await tree.unlink(b"/scripts/" + name)
    with pytest.raises(NotFound):
        await tree.stat(b"/scripts/" + name)


async def test_names_that_look_alike_are_the_vehicles(store: FakeWriter, tree: Tree) -> None:
    for name in (b"x.swp", b"49131", b"lock", b".swp"):
        await write_file(tree, b"/scripts/" + name, b"data")
        assert b"/scripts/" + name in store.files


async def test_vim_saves(store: FakeWriter, tree: Tree) -> None:
    """Swap file, a probe called 4913, a backup by renaming, the new file, backup removed."""
    swap = await tree.create(SWAP, exclusive=True)
    await swap.write(4096, b"b0VIM")
    assert await swap.read(0, 4) == bytes(4)
    await write_file(tree, b"/scripts/4913", b"")
    await tree.unlink(b"/scripts/4913")
    await tree.rename(FILE, FILE + b"~")
    await write_file(tree, FILE, b"-- new")
    await tree.unlink(FILE + b"~")
    await swap.fsync()
    await swap.release()
    await tree.unlink(SWAP)
    assert {path: file.data for path, file in store.files.items()} == {FILE: b"-- new"}
    assert tree.status()["bytes_local"] == 0


async def test_a_local_name_becomes_the_vehicles(store: FakeWriter, tree: Tree) -> None:
    await write_file(tree, SWAP, b"rescued")
    with pytest.raises(AlreadyExists):
        await tree.rename(SWAP, FILE, noreplace=True)
    await tree.rename(SWAP, FILE)
    assert store.files[FILE].data == b"rescued"
    with pytest.raises(NotFound):
        await tree.stat(SWAP)


async def test_a_failed_move_to_the_vehicle_moves_nothing(store: FakeWriter, tree: Tree) -> None:
    await write_file(tree, SWAP, bytes(500))
    store.capacity = 100
    with pytest.raises(Exception, match="errno 28"):
        await tree.rename(SWAP, b"/scripts/new")
    assert await read_file(tree, SWAP) == bytes(500)
    assert tree.undelivered() == []
    assert sorted(store.files) == [FILE]


@pytest.mark.parametrize("step", ["open_upload", "require_free"])
async def test_a_move_that_was_not_begun_shows_nothing(
    monkeypatch: pytest.MonkeyPatch, store: FakeWriter, tree: Tree, step: str
) -> None:
    def lose_link(*_: object, **__: object) -> None:
        raise VehicleLost("before it was made")

    await write_file(tree, SWAP, b"new")
    with monkeypatch.context() as patch:
        patch.setattr(store, step, lose_link)
        with pytest.raises(VehicleLost):
            await tree.rename(SWAP, b"/scripts/new")
    assert sorted(name for name, _ in await tree.list(b"/scripts")) == [b".hover.lua.swp", b"hover.lua"]


async def test_a_file_that_is_being_written_is_not_moved_to_another_place(
    store: FakeWriter, tree: Tree
) -> None:
    """It would be a copy, and what the program writes after that would be lost without a word."""
    for old, new in ((SWAP, b"/scripts/new"), (b"/scripts/it", SWAP)):
        file = await tree.create(old, exclusive=True)
        await file.write(0, b"begun")
        with pytest.raises(FileBusy):
            await tree.rename(old, new)
        await file.write(5, b", done")
        await file.release()
        assert await read_file(tree, old) == b"begun, done"
        with pytest.raises(NotFound):
            await tree.stat(new)
        reader = await tree.open(old)
        await tree.rename(old, new)
        assert await read_file(tree, new) == b"begun, done"
        assert await reader.read(0, 5) == b"begun"
        await reader.release()
        await tree.unlink(new)


async def test_a_file_that_is_written_while_it_is_moved_stays(store: FakeWriter, tree: Tree) -> None:
    """The target has what was there at first; nothing that was written is lost."""
    await write_file(tree, SWAP, b"first")
    store.write_delay = 1.0

    async def change() -> None:
        await trio.sleep(0.5)
        await write_file(tree, SWAP, b"second")

    async with trio.open_nursery() as both:
        both.start_soon(change)
        with pytest.raises(FileBusy):
            await tree.rename(SWAP, b"/scripts/it")
    assert await read_file(tree, SWAP) == b"second"
    assert store.files[b"/scripts/it"].data == b"first"


async def test_a_file_that_is_written_while_it_is_read_to_be_moved_stays(
    store: FakeWriter, tree: Tree
) -> None:
    store.chunk_delay = 1.0

    async with trio.open_nursery() as both:
        both.start_soon(write_file, tree, FILE, b"second")
        with pytest.raises(FileBusy):
            await tree.rename(FILE, SWAP)
    assert store.files[FILE].data == b"second"
    with pytest.raises(NotFound):
        await tree.stat(SWAP)


@pytest.mark.parametrize("later", [0.0, 0.5])
async def test_nothing_is_moved_over_a_file_that_is_being_written(
    store: FakeWriter, tree: Tree, later: float
) -> None:
    """What the program writes after that would land in what was moved there."""
    await write_file(tree, SWAP, b"rescued")
    store.write_delay = 1.0
    file = await tree.open(FILE, write=True)
    await file.write(0, b"begun")
    async with trio.open_nursery() as both:

        async def move_over() -> None:
            await trio.sleep(later)
            assert await move(tree, SWAP, FILE) == SWAP

        both.start_soon(move_over)
        both.start_soon(file.fsync)
    await file.write(5, b", done")
    await file.release()
    assert store.files[FILE].data == b"begun, done"
    assert await read_file(tree, SWAP) == b"rescued"


async def move(tree: Tree, old: bytes, new: bytes) -> bytes:
    """Return where the file is then."""
    try:
        await tree.rename(old, new)
    except FileBusy:
        return old
    return new


@pytest.mark.parametrize("new", [SWAP, b"/other/.x.swp"])
async def test_what_is_written_at_any_moment_of_a_move_is_not_lost(nursery: trio.Nursery, new: bytes) -> None:
    """It stays, or what was written goes along."""
    for moment in range(30):
        store = FakeWriter(KINDS["posix"], nursery)
        store.add(FILE, b"-- old")
        store.add_directory(b"/other")
        tree = make_writable(store)
        await tree.list(b"/scripts")
        store.list_delay, store.open_delay, store.chunk_delay, store.write_delay = 1.0, 0.3, 0.3, 0.1

        async def write() -> None:
            await trio.sleep(moment * 0.1)  # noqa: B023
            try:
                file = await tree.open(FILE, write=True)  # noqa: B023
            except NotFound:
                return
            await file.write(0, b"++")
            await trio.sleep(2)
            await file.release()
            written.append(file)  # noqa: B023

        written: list[OpenFile] = []
        async with trio.open_nursery() as both:
            both.start_soon(write)
            place = await move(tree, FILE, new)
        assert await read_file(tree, place) == (b"++ old" if written else b"-- old"), moment


async def test_what_replaces_a_file_while_it_is_moved_is_not_removed(store: FakeWriter, tree: Tree) -> None:
    await write_file(tree, b"/scripts/other", b"other")
    store.chunk_delay = 1.0
    async with trio.open_nursery() as both:

        async def replace() -> None:
            await trio.sleep(0.5)
            await tree.rename(b"/scripts/other", FILE)

        both.start_soon(replace)
        assert await move(tree, FILE, SWAP) == FILE
    assert store.files[FILE].data == b"other"
    with pytest.raises(NotFound):
        await tree.stat(SWAP)


async def test_trash(store: FakeWriter, tree: Tree) -> None:
    with pytest.raises(NotFound):
        await tree.mkdir(TRASH + b"/files")
    await tree.mkdir(TRASH)
    await tree.mkdir(TRASH + b"/files")
    with pytest.raises(AlreadyExists):
        await tree.mkdir(TRASH)
    assert (await tree.stat(TRASH)).kind is EntryKind.DIRECTORY
    await tree.rename(FILE, TRASH + b"/files/hover.lua")
    assert store.files == {}
    assert [name for name, _ in await tree.list(TRASH + b"/files")] == [b"hover.lua"]
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(TRASH)
    await tree.rename(TRASH + b"/files/hover.lua", FILE)
    assert store.files[FILE].data == b"-- old"
    with pytest.raises(CrossDevice):
        await tree.rename(b"/scripts", TRASH + b"/scripts")
    await write_file(tree, SWAP, b"")
    with pytest.raises(NotADirectory):
        await tree.list(SWAP)


async def test_local_renames_obey_the_rules(tree: Tree) -> None:
    await write_file(tree, SWAP, b"one")
    await write_file(tree, b"/scripts/._a", b"two")
    with pytest.raises(AlreadyExists):
        await tree.rename(SWAP, b"/scripts/._a", noreplace=True)
    await tree.rename(SWAP, b"/scripts/._a")
    assert await read_file(tree, b"/scripts/._a") == b"one"
    await tree.mkdir(TRASH)
    with pytest.raises(IsADirectory):
        await tree.rename(b"/scripts/._a", TRASH)
    with pytest.raises(NotADirectory):
        await tree.rename(TRASH, b"/scripts/._a")
    with pytest.raises(NotFound):
        await tree.rename(b"/scripts/._a", b"/none/._a")
    await tree.rename(TRASH, b"/.Trash-1")
    assert (await tree.stat(b"/.Trash-1")).kind is EntryKind.DIRECTORY
    with pytest.raises(IsADirectory):
        await tree.open(b"/.Trash-1")


async def test_a_directory_with_local_names_is_not_empty_and_takes_them_along(
    store: FakeWriter, tree: Tree
) -> None:
    await write_file(tree, SWAP, b"swap")
    await tree.unlink(FILE)
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/scripts")
    await tree.rename(b"/scripts", b"/programs")
    assert await read_file(tree, b"/programs/.hover.lua.swp") == b"swap"
    await tree.unlink(b"/programs/.hover.lua.swp")
    await tree.rmdir(b"/programs")
    assert store.directories == {b"/"}


async def test_they_are_bounded(store: FakeWriter) -> None:
    tree = make_writable(store, local_max=1000)
    swap = await tree.create(SWAP, exclusive=True)
    await swap.write(0, bytes(1000))
    with pytest.raises(NoSpace):
        await swap.write(1000, b"x")
    with pytest.raises(NoSpace):
        await tree.rename(FILE, b"/scripts/._x")
    await swap.truncate(0)
    await tree.set_times(SWAP, 7 * 10**9 + 5)
    assert ((await tree.stat(SWAP)).mtime, (await tree.stat(SWAP)).mtime_nsec) == (7, 5)
    await tree.rename(FILE, b"/scripts/._x")
    assert store.files == {}


async def test_a_failed_move_costs_nothing_that_was_accepted_before(posix: FakeWriter) -> None:
    """The target was closed while the vehicle refused it, so its bytes are only here."""
    tree = make_writable(posix)
    await write_file(tree, SWAP, b"new")
    posix.capacity = 0
    with pytest.raises(FtpNak):
        await write_file(tree, FILE, b"accepted")
    with pytest.raises(FtpNak):
        await tree.rename(SWAP, FILE)
    assert await read_file(tree, SWAP) == b"new"
    posix.capacity = None
    assert await tree.drain(60) == []
    assert posix.files[FILE].data == b"accepted"


async def test_unlinked_ones_that_are_open_count_too(store: FakeWriter) -> None:
    tree = make_writable(store, local_max=1000)
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
    assert tree.status()["bytes_local"] == 0
    await write_file(tree, SWAP, b"x" * 1000)
