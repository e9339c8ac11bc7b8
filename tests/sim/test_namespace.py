"""mkdir, rmdir, unlink and rename: the rules of the system calls on servers that have none, names that lost
their file half-way, and what others left."""

from __future__ import annotations

import errno
from collections.abc import Awaitable, Callable
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.background import PAUSES
from mavftpfs.cache.directories import Directory
from mavftpfs.cache.options import MIN_CACHE_SIZE
from mavftpfs.cache.repair import AGAIN_AFTER, NAMELESS_FOR, SAME_FOR
from mavftpfs.cache.temporary import Kind, TemporaryName
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    FileChanged,
    FtpNak,
    InvalidMove,
    IsADirectory,
    MavftpfsError,
    NotADirectory,
    NotFound,
    PathTooLong,
    RequestTimeout,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split
from tests.support.rigs import KINDS, Rig, card, list_all, read_file, rig, write_file

SCENE = {b"/d/a": b"A", b"/d/b": b"B", b"/d/full/x": b"X", b"/d/empty/gone": b""}
FILES = {b"/d/a": b"A", b"/d/b": b"B", b"/d/full/x": b"X"}
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
CHANGES = (
    Opcode.CREATE_FILE, Opcode.WRITE_FILE, Opcode.REMOVE_FILE, Opcode.CREATE_DIRECTORY,
    Opcode.REMOVE_DIRECTORY, Opcode.RENAME,
)  # fmt: skip
QUICK = ConnectOptions(op_deadline=8.0)

any_card = card(SCENE, profiles=KINDS)
fat_card = card(SCENE, profiles=["ardupilot5"], options=QUICK)


@pytest.fixture
def each(any_card: Rig) -> Rig:
    """A card of each kind."""
    any_card.take(b"/d/empty/gone")
    return any_card


@pytest.fixture
def fat(fat_card: Rig) -> Rig:
    """A card on which no rename replaces a file."""
    fat_card.take(b"/d/empty/gone")
    return fat_card


# --- the rules


async def test_directories(each: Rig) -> None:
    tree = each.mount()
    await tree.mkdir(b"/d/new")
    assert b"/d/new" in each.directories()
    await tree.rmdir(b"/d/new")
    assert b"/d/new" not in each.directories()
    for call, error in (
        (tree.mkdir(b"/d/a"), AlreadyExists),
        (tree.mkdir(b"/d/empty"), AlreadyExists),
        (tree.mkdir(b"/none/new"), NotFound),
        (tree.rmdir(b"/d/new"), NotFound),
        (tree.rmdir(b"/d/a"), NotADirectory),
        (tree.rmdir(b"/d/full"), DirectoryNotEmpty),
        (tree.unlink(b"/d/empty"), IsADirectory),
        (tree.unlink(b"/d/none"), NotFound),
    ):
        with pytest.raises(error):
            await call
    await tree.unlink(b"/d/a")
    assert b"/d/a" not in each.files()


async def test_a_directory_with_an_undelivered_file_is_not_empty(each: Rig) -> None:
    tree = each.mount()
    file = await tree.create(b"/d/empty/new", exclusive=True)
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/d/empty")
    await tree.unlink(b"/d/empty/new")
    await file.release()
    await tree.rmdir(b"/d/empty")


async def test_a_directory_filled_behind_our_back_is_not_removed(each: Rig) -> None:
    tree = each.mount()
    await tree.list(b"/d/empty")
    each.put(b"/d/empty/new", b"")
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/d/empty")


async def test_renames(each: Rig) -> None:
    tree = each.mount()
    if not each.renames:
        for old, new in ((b"/d/a", b"/d/c"), (b"/d/a", b"/d/b"), (b"/d/full", b"/d/other")):
            with pytest.raises(CrossDevice):
                await tree.rename(old, new)
        assert each.files() == FILES
        return
    await tree.rename(b"/d/a", b"/d/c")
    await tree.rename(b"/d/c", b"/d/b")
    assert each.files() == {b"/d/b": b"A", b"/d/full/x": b"X"}
    await tree.rename(b"/d/full", b"/d/empty")
    assert each.files() == {b"/d/b": b"A", b"/d/empty/x": b"X"}
    assert await read_file(tree, b"/d/empty/x") == b"X"
    with pytest.raises(NotFound):
        await tree.list(b"/d/full")
    await tree.rename(b"/d/b", b"/d/b")


@pytest.mark.holds("rule 14.34")
@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("held", ["read before", "open", "written, and open"])
@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize(
    ("profile", "last"), [("px4", Opcode.RENAME), ("ardupilot5", Opcode.REMOVE_FILE)], ids=["one", "three"]
)
async def test_after_an_interrupted_rename_the_old_file_is_not_read(
    profile: str, last: Opcode, silent: bool, held: str
) -> None:
    """The vehicle did it. The new file is as large as the old one, and listings need not tell times."""
    new, old = b"N" * 500, b"O" * 500
    async with rig(profile, {b"/d/a": new, b"/d/b": old, b"/d/c": b""}, options=QUICK) as here:
        tree = here.mount()
        await tree.rename(b"/d/c", b"/d/other")  # finds out how it renames
        if held == "written, and open":
            file = await tree.open(b"/d/b", write=True)
            await file.write(0, old)
            await file.fsync()
        else:
            file = await tree.open(b"/d/b")
            assert await file.read(0, 500) == old
        if held == "read before":
            file.close()
        with trio.CancelScope() as scope, suppress(MavftpfsError):
            here.faults.at(last, (lambda: here.faults.cut_after(0)) if silent else scope.cancel)
            await tree.rename(b"/d/a", b"/d/b")
        here.faults.cut_after(None)
        assert here.data(b"/d/b") == new
        assert await read_file(tree, b"/d/b") == new
        if held == "open":
            with suppress(FileChanged):
                assert await file.read(0, 500) == old
        await file.release()


async def test_renames_that_are_refused(each: Rig) -> None:
    tree = each.mount()
    for old, new, error in (
        (b"/d/none", b"/d/x", NotFound),
        (b"/d/a", b"/none/x", NotFound),
        (b"/d/a", b"/d/b/x", NotADirectory),
        (b"/d/a", b"/d/empty", IsADirectory),
        (b"/d/empty", b"/d/a", NotADirectory),
        (b"/d/empty", b"/d/full", DirectoryNotEmpty),
        (b"/d/full", b"/d/full/x/y", InvalidMove),
        (b"/d/full", b"/d/full/y", InvalidMove),
        (b"/d/a", b"/d/" + b"x" * 240, PathTooLong),
    ):
        with pytest.raises(error):
            await tree.rename(old, new)
    with pytest.raises(AlreadyExists):
        await tree.rename(b"/d/a", b"/d/b", noreplace=True)
    assert each.count(*CHANGES) == 0


async def test_who_changes_names_needs_no_room_for_reading(fat: Rig) -> None:
    """Readers that wait have all of that, and each wants its path shared, to open its file."""
    tree = fat.mount(cache_size=MIN_CACHE_SIZE)
    opened = await tree.open(b"/d/full/x")
    fat.faults.ignore(Opcode.READ_FILE)

    async def read(name: bytes) -> None:
        with suppress(FileChanged):  # it is removed
            await read_file(tree, name)

    async with trio.open_nursery() as readers:
        for name in (b"/d/a", b"/d/b", b"/d/full/x"):
            readers.start_soon(read, name)
        await trio.sleep(1)
        assert tree._card.cache.reads.value == 0
        with trio.fail_after(7):
            await tree.rename(b"/d/full/x", b"/d/full/y")
            await tree.unlink(b"/d/full/y")
            await tree.mkdir(b"/d/new")
        readers.cancel_scope.cancel()
    opened.close()


# --- spelling


@pytest.mark.parametrize("name", [b"a.", b"A.", b"a. .", b"a ", b"A"])
async def test_another_spelling_of_a_name_is_refused(fat: Rig, name: bytes) -> None:
    """FatFs drops dots and blanks at the end, and knows names in any case: `a.` is `a`."""
    tree, path = fat.mount(), b"/d/" + name
    with pytest.raises(AlreadyExists):
        await tree.create(path, exclusive=False)
    with pytest.raises(AlreadyExists):
        await tree.mkdir(path)
    with pytest.raises(AlreadyExists):
        await tree.rename(b"/d/b", path)
    assert fat.files() == FILES


async def create(tree: Tree, path: bytes) -> None:
    await write_file(tree, path, b"new")


async def make_directory(tree: Tree, path: bytes) -> None:
    await tree.mkdir(path)


async def rename(tree: Tree, path: bytes) -> None:
    await tree.rename(b"/d/a", path)


@pytest.mark.holds("rule 14.33")
@pytest.mark.parametrize("path", [b"/d/ta\tb", b"/d/\tx", b"/d/x\t", b"/d/7\t8"])
@pytest.mark.parametrize("act", [create, make_directory, rename])
async def test_a_name_that_no_listing_can_show_is_refused_and_nothing_is_sent(
    fat: Rig, act: Callable[[Tree, bytes], Awaitable[None]], path: bytes
) -> None:
    """A file that no listing shows could never be removed. Names that never reach the vehicle may be any."""
    tree = fat.mount()
    with pytest.raises(MavftpfsError) as told:
        await act(tree, path)
    assert errno_for(told.value) == errno.EINVAL
    assert tree.undelivered() == []
    await create(tree, b"/d/.ta\tb.swp")
    await tree.unlink(b"/d/.ta\tb.swp")
    assert fat.count(*CHANGES) == 0


@pytest.mark.holds("rule 14.33")
@pytest.mark.parametrize("name", [b"new\nline", b" x ", b"\xff\x01", b"-F", b"S"])
async def test_odd_names_that_are_listed_are_not_refused(name: bytes) -> None:
    async with rig("mavsdk", FILES) as here:
        tree, path = here.mount(), b"/d/" + name
        await create(tree, path)
        assert here.data(path) == b"new"
        await tree.unlink(path)
        await tree.mkdir(path)
        await tree.rmdir(path)
        await rename(tree, path)
        assert here.data(path) == b"A"


# --- what others left


def leave(here: Rig, kind: Kind, name: bytes, data: bytes) -> bytes:
    path = b"/d/" + TemporaryName(b"zzzz", kind, b"abc", name).name
    here.put(path, data)
    return path


async def test_strangers_temporaries_are_hidden_and_left_alone_for_long(fat: Rig) -> None:
    tree = fat.mount(dir_timeout=1)
    temporary = leave(fat, Kind.NEW, b"a", b"half")
    assert {name for name, _ in await tree.list(b"/d")} == {b"a", b"b", b"empty", b"full"}
    fat.put(temporary, b"half way")  # it is alive
    for there in (True, False):
        await trio.sleep(SAME_FOR + 1.0)
        assert (temporary in fat.files()) == there
    assert fat.files() == FILES


async def test_a_strangers_old_file_comes_back_in_the_end(fat: Rig) -> None:
    tree = fat.mount(dir_timeout=1)
    leave(fat, Kind.OLD, b"gone", b"old")
    await tree.list(b"/d")
    await trio.sleep(NAMELESS_FOR - 1.0)
    assert b"/d/gone" not in fat.files()
    await trio.sleep(2.0)
    assert b"gone" in dict(await tree.list(b"/d"))
    assert fat.files() == FILES | {b"/d/gone": b"old"}


async def test_nothing_is_cleaned_up_in_flight_and_who_cannot_lists_all_the_same(fat: Rig) -> None:
    tree = fat.mount(dir_timeout=0)
    left = leave(fat, Kind.NEW, b"a", b"half")
    await fat.arm()
    for _ in range(2):
        await tree.list(b"/d")
        await trio.sleep(SAME_FOR)
    assert fat.count(*CHANGES) == 0
    fat.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL, times=100)
    await fat.disarm()
    assert len(await tree.list(b"/d")) == 4
    assert left in fat.files()
    fat.faults.call_off()
    await trio.sleep(AGAIN_AFTER + 1.0)
    assert left not in fat.files()


# --- names that lost their file half-way through a replacement

OLD, NEW = bytes(range(256)) * 4, b"new content " * 100
FILE, OTHER = b"/d/file.txt", b"/d/other"
LONG = b"/" + b"f" * 150
"""A path so long that its temporary names do not contain its name."""


@pytest.fixture
def torn(fat: Rig) -> Rig:
    """A card whose server is known not to rename over files: a replacement takes two renames."""
    fat.connection.store.traits.rename_works = True
    fat.connection.store.traits.rename_replaces = False
    fat.put(FILE, OLD)
    fat.put(OTHER, NEW)
    return fat


def fall_silent(here: Rig) -> None:
    """Answer nothing more from the second rename on, but go on to send heartbeats: nobody is told."""
    here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=2, drop=True)


def speak(here: Rig) -> None:
    here.faults.cut_after(None)


async def tear(here: Rig, tree: Tree) -> None:
    """Have a rename over FILE stop half-way."""
    await tree.list(b"/d")
    fall_silent(here)
    with pytest.raises(RequestTimeout):
        await tree.rename(OTHER, FILE)
    assert FILE not in here.files()


@pytest.mark.holds("promise 4")
async def test_a_look_at_a_vehicle_that_sends_nothing_but_heartbeats_ends(fat: Rig) -> None:
    tree = fat.mount(dir_timeout=1)
    await tree.list(b"/d")
    fat.faults.cut_after(0)
    await trio.sleep(2)
    with trio.fail_after(20), pytest.raises(RequestTimeout):
        await tree.stat(b"/d/a")


@pytest.mark.holds("promise 9")
async def test_a_refused_finish_is_undone_in_flight(torn: Rig) -> None:
    tree = torn.mount()
    torn.faults.at(Opcode.RENAME, torn.vehicle.arm, nth=2)
    torn.faults.refuse(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.EIO, nth=2, times=2)  # it asks twice
    with pytest.raises(FtpNak):
        await write_file(tree, FILE, NEW)
    assert torn.vehicle.armed
    assert torn.data(FILE) == OLD


@pytest.mark.holds("promise 9")
async def test_a_finish_that_is_refused_and_cannot_be_undone(torn: Rig) -> None:
    tree = torn.mount()
    await tree.list(b"/d")
    torn.faults.refuse(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.EIO, nth=2, times=2)
    torn.faults.at(Opcode.RENAME, torn.link.cut, nth=4, drop=True)
    with pytest.raises(RequestTimeout):
        await tree.rename(OTHER, FILE)
    assert FILE not in torn.files()
    assert (await tree.stat(FILE)).size == len(OLD)
    await torn.find()
    await trio.sleep(2 * PAUSES[0] + 8)  # the name rests: the rename that was not answered may come late
    assert torn.data(FILE) == OLD


@pytest.mark.parametrize("moves", [False, True])
async def test_a_torn_name_that_nobody_asks_for_is_mended_without_news(torn: Rig, moves: bool) -> None:
    """moves: its directory gets another name first."""
    tree = torn.mount()
    await tear(torn, tree)
    speak(torn)
    if moves:
        await tree.rename(b"/d", b"/e")
    await trio.sleep(2 * PAUSES[0] + 8)
    folder = b"/e" if moves else b"/d"
    assert torn.data(folder + b"/file.txt") == OLD
    assert torn.litter() == []
    listings = torn.count(*LISTS)
    await trio.sleep(100)
    assert torn.count(*LISTS) == listings


@pytest.mark.parametrize("drafted", [False, True])
async def test_a_torn_name_whose_old_file_others_removed_is_not_looked_for_without_end(
    torn: Rig, drafted: bool
) -> None:
    """A draft of it becomes a new file."""
    tree = torn.mount()
    if drafted:
        await tree.list(b"/d")
        file = await tree.open(FILE, write=True)
        await file.write(5, b"more")
        fall_silent(torn)
        with pytest.raises(RequestTimeout):
            await file.fsync()
    else:
        await tear(torn, tree)
    for path in torn.litter():
        torn.take(path)
    speak(torn)
    await trio.sleep(2 * PAUSES[0] + 8)
    listings = torn.count(*LISTS)
    await trio.sleep(100)
    assert torn.count(*LISTS) == listings
    if drafted:
        await file.release()
        assert torn.data(FILE) == OLD[:5] + b"more" + OLD[9:]
    else:
        with pytest.raises(NotFound):
            await tree.stat(FILE)


@pytest.mark.parametrize("path", [FILE, LONG])
async def test_removing_a_torn_file_removes_it(torn: Rig, path: bytes) -> None:
    tree = torn.mount()
    torn.put(path, OLD)
    fall_silent(torn)
    with pytest.raises(RequestTimeout):
        await write_file(tree, path, NEW)
    speak(torn)
    await tree.unlink(path)
    await list_all(torn, tree)
    assert set(torn.files()) == {*FILES, FILE, OTHER} - {path}


@pytest.mark.holds("promise 9")
async def test_a_draft_written_on_after_the_gap_does_not_keep_it_open(torn: Rig) -> None:
    tree = torn.mount()
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    fall_silent(torn)
    with pytest.raises(RequestTimeout):
        await file.fsync()
    await file.write(0, b"more")
    await torn.arm()
    speak(torn)
    await trio.sleep(10.0)
    assert torn.data(FILE) in (OLD, NEW)
    await torn.disarm()
    await file.fsync()
    assert torn.data(FILE) == b"more" + NEW[4:]
    await file.release()


async def test_only_a_listing_that_counts_proves_that_a_name_has_its_file(torn: Rig) -> None:
    """One that began before the interruption shows the name because this mount put it there."""
    tree = torn.mount()
    await tear(torn, tree)
    speak(torn)
    now = trio.current_time()
    shown = Directory({b"file.txt": DirEntry(b"file.txt", EntryKind.FILE, 3)}, now, now, now + 20, True)
    for aside in torn.litter():
        name = split(aside)[1]
        shown.entries[name] = DirEntry(name, EntryKind.FILE, len(OLD))
    await tree._card.repair.on_swept(b"/d", shown)
    assert len(torn.litter()) == 1
    await tree.list(b"/d")
    assert torn.data(FILE) == OLD
    assert torn.litter() == []


@pytest.mark.holds("promise 3")
async def test_a_name_that_lost_its_file_gets_the_new_one_and_nothing_is_sent_again(torn: Rig) -> None:
    """The rename that gives the new file the name is lost, and so is everything until the vehicle answers."""
    tree = torn.mount()
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    fall_silent(torn)
    with pytest.raises(RequestTimeout):
        await file.fsync()
    assert FILE not in torn.files()
    sent = torn.count(Opcode.WRITE_FILE)
    speak(torn)
    await trio.sleep(10.0)
    assert torn.data(FILE) == NEW
    assert tree.undelivered() == []
    assert torn.count(Opcode.WRITE_FILE) == sent
    assert torn.litter() == []
    await file.release()


@pytest.mark.parametrize("moves", [False, True])
async def test_old_files_of_a_name_go_with_it_also_those_of_other_mounts(torn: Rig, moves: bool) -> None:
    """Otherwise a later repair would bring the name back."""
    tree = torn.mount()
    left = leave(torn, Kind.OLD, b"file.txt", b"older")
    await tree.list(b"/d")
    await (tree.rename(FILE, b"/d/moved") if moves else tree.unlink(FILE))
    assert left not in torn.files()
    await trio.sleep(SAME_FOR)
    assert FILE not in torn.files()


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("profile", ["px4", "ardupilot5", "mavsdk"])
async def test_a_file_that_another_client_removed_before_its_rename_shows_what_the_card_has(
    profile: str,
) -> None:
    here = Rig(profile, {b"/a": b"A" * 500, b"/b": b"B" * 500})
    async with here.mounted(listed=b"/") as tree:
        assert await read_file(tree, b"/a") == b"A" * 500
        await trio.sleep(30)
        await tree.list(b"/")
        here.take(b"/a")
        with suppress(MavftpfsError):
            await tree.rename(b"/a", b"/b")
        await trio.sleep(60)
        assert await read_file(tree, b"/b") == here.data(b"/b")
