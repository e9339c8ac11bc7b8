"""Open files that lose their names where the vehicle cannot keep them under another one: they are fetched.

How that goes on every link: tests/sim/test_unlinked.py. Files that are hidden on the vehicle, and those that
are known here anyway: tests/unit/test_writefile.py and test_nameless.py.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
import trio

from mavftpfs.cache.asides import is_reserved
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.spool import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import (
    Armed,
    CrossDevice,
    FileBusy,
    FileChanged,
    FtpNak,
    MavftpfsError,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.shared.model import split
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, card, make_writable

FILE, OTHER = b"/card/dir/file.bin", b"/card/dir/other"
OLD = bytes(range(256)) * 2000
NEW = b"newer bytes" * 100
AT = 200_000
CHANGED = OLD[:AT] + NEW + OLD[AT + len(NEW) :]
DENIED = FtpNak(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, 13)
DEADLINE = 30.0

Open = Callable[[Tree], Awaitable[tuple[OpenFile, bytes]]]


store = card({FILE: OLD, OTHER: b"it"}, kinds=["littlefs"])


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    return make_writable(store)


async def unread(tree: Tree) -> tuple[OpenFile, bytes]:
    return await tree.open(FILE), OLD


async def partly_read(tree: Tree) -> tuple[OpenFile, bytes]:
    file = await tree.open(FILE)
    assert await file.read(100_000, 10) == OLD[100_000:100_010]
    return file, OLD


async def partly_changed(tree: Tree) -> tuple[OpenFile, bytes]:
    file = await tree.open(FILE, write=True)
    await file.write(AT, NEW)
    return file, CHANGED


async def partly_delivered(tree: Tree) -> tuple[OpenFile, bytes]:
    file, content = await partly_changed(tree)
    await file.fsync()
    return file, content


async def cut_and_extended(tree: Tree) -> tuple[OpenFile, bytes]:
    file, content = await partly_changed(tree)
    await file.truncate(AT + 10)
    await file.truncate(AT + 5000)
    return file, content[: AT + 10] + bytes(4990)


async def cut(tree: Tree) -> tuple[OpenFile, bytes]:
    file, content = await partly_changed(tree)
    await file.truncate(AT - 5)
    return file, content[: AT - 5]


async def extended(tree: Tree) -> tuple[OpenFile, bytes]:
    file, content = await partly_changed(tree)
    await file.truncate(len(OLD) + 1000)
    return file, content + bytes(1000)


OPENS: list[Open] = [unread, partly_read, partly_changed, partly_delivered, cut_and_extended, cut, extended]
opens = pytest.mark.parametrize("opened", OPENS)


async def whole(file: OpenFile) -> bytes:
    step = 50_000
    return b"".join([bytes(await file.read(at, step)) for at in range(0, file.size + 1, step)])


def held(tree: Tree) -> object:
    return tree.status()["bytes_held"]


# --- it is kept


@opens
async def test_who_has_it_open_goes_on(
    autojump_clock: object, store: FakeWriter, tree: Tree, opened: Open
) -> None:
    file, content = await opened(tree)
    await tree.unlink(FILE)
    assert sorted(store.files) == [OTHER]
    assert await whole(file) == content
    if file.writable:
        await file.write(3, b"more")
        assert await whole(file) == content[:3] + b"more" + content[7:]
        await file.flush()
        await file.fsync()
    await file.release()
    assert sorted(store.files) == [OTHER]
    assert tree.undelivered() == []
    assert held(tree) == 0


@opens
async def test_others_see_a_new_file_of_that_name(
    autojump_clock: object, store: FakeWriter, tree: Tree, opened: Open
) -> None:
    file, content = await opened(tree)
    reader = await tree.open(FILE)
    await tree.unlink(FILE)
    new = await tree.create(FILE, exclusive=True)
    await new.write(0, b"new")
    await new.release()
    assert await read_file(tree, FILE) == b"new"
    for each in (file, reader):
        assert await whole(each) == content
        await each.release()
    assert store.files[FILE].data == b"new"
    assert held(tree) == 0


async def test_what_is_written_meanwhile_is_newer(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file, content = await partly_changed(tree)
    store.chunk_delay = 0.01  # more than a second in all

    async def write() -> None:
        await trio.sleep(0.5)
        await file.write(0, b"meanwhile")
        await file.write(len(OLD) - 5, b"the end")
        await file.truncate(len(OLD) - 1)

    async with trio.open_nursery() as nursery:
        nursery.start_soon(write)
        await tree.unlink(FILE)
        nursery.cancel_scope.cancel()
    assert await whole(file) == b"meanwhile" + content[9 : len(OLD) - 5] + b"the "
    await file.release()
    assert sorted(store.files) == [OTHER]


async def test_a_program_begins_to_write_it_meanwhile(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    reader, _ = await unread(tree)
    writers: list[OpenFile] = []
    store.chunk_delay = 0.01

    async def write() -> None:
        await trio.sleep(0.5)
        writers.append(await tree.open(FILE, write=True))
        await writers[0].write(AT, NEW)

    async with trio.open_nursery() as nursery:
        nursery.start_soon(write)
        await tree.unlink(FILE)
        nursery.cancel_scope.cancel()
    for each in (reader, writers[0]):
        assert await whole(each) == CHANGED
        await each.release()
    assert sorted(store.files) == [OTHER]
    assert held(tree) == 0


async def test_it_is_removed_at_once_when_nobody_has_it_open_any_more(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    store.chunk_delay = 0.1  # 12 s in all
    file, _ = await partly_read(tree)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(tree.unlink, FILE)
        await trio.sleep(2)
        began = trio.current_time()
        await file.release()
    assert trio.current_time() - began < 2
    assert sorted(store.files) == [OTHER]
    assert held(tree) == 0


async def test_what_became_another_file_cannot_be_kept(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    """Its reader got an error before, and gets one now."""
    file, _ = await partly_read(tree)
    store.files[FILE].data = b"shorter"
    await tree.unlink(FILE)
    assert sorted(store.files) == [OTHER]
    with pytest.raises(FileChanged):
        await file.read(0, 10)
    await file.release()


@pytest.mark.parametrize("kind", sorted(KINDS))
async def test_who_opened_what_was_there_before_does_not_get_the_other(
    nursery: trio.Nursery, autojump_clock: object, kind: str
) -> None:
    """Its bytes would be of two files; who opened the one that is removed goes on."""
    store = FakeWriter(KINDS[kind], nursery)
    store.add(FILE, OLD, mtime=1)
    tree = make_writable(store)
    before, _ = await partly_read(tree)
    store.add(FILE, OLD[::-1], mtime=2)
    tree.forget_caches()
    after = await tree.open(FILE)
    assert await whole(after) == OLD[::-1]
    with pytest.raises(FileChanged):
        await before.read(0, 10)
    await tree.unlink(FILE)
    with pytest.raises(FileChanged):
        await before.read(0, 10)
    if KINDS[kind].renames:
        assert await whole(after) == OLD[::-1]
    await before.release()
    await after.release()
    assert FILE not in store.files
    assert store.crimes == []
    nursery.cancel_scope.cancel()


# --- it is not removed


@opens
@pytest.mark.parametrize("error", [DENIED, Armed("armed")])
async def test_a_removal_that_is_refused_changes_nothing(
    autojump_clock: object, store: FakeWriter, tree: Tree, opened: Open, error: MavftpfsError
) -> None:
    file, content = await opened(tree)
    before = held(tree)

    def refuse(what: str, *_: object) -> None:
        if what == "remove":
            store.fail_at[store.requests + 1] = error

    store.before_request = refuse
    with pytest.raises(type(error)):
        await tree.unlink(FILE)
    store.before_request = None
    assert await whole(file) == content
    if not file.writable:
        assert held(tree) == before
        store.files[FILE].data = b"another one, of another size"
        tree.forget_caches()
        assert await read_file(tree, FILE) == b"another one, of another size"
        await file.release()
        return
    if len(content) < len(OLD):
        file.close()  # it cannot be cut there, so it is not delivered either way
        return
    await file.release()
    assert store.files[FILE].data == content


@opens
async def test_the_link_is_lost_while_it_is_fetched(
    autojump_clock: object, store: FakeWriter, tree: Tree, opened: Open
) -> None:
    file, content = await opened(tree)
    store.chunk_delay = 0.01
    began = trio.current_time()
    async with trio.open_nursery() as nursery:

        async def cut_link() -> None:
            await trio.sleep(0.2)
            store.lost = True

        nursery.start_soon(cut_link)
        with pytest.raises(VehicleLost):
            await tree.unlink(FILE)
    assert trio.current_time() - began < DEADLINE
    store.lost = False
    assert FILE in store.files
    assert await whole(file) == content
    assert await read_file(tree, FILE) == content
    await tree.unlink(FILE)
    assert await whole(file) == content
    await file.release()
    assert sorted(store.files) == [OTHER]


@opens
async def test_what_does_not_come_in_time_is_busy(
    autojump_clock: object, store: FakeWriter, opened: Open
) -> None:
    tree = make_writable(store, op_deadline=DEADLINE)
    file, content = await opened(tree)
    store.chunk_delay = 1.0  # two minutes in all
    began = trio.current_time()
    with pytest.raises(FileBusy):
        await tree.unlink(FILE)
    assert DEADLINE <= trio.current_time() - began < DEADLINE + 2
    assert FILE in store.files
    assert await whole(file) == content
    await tree.unlink(FILE)
    assert await whole(file) == content
    await file.release()


@opens
@pytest.mark.parametrize("options", [{"rmw_max": 100_000}, {"dirty_max": 65536, "spool_max": 150_000}])
async def test_what_is_more_than_is_held_here_is_busy(
    autojump_clock: object, store: FakeWriter, opened: Open, options: dict[str, Any]
) -> None:
    tree = make_writable(store, **options)
    file, content = await opened(tree)
    with pytest.raises(FileBusy):
        await tree.unlink(FILE)
    assert FILE in store.files
    assert await whole(file) == content
    file.close()
    await tree.unlink(FILE)
    assert sorted(store.files) == [OTHER]


@pytest.mark.parametrize("kind", ["littlefs", "posix"])
async def test_what_is_cached_whole_and_does_not_fit_the_local_disk(
    nursery: trio.Nursery, autojump_clock: object, kind: str
) -> None:
    store = FakeWriter(KINDS[kind], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store, dirty_max=65536, spool_max=150_000)
    file, content = await unread(tree)
    assert await whole(file) == content
    if KINDS[kind].renames:
        await tree.unlink(FILE)
        assert FILE not in store.files
    else:
        with pytest.raises(FileBusy):
            await tree.unlink(FILE)
        assert FILE in store.files
    assert held(tree) == 0
    assert await whole(file) == content
    await file.release()
    nursery.cancel_scope.cancel()


async def test_a_dead_mount_offers_no_copy_of_what_the_card_has(
    autojump_clock: object, store: FakeWriter, tmp_path: Path
) -> None:
    spool = SpoolDirectory(tmp_path, Random(1))
    tree = make_writable(store, dirty_max=65536, spool=spool)
    store.chunk_delay = 0.01
    file, _ = await unread(tree)
    notes: list[object] = []

    async def look() -> None:
        while True:
            await trio.sleep(0.05)
            notes.extend(json.loads(note.read_text()) for note in spool.path.glob("*.json"))

    async with trio.open_nursery() as nursery:
        nursery.start_soon(look)
        await tree.unlink(FILE)
        await trio.sleep(0.1)
        nursery.cancel_scope.cancel()
    assert len(notes) > 5
    assert all(note == {"needed": False} for note in notes)
    await file.release()
    spool.close()


async def test_a_copy_that_was_written_is_no_copy_any_more(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    reader, _ = await unread(tree)
    store.fail_at = {2: RequestTimeout("no answer")}  # the first was to rename it
    with pytest.raises(RequestTimeout):
        await tree.unlink(FILE)
    writer = await tree.open(FILE, write=True)
    await writer.write(AT, NEW)
    await writer.release()
    assert store.files[FILE].data == CHANGED
    store.fail_at = {store.requests + 1: DENIED}
    with pytest.raises(FtpNak):
        await tree.unlink(FILE)
    opened = store.count("reader")
    assert await whole(reader) == CHANGED
    assert store.count("reader") == opened
    await reader.release()
    assert held(tree) == 0


# --- where others are hidden

LONG_NAMES = (b"/card/dir/" + b"o" * 140, b"/card/dir/" + b"n" * 140)


@pytest.mark.parametrize("kind", [name for name in sorted(KINDS) if KINDS[name].renames])
@pytest.mark.parametrize("write", [False, True])
async def test_renamed_over_by_steps(
    nursery: trio.Nursery, autojump_clock: object, kind: str, write: bool
) -> None:
    """Names that do not fit one request: the file that is replaced is not hidden."""
    store = FakeWriter(KINDS[kind], nursery)
    old, new = LONG_NAMES
    store.add(old, b"it")
    store.add(new, OLD)
    tree = make_writable(store)
    file, content = await tree.open(new, write=write), OLD
    if write:
        await file.write(AT, NEW)
        content = CHANGED
    await tree.rename(old, new)
    assert {path: node.data for path, node in store.files.items()} == {new: b"it"}
    assert await read_file(tree, new) == b"it"
    assert await whole(file) == content
    await file.release()
    assert {path: node.data for path, node in store.files.items()} == {new: b"it"}
    assert held(tree) == 0
    assert store.crimes == []
    nursery.cancel_scope.cancel()


async def test_nothing_is_fetched_for_a_rename_that_cannot_be(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file, content = await unread(tree)
    store.chunk_delay = 10.0
    with pytest.raises(CrossDevice):
        await tree.rename(OTHER, FILE)
    with pytest.raises(CrossDevice):
        await tree.rename(OTHER, FILE)
    store.chunk_delay = 0.001
    assert await whole(file) == content
    await file.release()


@pytest.mark.parametrize("kind", [name for name in sorted(KINDS) if KINDS[name].renames])
@opens
async def test_where_it_cannot_be_hidden_for_another_reason(
    nursery: trio.Nursery, autojump_clock: object, opened: Open, kind: str
) -> None:
    store = FakeWriter(KINDS[kind], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store)
    file, content = await opened(tree)

    def refuse(what: str, old: object = None, new: bytes = b"", *_: object) -> None:
        if what == "rename" and old == FILE and is_reserved(split(new)[1]):
            store.fail_at[store.requests + 1] = FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 28)

    store.before_request = refuse
    await tree.unlink(FILE)
    assert store.files == {}
    assert await whole(file) == content
    await file.release()
    assert held(tree) == 0
    assert store.crimes == []
    nursery.cancel_scope.cancel()
