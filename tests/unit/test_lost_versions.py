"""Who has a file open that became another one gets ESTALE for good, whatever is written there later."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileChanged, VehicleLost
from tests.support.fake_writer import KINDS, FakeWriter, make_writable

pytestmark = pytest.mark.holds("promise 5")

FILE = b"/d/file"
OLD, NEW = b"old" * 300, b"NEW" * 300
"""As long as one another: only the times differ."""


@pytest.fixture(params=["fat", "littlefs"])
async def store(request: pytest.FixtureRequest, nursery: trio.Nursery) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS[request.param], nursery)
    store.add(FILE, OLD, 1)
    yield store
    assert store.crimes == []


async def opened(tree: Tree, *, write: bool = False) -> OpenFile:
    """Return who got bytes of the old file."""
    file = await tree.open(FILE, write=write)
    assert bytes(await file.read(0, 9)) == OLD[:9]
    return file


async def reader_of_another(store: FakeWriter, tree: Tree) -> OpenFile:
    """Return a reader that got bytes of a file which somebody else replaced afterwards."""
    reader = await opened(tree)
    store.add(FILE, NEW, 2)
    tree.forget_caches()
    return reader


async def require_lost(reader: OpenFile) -> None:
    for _ in range(2):
        with pytest.raises(FileChanged):
            await reader.read(9, 9)


async def test_it_stays_lost_while_the_new_file_is_written_and_afterwards(store: FakeWriter) -> None:
    tree = make_writable(store, inplace=True)
    lost = await reader_of_another(store, tree)
    later = await tree.open(FILE)
    await require_lost(lost)
    writer = await tree.open(FILE, write=True)
    await require_lost(lost)
    await writer.write(0, b"mid")
    await require_lost(lost)
    await writer.fsync()
    await require_lost(lost)
    for file in (later, writer):
        assert bytes(await file.read(0, 900)) == b"mid" + NEW[3:]
        await file.release()
    await require_lost(lost)
    await lost.release()
    assert store.files[FILE].data == b"mid" + NEW[3:]


async def test_the_kernel_keeps_no_pages_of_the_new_file_while_the_old_one_is_open(
    store: FakeWriter, tree: Tree
) -> None:
    """It would give them to who has the old one open, without asking."""
    lost = await reader_of_another(store, tree)
    later = await tree.open(FILE)
    writer = await tree.open(FILE, write=True)
    beside = await tree.open(FILE)
    assert [file.direct_io for file in (later, writer, beside)] == [True] * 3
    await lost.release()
    for file in (later, writer, beside):
        await file.release()
    assert not (await tree.open(FILE)).direct_io


async def test_all_older_versions_are_lost(store: FakeWriter, tree: Tree) -> None:
    """Also the one that was opened before the file grew."""
    first = await opened(tree)
    store.add(FILE, OLD + OLD, 2)
    tree.forget_caches()
    second = await tree.open(FILE)
    assert bytes(await first.read(0, 900)) == OLD
    assert bytes(await second.read(0, 9)) == OLD[:9]
    store.add(FILE, NEW + NEW, 3)
    tree.forget_caches()
    third = await tree.open(FILE)
    assert bytes(await third.read(0, 1800)) == NEW + NEW
    await require_lost(second)
    await require_lost(first)
    for file in (first, second, third):
        await file.release()


async def test_what_we_write_ourselves_loses_nobody(store: FakeWriter) -> None:
    """Also where listings show the new file before its delivery is over."""
    tree = make_writable(store, inplace=True)
    reader, writer = await tree.open(FILE), await tree.open(FILE, write=True)
    assert bytes(await reader.read(0, 9)) == OLD[:9]
    store.write_delay = store.list_delay = 0.1

    async def look() -> None:
        while True:
            tree.forget_caches()
            await (await tree.open(FILE)).release()
            assert bytes(await reader.read(0, 3)) == b"new"
            await trio.sleep(0.05)

    async with trio.open_nursery() as both:
        await writer.write(0, b"new")
        both.start_soon(look)
        await writer.fsync()
        await writer.write(100, b"newer")
        await writer.truncate(500)
        await writer.fsync()
        both.cancel_scope.cancel()
    for file in (writer, reader):
        await file.release()
    assert store.files[FILE].data == b"new" + OLD[3:100] + b"newer" + OLD[105:500]


async def require_only_the_whole_goes(store: FakeWriter, writer: OpenFile) -> None:
    """No change of the old file replaces the new one, now or later; what is written whole does."""
    for _ in range(2):
        with pytest.raises(FileChanged):
            await writer.fsync()
        await trio.sleep(60.0)
    assert store.files[FILE].data == NEW
    await writer.truncate(0)
    await writer.write(0, b"whole")
    await writer.release()
    assert store.files[FILE].data == b"whole"


@pytest.mark.parametrize("failed", [False, True])
@pytest.mark.parametrize("cut", [False, True])
async def test_changes_that_waited_over_a_restart_go_to_the_very_file_only(
    store: FakeWriter, failed: bool, cut: bool
) -> None:
    """Nobody read in between, which would have shown that the card is another one."""
    tree = make_writable(store, inplace=True)
    writer = await opened(tree, write=True)
    await (writer.truncate(500) if cut else writer.write(0, b"mid"))
    if failed:
        store.lost = True
        with pytest.raises(VehicleLost):
            await writer.fsync()
        store.lost = False
    store.add(FILE, NEW, 2)
    tree.rebooted()
    await require_only_the_whole_goes(store, writer)


@pytest.mark.parametrize("look", ["stat", "read", "write", "empty", "make"])
async def test_a_new_file_is_opened_though_a_writer_has_the_lost_one(store: FakeWriter, look: str) -> None:
    """That one changed nothing of it, and cannot any more; nobody is told that this came to the vehicle."""
    tree = make_writable(store, inplace=True)
    writer = await opened(tree, write=True)
    store.add(FILE, NEW[:-100], 2)
    tree.rebooted()
    await require_lost(writer)
    expected = NEW[:-100]
    if look == "stat":
        assert (await tree.stat(FILE)).size == len(expected)
    elif look == "make":
        assert (await tree.create(FILE, exclusive=False)).size == len(expected)
    else:
        file = await tree.open(FILE, write=look != "read", truncate=look == "empty")
        expected = b"" if look == "empty" else expected
        assert bytes(await file.read(0, 2000)) == expected
        await file.release()
    await require_lost(writer)
    with pytest.raises(FileChanged):
        await writer.write(0, b"mid")
    with pytest.raises(FileChanged):
        await writer.truncate(0)
    await writer.fsync()
    await writer.release()
    assert store.files[FILE].data == expected
    assert tree.undelivered() == []


async def test_who_has_a_file_open_that_others_removed_does_not_get_the_next_one(store: FakeWriter) -> None:
    tree = make_writable(store, inplace=True)
    reader = await opened(tree)
    del store.files[FILE]
    tree.forget_caches()
    writer = await tree.create(FILE, exclusive=True)
    await writer.write(0, NEW)
    await require_lost(reader)
    await writer.fsync()
    await require_lost(reader)
    assert bytes(await writer.read(0, 900)) == NEW
    for file in (writer, reader):
        await file.release()
    assert store.files[FILE].data == NEW


@pytest.mark.parametrize("smaller", [False, True])
async def test_what_is_held_of_a_lost_file_does_not_get_among_the_pages_of_the_new_one(
    store: FakeWriter, smaller: bool
) -> None:
    """The kernel keeps what it was given by one name, whoever asked."""
    tree = make_writable(store, inplace=True)
    writer = await tree.open(FILE, write=True)
    await writer.write(0, b"mid")
    await writer.fsync()
    held = b"mid" + OLD[3:]
    assert bytes(await writer.read(0, 900)) == held
    if not smaller:
        store.files[FILE].mtime = 5
        await trio.sleep(30.0)
        await tree.list(b"/d")
        assert bytes(await writer.read(0, 900)) == held
    new = NEW[:-100] if smaller else NEW
    store.add(FILE, new, 6)
    await trio.sleep(30.0)
    await tree.list(b"/d")
    assert (await tree.stat(FILE)).size == len(new)
    assert FILE in store.invalidated
    reader = await tree.open(FILE)
    await require_lost(writer)
    with pytest.raises(FileChanged):
        await writer.write(0, b"more")
    assert bytes(await reader.read(0, 900)) == new
    beside = await tree.open(FILE, write=True)
    assert [file.direct_io for file in (reader, beside)] == [True] * 2
    for file in (beside, writer, reader):
        await file.release()
    assert not (await tree.open(FILE)).direct_io


async def test_a_file_that_grew_after_it_was_written_stays_who_wrote_it_has_open(store: FakeWriter) -> None:
    tree = make_writable(store, inplace=True)
    writer = await tree.open(FILE, write=True)
    await writer.write(0, b"mid")
    await writer.fsync()
    for _ in range(2):
        await trio.sleep(30.0)
        store.files[FILE].data += b"more"
        await tree.list(b"/d")
    assert bytes(await writer.read(0, 900)) == b"mid" + OLD[3:]
    await writer.release()
