"""What the vehicle does not have: who is told, what is kept of it, and what is not."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.shared.errors import VehicleLost
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
