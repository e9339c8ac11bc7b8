"""A name that lost its file half-way through a replacement: it is seen on, and soon gets a file again."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.cache.writeback import PAUSES
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, OutcomeUnknown, VehicleLost
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


def lose(store: FakeWriter, tree: Tree) -> None:
    store.lost = True


def lose_at(store: FakeWriter, tree: Tree, number: int) -> None:
    """Lose the link instead of a rename."""

    def count(*request: object) -> None:
        nonlocal number
        number -= request[0] == "rename"
        if number == 0:
            lose(store, tree)

    store.before_request = count


def arm(store: FakeWriter, tree: Tree, *, armed: bool) -> None:
    store.armed = armed
    tree.armed_changed(armed)


def come_back(store: FakeWriter, tree: Tree) -> None:
    store.lost = False
    tree.link_back()


# --- armed


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


# --- the link is lost between the two renames


async def torn_and_open(store: FakeWriter, tree: Tree) -> OpenFile:
    """Return the open file of a replacement that stopped between its renames."""
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    lose_at(store, tree, 2)
    with pytest.raises(VehicleLost):
        await file.fsync()
    return file


async def test_who_opens_a_torn_name_gets_its_file(store: FakeWriter, tree: Tree) -> None:
    """Before the news that the link is back, too: the listing that comes first mends it."""
    await tree.list(split(FILE)[0])
    lose_at(store, tree, 2)
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    store.lost = False
    assert await read_file(tree, FILE) == OLD


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
    lose_at(store, tree, 2)
    with pytest.raises(VehicleLost):
        await write_file(tree, path, NEW)
    store.lost = False
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
    lose_at(store, tree, 2)
    with pytest.raises(VehicleLost):
        await tree.rename(OTHER, FILE)
    store.lost = False
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
