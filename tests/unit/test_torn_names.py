"""A name that lost its file half-way through a replacement: it is seen on, and soon gets a file again."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.cache.writeback import PAUSES
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import Armed, FtpNak, OutcomeUnknown, VehicleLost
from mavftpfs.shared.model import split
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, list_all, litter, write_file

pytestmark = pytest.mark.holds("promise 9")

OLD = bytes(range(256)) * 4
NEW = b"new content " * 100
FILE = b"/card/dir/file.txt"
OTHER = b"/card/dir/other"


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    """A FAT card: the server does not rename over files, and is known for it."""
    store = FakeWriter(KINDS["fat"], nursery)
    store.traits.rename_replaces = False
    store.add(FILE, OLD)
    store.add(OTHER, NEW)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


class Trap:
    """Does something before, or instead of, one of the renames."""

    def __init__(self, store: FakeWriter, tree: Tree, number: int, what: str) -> None:
        self._store = store
        self._tree = tree
        self._left = number
        self._what = what
        store.before_request = self

    def __call__(self, *request: object) -> None:
        if request[0] != "rename":
            return
        self._left -= 1
        if self._left == 0:
            if self._what == "lost":
                lose(self._store, self._tree)
            else:
                arm(self._store, self._tree, armed=True)


def lose(store: FakeWriter, tree: Tree) -> None:
    store.lost = True
    tree.link_lost()


def arm(store: FakeWriter, tree: Tree, *, armed: bool) -> None:
    store.armed = armed
    tree.armed_changed(armed)


def come_back(store: FakeWriter, tree: Tree) -> None:
    store.lost = False
    tree.link_back()


# --- armed


@pytest.mark.parametrize("number", [1, 2])
async def test_a_replacement_leaves_no_gap_when_the_vehicle_is_armed(
    autojump_clock: object, store: FakeWriter, tree: Tree, number: int
) -> None:
    Trap(store, tree, number, "armed")
    try:
        await write_file(tree, FILE, NEW)
        assert number == 2, "the first rename is not begun in flight"
    except Armed:
        assert number == 1
    assert store.files[FILE].data == (OLD if number == 1 else NEW)
    arm(store, tree, armed=False)
    await trio.sleep(1)
    tree.forget_caches()
    await tree.list(b"/card/dir")
    assert store.files[FILE].data == NEW
    assert litter(store) == []


@pytest.mark.parametrize("number", [1, 2])
async def test_a_move_over_a_file_leaves_no_gap_when_the_vehicle_is_armed(
    store: FakeWriter, tree: Tree, number: int
) -> None:
    Trap(store, tree, number, "armed")
    try:
        await tree.rename(OTHER, FILE)
        assert number == 2
    except Armed:
        assert number == 1
    assert store.files[FILE].data == (OLD if number == 1 else NEW)
    assert (OTHER in store.files) == (number == 1)


async def test_a_refused_finish_is_undone_in_flight(store: FakeWriter, tree: Tree) -> None:
    def refuse(*request: object) -> None:
        if request[0] == "rename" and store.files.get(FILE) is None:
            arm(store, tree, armed=True)
            store.before_request = None
            raise FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 5)

    store.before_request = refuse
    with pytest.raises(FtpNak):
        await write_file(tree, FILE, NEW)
    assert store.files[FILE].data == OLD


async def test_a_finish_that_is_refused_and_cannot_be_undone(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    await tree.list(b"/card/dir")
    left = 2

    def refuse_and_vanish(*request: object) -> None:
        nonlocal left
        left -= request[0] == "rename"
        if left == 0:
            lose(store, tree)
            store.before_request = None
            raise FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 5)

    store.before_request = refuse_and_vanish
    with pytest.raises(FtpNak):
        await tree.rename(OTHER, FILE)
    assert FILE not in store.files
    assert (await tree.stat(FILE)).size == len(OLD)
    come_back(store, tree)
    await trio.sleep(0.1)
    assert store.files[FILE].data == OLD


@pytest.mark.parametrize("armed", [False, True])
async def test_a_gap_that_a_lost_link_left_is_closed_though_armed(
    autojump_clock: object, store: FakeWriter, tree: Tree, armed: bool
) -> None:
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await write_file(tree, FILE, NEW)
    assert FILE not in store.files
    assert await read_file(tree, FILE) == NEW, "the draft is shown meanwhile"
    if armed:
        arm(store, tree, armed=True)
    come_back(store, tree)
    await trio.sleep(1)
    assert store.files[FILE].data == NEW
    if armed:
        arm(store, tree, armed=False)
        await trio.sleep(1)
    assert tree.undelivered() == []


# --- the link is lost between the two renames


async def torn_and_open(store: FakeWriter, tree: Tree) -> OpenFile:
    """Return the open file of a replacement that stopped between its renames."""
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await file.fsync()
    return file


async def test_a_gap_is_closed_although_the_program_has_the_file_open(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file = await torn_and_open(store, tree)
    come_back(store, tree)
    await trio.sleep(1)
    assert store.files[FILE].data == NEW
    file.close()


@pytest.mark.parametrize("number", [1, 2])
async def test_a_move_over_a_file_that_was_cut_off_is_undone(
    autojump_clock: object, store: FakeWriter, tree: Tree, number: int
) -> None:
    await tree.list(b"/card/dir")
    Trap(store, tree, number, "lost")
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    assert (FILE in store.files) == (number == 1)
    shown = dict(await tree.list(b"/card/dir"))
    assert {b"file.txt", b"other"} == set(shown)
    assert shown[b"file.txt"].size == len(OLD)
    assert (await tree.stat(FILE)).size == len(OLD)
    with pytest.raises(VehicleLost):  # not: no such file
        await tree.open(FILE)
    come_back(store, tree)
    await trio.sleep(0.1)
    assert store.files[FILE].data == OLD
    assert store.files[OTHER].data == NEW
    assert litter(store) == []
    assert await read_file(tree, FILE) == OLD


async def test_who_opens_a_torn_name_gets_its_file(store: FakeWriter, tree: Tree) -> None:
    """Before the news that the link is back, too: the listing that comes first mends it."""
    await tree.list(split(FILE)[0])
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    store.lost = False
    tree._directories.lost = False
    assert await read_file(tree, FILE) == OLD


async def test_a_torn_name_that_is_being_read_is_mended(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    reader = await tree.open(FILE)
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    come_back(store, tree)
    await trio.sleep(0.1)
    assert store.files[FILE].data == OLD
    assert bytes(await reader.read(0, len(OLD))) == OLD
    reader.close()


async def test_a_torn_name_that_nobody_asks_for_is_mended_without_news(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    left = 2

    def fall_silent(*request: object) -> None:
        nonlocal left
        left -= request[0] == "rename"
        if left == 0:
            store.before_request = None
            raise OutcomeUnknown("silence")

    store.before_request = fall_silent
    with pytest.raises(OutcomeUnknown):
        await tree.rename(OTHER, FILE)
    assert FILE not in store.files
    await trio.sleep(2 * PAUSES[0])
    assert store.files[FILE].data == OLD
    listings = store.count("list")
    await trio.sleep(1000)
    assert store.count("list") == listings


@pytest.mark.parametrize("long", [False, True])
async def test_removing_a_torn_file_removes_it(store: FakeWriter, tree: Tree, long: bool) -> None:
    """long: what is left of it lies under names that do not tell where they belong."""
    path = b"/card/" + b"f" * 150 if long else FILE
    store.add(path, OLD)
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await write_file(tree, path, NEW)
    store.lost = False
    tree._directories.lost = False
    await tree.unlink(path)
    assert litter(store) == []
    assert tree._writing is not None
    assert tree._writing._context.own.torn == {}
    await list_all(store, tree)
    assert path not in store.files
    assert not [name for name in store.files if b"recovered" in name]


async def test_a_torn_name_in_a_directory_that_is_renamed(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    await tree.list(b"/card/dir")
    Trap(store, tree, 2, "lost")
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    store.lost = False
    tree._directories.lost = False
    await tree.rename(b"/card/dir", b"/card/new")
    tree.link_back()
    await trio.sleep(100)
    assert store.files[b"/card/new/file.txt"].data == OLD
    assert litter(store) == []
    listings = store.count("list")
    await trio.sleep(1000)
    assert store.count("list") == listings


async def test_a_draft_written_on_after_the_gap_does_not_keep_it_open(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file = await torn_and_open(store, tree)
    await file.write(0, b"more")
    arm(store, tree, armed=True)
    come_back(store, tree)
    await trio.sleep(1)
    await tree.list(b"/card/dir")
    assert store.files[FILE].data in (OLD, NEW)
    arm(store, tree, armed=False)
    await file.fsync()
    assert store.files[FILE].data == b"more" + NEW[4:]
    file.close()
