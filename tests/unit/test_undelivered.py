"""What the vehicle does not have: who is told, what is kept of it, and what is not."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from random import Random

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.cache.tree import Tree
from mavftpfs.farewell import keep_the_rest
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    NotDeliveredYet,
    SpoolFailed,
    VehicleLost,
)
from mavftpfs.shared.model import split
from tests.support.fake_writer import FakeWriter, card, litter, make_writable

pytestmark = pytest.mark.holds("promise 3")

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


@pytest.mark.parametrize("end", ["flush", "release"])
async def test_an_upload_of_what_was_taken_back_is_called_off(
    autojump_clock: object, mavsdk: FakeWriter, end: str
) -> None:
    tree = make_writable(mavsdk)
    file = await append_and_take_back(mavsdk, tree)
    await getattr(file, end)()
    assert litter(mavsdk) == []
    assert all(upload.aborted for upload in mavsdk.uploads if is_reserved(split(upload.path)[1]))
    assert mavsdk.files[FILE].data == b"y" + OLD[1:]
    file.close()
    await tree.unlink(FILE)
    await tree.rmdir(split(FILE)[0])


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
    assert json.loads((tmp_path / "kept/card__dir__b.json").read_text())["path"] == "/card/dir/b"
    assert tree.undelivered() == [b"/card/dir/a"], "it stays in the spool"
    assert len(list(spool.path.glob("*.data"))) == 1
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
