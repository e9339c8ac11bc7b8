"""What the vehicle does not have: who is told, what is kept of it, and what is not."""

from __future__ import annotations

from collections.abc import AsyncIterator
from random import Random

import pytest
import trio

from mavftpfs.cache.asides import is_reserved, new_owner
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileBusy, VehicleLost
from mavftpfs.shared.model import split
from tests.support.fake_writer import KINDS, FakeWriter, make_writable

OLD = bytes(range(256)) * 4
FILE = b"/card/dir/file.txt"
NEW = b"/card/dir/new"


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["posix"], nursery)
    store.add(FILE, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


# --- who is told


async def test_fsync_tells_a_reader_what_the_writer_left(store: FakeWriter) -> None:
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


# --- what was taken back


@pytest.fixture
async def mavsdk(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["mavsdk"], nursery)
    store.add(FILE, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


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


def litter(store: FakeWriter) -> list[bytes]:
    return [path for path in store.files if is_reserved(split(path)[1])]


@pytest.mark.parametrize("end", ["flush", "release", "close"])
async def test_an_upload_of_what_was_taken_back_is_called_off(mavsdk: FakeWriter, end: str) -> None:
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


async def test_only_unlinked_files_move_up_from_a_directory_that_goes(mavsdk: FakeWriter) -> None:
    """A temporary name that an upload still needs is nobody's to move."""
    tree = make_writable(mavsdk)
    used = b"/card/other/.mavftpfs-" + new_owner(Random(1)) + b"taaa"  # as make_writable's
    mavsdk.add(used, b"")
    tree._writing._context.live.add(used)  # type: ignore[union-attr]
    with pytest.raises(FileBusy):
        await tree.rmdir(b"/card/other")
    assert used in mavsdk.files
