"""What the vehicle does not have: who is told, what is kept of it, and what is not."""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest
import trio

from mavftpfs.cache.asides import is_reserved, new_owner
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.spool import SpoolContent, SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.farewell import keep_the_rest
from mavftpfs.protocol.crc import crc32
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    FileBusy,
    FileTooLarge,
    MavftpfsError,
    NotDeliveredYet,
    RequestTimeout,
    SpoolFailed,
    VehicleLost,
)
from mavftpfs.shared.model import split
from tests.support.fake_writer import CHUNK, KINDS, FakeWriter, card, litter, make_writable

OLD = bytes(range(256)) * 4
FILE = b"/card/dir/file.txt"
NEW = b"/card/dir/new"


store = card({FILE: OLD})


# --- who is told


async def test_fsync_tells_a_reader_what_the_writer_left(autojump_clock: object, store: FakeWriter) -> None:
    """`sync FILE` opens for reading."""
    tree = make_writable(store)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"abc" * 100)
    store.lost = True
    with pytest.raises(VehicleLost):
        await file.release()
    reader = await tree.open(NEW)
    await reader.flush()
    with pytest.raises(VehicleLost):
        await reader.fsync()
    assert tree.undelivered() == [NEW]
    store.lost = False
    await reader.fsync()
    assert store.files[NEW].data == b"abc" * 100
    reader.close()
    assert tree.undelivered() == []


async def test_a_checksum_is_the_vehicle_s_or_none(autojump_clock: object, store: FakeWriter) -> None:
    """Never that of the bytes that are held here: who asks wants to know what is on the card."""
    tree = make_writable(store)
    file = await tree.open(FILE, write=True)
    await file.write(0, b"new")
    with pytest.raises(NotDeliveredYet) as caught:
        await tree.crc32(FILE)
    assert errno_for(caught.value) == errno.EAGAIN
    await file.fsync()
    assert await tree.crc32(FILE) == crc32(b"new" + OLD[3:])
    file.close()


# --- what nobody learnt of


async def test_a_file_whose_creation_failed_does_not_appear_later(
    autojump_clock: object, store: FakeWriter
) -> None:
    tree = make_writable(store)
    await tree.list(split(NEW)[0])
    file = await tree.create(NEW, exclusive=True)
    store.lost = True
    with pytest.raises(VehicleLost):
        await file.release()
    file.give_up()
    assert tree.undelivered() == []
    store.lost = False
    await trio.sleep(100)
    assert NEW not in store.files


async def test_a_file_whose_creation_failed_stays_if_somebody_wrote_it_or_it_was_there(
    autojump_clock: object,
    store: FakeWriter,
) -> None:
    tree = make_writable(store)
    file = await tree.create(NEW, exclusive=True)
    other = await tree.open(NEW, write=True)
    await other.write(0, b"abc")
    file.give_up()
    assert tree.undelivered() == [NEW]
    other.close()
    old = await tree.create(NEW, exclusive=False)
    old.give_up()
    emptied = await tree.open(FILE, write=True, truncate=True)
    emptied.close()
    again = await tree.create(FILE, exclusive=False)
    again.give_up()
    assert sorted(tree.undelivered()) == [FILE, NEW]
    assert await tree.drain(10) == []
    assert (store.files[NEW].data, store.files[FILE].data) == (b"abc", b"")


# --- what was taken back


mavsdk = card({FILE: OLD}, kinds=["mavsdk"])


async def append_and_take_back(store: FakeWriter, tree: Tree) -> OpenFile:
    """Return the open file: its upload began under a temporary name, and nothing is to change any more."""
    file = await tree.open(FILE, write=True)
    await file.write(0, b"y")
    await file.fsync()
    await file.write(len(OLD), bytes(100 * 1024))
    await trio.sleep(1)
    assert litter(store), "it was to begin beside the program"
    await file.truncate(len(OLD))
    return file


@pytest.mark.parametrize("end", ["flush", "release", "close"])
async def test_an_upload_of_what_was_taken_back_is_called_off(
    autojump_clock: object, mavsdk: FakeWriter, end: str
) -> None:
    tree = make_writable(mavsdk)
    file = await append_and_take_back(mavsdk, tree)
    if end == "close":
        file.close()
        await trio.sleep(1)
    else:
        await getattr(file, end)()
    assert litter(mavsdk) == []
    assert all(upload.aborted for upload in mavsdk.uploads if is_reserved(split(upload.path)[1]))
    assert mavsdk.files[FILE].data == b"y" + OLD[1:]
    file.close()
    await tree.unlink(FILE)
    await tree.rmdir(split(FILE)[0])


async def test_only_unlinked_files_move_up_from_a_directory_that_goes(
    autojump_clock: object, mavsdk: FakeWriter
) -> None:
    """A temporary name that an upload still needs is nobody's to move."""
    tree = make_writable(mavsdk)
    used = b"/card/other/.mavftpfs-" + new_owner(Random(1)) + b"taaa"  # as make_writable's
    mavsdk.add(used, b"")
    tree._writing._context.live.add(used)  # type: ignore[union-attr]
    with pytest.raises(FileBusy):
        await tree.rmdir(b"/card/other")
    assert used in mavsdk.files


# --- what was emptied, or cut


async def test_what_is_emptied_is_not_changed_in_place_any_more(
    autojump_clock: object, store: FakeWriter
) -> None:
    """An append was on its way in place; the new content may only replace the file as a whole."""
    tree = make_writable(store)
    file = await tree.open(FILE, write=True)
    await file.write(0, b"y")
    await file.fsync()
    store.write_delay = 0.01
    await file.write(len(OLD), b"a" * 100 * 1024)
    await trio.sleep(1)
    reached = len(store.files[FILE].data)
    assert len(OLD) < reached < len(OLD) + 100 * 1024
    await file.truncate(0)
    for at in range(0, 200 * 1024, 20 * 1024):
        await file.write(at, b"N" * 20 * 1024)
    await trio.sleep(3)
    assert store.files[FILE].data.startswith(b"y" + OLD[1:] + b"a")
    assert len(store.files[FILE].data) <= reached + CHUNK
    assert litter(store), "it is replaced, beside the program"
    await file.release()
    assert store.files[FILE].data == b"N" * 200 * 1024
    assert litter(store) == []


@pytest.mark.parametrize("size", [0, 100])
async def test_what_is_cut_while_it_is_about_to_be_changed_in_place_is_not(
    autojump_clock: object, store: FakeWriter, size: int
) -> None:
    """The size on the vehicle is being asked for."""
    store.add(FILE, LARGE)
    store.traits.wo_truncates = False
    tree = make_writable(store)
    file = await tree.open(FILE, write=True)
    store.list_delay = 1.0
    await file.write(0, b"n" * 70_000)
    await trio.sleep(0.5)
    await file.truncate(size)
    await file.write(0, b"m" * 70_000)
    await trio.sleep(20)
    assert store.files[FILE].data == LARGE
    await file.release()
    assert store.files[FILE].data == b"m" * 70_000
    assert litter(store) == []


LARGE = bytes(range(256)) * 400


large = card({FILE: LARGE}, kinds=["posix", "fat", "mavsdk"])


async def change_and_cut(tree: Tree) -> None:
    file = await tree.open(FILE, write=True)
    try:
        await file.write(10, b"A" * 10)
        await file.truncate(90_000)
        await file.release()
    finally:
        file.close()


async def test_a_large_file_is_changed_and_cut_where_both_can_be_done(
    autojump_clock: object, large: FakeWriter
) -> None:
    tree = make_writable(large, rmw_max=50_000)
    if large.kind != KINDS["posix"]:
        with pytest.raises(FileTooLarge):
            await change_and_cut(tree)
        assert large.files[FILE].data == LARGE
        return
    await change_and_cut(tree)
    assert large.files[FILE].data == (LARGE[:10] + b"A" * 10 + LARGE[20:])[:90_000]
    assert sum(entry[0] == "write" and entry[1] == str(FILE) for entry in large.log) == 1
    assert tree.undelivered() == []


async def test_a_change_and_cut_goes_on_after_any_fault(autojump_clock: object, large: FakeWriter) -> None:
    if large.kind != KINDS["posix"]:
        return
    await change_and_cut(make_writable(large))
    wanted = large.files[FILE].data
    for number in range(1, large.requests + 1):
        for lost in (False, True):
            store = FakeWriter(KINDS["posix"], large.nursery)
            store.add(FILE, LARGE)
            tree = make_writable(store)
            store.lose_reply_at = {number} if lost else set()
            store.fail_at = {} if lost else {number: RequestTimeout("silence")}
            with suppress(MavftpfsError):
                await change_and_cut(tree)
            assert tree.undelivered() or store.files[FILE].data == wanted
            await tree.drain(60)
            assert store.files[FILE].data == wanted
            assert (tree.undelivered(), store.crimes) == ([], [])


# --- what is kept at the end


async def two_on_disk(store: FakeWriter, base: Path) -> tuple[Tree, SpoolDirectory]:
    """Return a tree with two files on the local disk that the vehicle lacks; the first lost bytes."""
    spool = SpoolDirectory(base / "spool", Random(1))
    tree = make_writable(store, spool=spool)
    files = [await tree.create(name, exclusive=True) for name in (b"/card/dir/a", b"/card/dir/b")]
    store.lost = True
    for file, name in zip(files, (b"/card/dir/a", b"/card/dir/b"), strict=True):
        await file.write(0, name * 100)
        with pytest.raises(VehicleLost):
            await file.release()
    os.truncate(min(spool.path.glob("*.data")), 10)
    return tree, spool


async def test_one_file_that_cannot_be_read_does_not_keep_the_others_from_being_saved(
    autojump_clock: object, store: FakeWriter, tmp_path: Path
) -> None:
    tree, spool = await two_on_disk(store, tmp_path)
    message = keep_the_rest(tree, lambda: tmp_path / "kept")
    assert f"2 file(s) did not reach the vehicle; only 1 could be kept, in {tmp_path / 'kept'}" in message
    assert (tmp_path / "kept/card__dir__b").read_bytes() == b"/card/dir/b" * 100
    first, second = json.loads((tmp_path / "kept/manifest.json").read_text())
    assert first["path"] == "/card/dir/a"
    assert "lost bytes" in first["not_saved"]
    assert "not_saved" not in second
    assert tree.undelivered() == [b"/card/dir/a"], "it stays in the spool"
    assert len(list(spool.path.glob("*.data"))) == 1
    spool.close()


async def test_when_nothing_can_be_saved_that_is_said(
    autojump_clock: object, store: FakeWriter, tmp_path: Path
) -> None:
    tree, spool = await two_on_disk(store, tmp_path)
    for path in spool.path.glob("*.data"):
        os.truncate(path, 10)
    message = keep_the_rest(tree, lambda: tmp_path / "kept")
    assert message.startswith("2 file(s) did not reach the vehicle")
    assert "lost bytes" in message
    spool.close()


# --- a local disk that fails as the vehicle does


async def test_a_disk_that_fails_does_not_hide_why_the_vehicle_lacks_a_file(
    autojump_clock: object, store: FakeWriter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = SpoolDirectory(tmp_path / "spool", Random(1))
    tree = make_writable(store, spool=spool)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"abc")
    store.lost = True

    def persist(*_: object) -> None:
        raise SpoolFailed("bad sector")

    monkeypatch.setattr(SpoolContent, "persist", persist)
    with pytest.raises(VehicleLost):
        await file.release()
    store.lost = False
    assert await tree.drain(10) == []
    assert store.files[NEW].data == b"abc"
    spool.close()
