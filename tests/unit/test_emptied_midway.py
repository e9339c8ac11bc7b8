"""A file that is emptied while what it held is on its way: nobody waits for that, or sends it any more.

The same at any request of its delivery on every simulated server: tests/sim/test_overtaken.py.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileBusy, LinkError, OutcomeUnknown, RequestTimeout
from tests.support.fake_writer import KINDS, FakeWriter, litter, make_writable

FOLDER = b"/card/dir"
FILE, NEW = FOLDER + b"/file.txt", FOLDER + b"/new"
OLD = bytes(range(256)) * 20
DATA = bytes(reversed(range(256))) * 30
SHORT = b"short" * 100

PROMPT = 0.6
"""Seconds; a chunk takes 0.1 and the whole delivery more than 3."""


@pytest.fixture(params=["posix", "fat", "mavsdk", "littlefs"])
async def store(
    nursery: trio.Nursery, autojump_clock: object, request: pytest.FixtureRequest
) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS[request.param], nursery)
    store.add(FILE, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


def writable(store: FakeWriter) -> Tree:
    return make_writable(store, inplace=not store.kind.renames)


async def begun(tree: Tree, store: FakeWriter, path: bytes, *, whole: bool = True) -> OpenFile:
    """Return a file that is not delivered; from now on that takes seconds."""
    if path == NEW:
        file = await tree.create(path, exclusive=True)
    else:
        file = await tree.open(path, write=True, truncate=whole)
    await file.write(0, DATA)
    store.write_delay = 0.1
    return file


async def left(tree: Tree, store: FakeWriter) -> set[bytes]:
    """Return which names the card has once all that may follow by itself did."""
    for _ in range(2):
        await trio.sleep(60)
        await tree.list(FOLDER)
    assert litter(store) == []
    return set(store.files)


async def by_opening(tree: Tree, path: bytes, file: OpenFile) -> OpenFile:
    return await tree.open(path, write=True, truncate=True)


async def test_emptying_waits_for_no_room(autojump_clock: object, store: FakeWriter) -> None:
    """Who writes too fast has to wait; who empties the file makes room, also for the other."""
    tree = make_writable(store, inplace=True, dirty_max=64 * 1024)
    file = await tree.create(NEW, exclusive=True)
    store.write_delay = 0.1
    await file.write(0, bytes(128 * 1024))
    async with trio.open_nursery() as writing:

        async def write() -> None:
            await file.write(0, SHORT)

        writing.start_soon(write)
        await trio.sleep(1.05)
        before = trio.current_time()
        other = await by_opening(tree, NEW, file)
        assert trio.current_time() - before < PROMPT
    assert trio.current_time() - before < 2 * PROMPT
    await other.release()
    await file.release()
    assert store.files[NEW].data == SHORT


async def test_emptying_does_not_wait_for_ever(autojump_clock: object, nursery: trio.Nursery) -> None:
    """The renames of a replacement are not called off; they may last longer than a call may."""
    store = FakeWriter(KINDS["posix"], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store)
    file = await begun(tree, store, FILE)
    store.write_delay = 0.0
    async with trio.open_nursery() as waiting:
        store.before_request = lambda *what: setattr(store, "write_delay", 100.0 * (what[0] == "rename"))
        waiting.start_soon(file.fsync)
        await trio.sleep(5.0)
        before = trio.current_time()
        with pytest.raises(FileBusy):
            await by_opening(tree, FILE, file)
        assert trio.current_time() - before == pytest.approx(30.0)
    assert store.files[FILE].data == DATA
    await file.release()
    nursery.cancel_scope.cancel()


@pytest.mark.parametrize("nth", [1, 2, 3])
@pytest.mark.parametrize(("old", "new"), [(b"", b""), (OLD, b""), (OLD, OLD)])
async def test_what_was_taken_back_may_have_got_its_place(
    autojump_clock: object,
    store: FakeWriter,
    monkeypatch: pytest.MonkeyPatch,
    old: bytes,
    new: bytes,
    nth: int,
) -> None:
    """Nobody knows whether the card has what it had before: that is not to be taken for delivered."""
    store.add(FILE, old)
    tree = writable(store)
    file = await tree.open(FILE, write=True)
    await file.write(len(old), SHORT)
    given, renames = store.rename, 0

    async def rename(old: bytes, new: bytes, *, completes: bool = False) -> None:
        nonlocal renames
        renames += 1
        await given(old, new, completes=completes)
        if renames == nth:
            store.lost = True
            raise OutcomeUnknown("no answer")

    monkeypatch.setattr(store, "rename", rename)
    with suppress(LinkError, RequestTimeout):
        await file.fsync()
    store.lost = False
    monkeypatch.setattr(store, "rename", given)
    await file.truncate(len(new))
    await file.fsync()
    assert store.files[FILE].data == new
    await file.release()
    assert await left(tree, store) == {FILE}
    assert store.files[FILE].data == new
