"""mkdir, rmdir, unlink, rename: the rules of the system calls on servers that have none."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.options import MIN_CACHE_SIZE
from mavftpfs.cache.repair import STALE_AFTER
from mavftpfs.cache.reserved import Kind, Reserved
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    FtpNak,
    InvalidMove,
    IsADirectory,
    NotADirectory,
    NotFound,
    PathTooLong,
    VehicleLost,
)
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, litter, make_writable, write_file


@pytest.fixture(params=sorted(KINDS))
async def store(
    request: pytest.FixtureRequest, nursery: trio.Nursery, autojump_clock: object
) -> AsyncIterator[FakeWriter]:
    store = scene(FakeWriter(KINDS[request.param], nursery))
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


@pytest.fixture
async def fat(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = scene(FakeWriter(KINDS["fat"], nursery))
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


def scene(store: FakeWriter) -> FakeWriter:
    store.add(b"/d/a", b"A")
    store.add(b"/d/b", b"B")
    store.add_directory(b"/d/empty")
    store.add(b"/d/full/x", b"X")
    return store


def shape(store: FakeWriter) -> dict[bytes, bytes]:
    return {path: file.data for path, file in store.files.items()}


async def test_directories(store: FakeWriter) -> None:
    tree = make_writable(store)
    await tree.mkdir(b"/d/new")
    assert b"/d/new" in store.directories
    for path in (b"/d/new", b"/d/a"):
        with pytest.raises(AlreadyExists):
            await tree.mkdir(path)
    with pytest.raises(NotFound):
        await tree.mkdir(b"/none/new")
    await tree.rmdir(b"/d/new")
    assert b"/d/new" not in store.directories
    with pytest.raises(NotFound):
        await tree.rmdir(b"/d/new")
    with pytest.raises(NotADirectory):
        await tree.rmdir(b"/d/a")
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/d/full")
    with pytest.raises(IsADirectory):
        await tree.unlink(b"/d/empty")
    with pytest.raises(NotFound):
        await tree.unlink(b"/d/none")
    await tree.unlink(b"/d/a")
    assert b"/d/a" not in store.files


async def test_a_directory_with_an_undelivered_file_is_not_empty(store: FakeWriter) -> None:
    tree = make_writable(store)
    file = await tree.create(b"/d/empty/new", exclusive=True)
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/d/empty")
    await tree.unlink(b"/d/empty/new")
    await file.release()
    await tree.rmdir(b"/d/empty")


async def test_a_directory_filled_behind_our_back_is_not_removed(store: FakeWriter) -> None:
    tree = make_writable(store)
    await tree.list(b"/d/empty")
    store.add(b"/d/empty/new", b"")
    with pytest.raises(DirectoryNotEmpty):
        await tree.rmdir(b"/d/empty")


async def test_who_changes_names_needs_no_room_for_reading(fat: FakeWriter) -> None:
    """Readers that wait have all of that, and each wants its path shared, to open its file."""
    tree = make_writable(fat, cache_size=MIN_CACHE_SIZE)
    opened = await tree.open(b"/d/full/x")
    fat.chunk_delay = 25.0
    async with trio.open_nursery() as readers:
        for name in (b"/d/a", b"/d/b", b"/d/full/x"):
            readers.start_soon(read_file, tree, name)
        await trio.sleep(1)
        assert tree._blocks.reads.statistics().tasks_waiting
        with trio.fail_after(10):
            await tree.rename(b"/d/full/x", b"/d/full/y")
            await tree.unlink(b"/d/full/y")
            await tree.mkdir(b"/d/new")
        readers.cancel_scope.cancel()
    opened.close()


async def test_renames(store: FakeWriter) -> None:
    tree = make_writable(store)
    if not store.kind.renames:
        for old, new in ((b"/d/a", b"/d/c"), (b"/d/a", b"/d/b"), (b"/d/full", b"/d/other")):
            with pytest.raises(CrossDevice):
                await tree.rename(old, new)
        assert shape(store) == {b"/d/a": b"A", b"/d/b": b"B", b"/d/full/x": b"X"}
        return
    await tree.rename(b"/d/a", b"/d/c")
    await tree.rename(b"/d/c", b"/d/b")
    assert shape(store) == {b"/d/b": b"A", b"/d/full/x": b"X"}
    await tree.rename(b"/d/full", b"/d/empty")
    assert shape(store) == {b"/d/b": b"A", b"/d/empty/x": b"X"}
    assert await read_file(tree, b"/d/empty/x") == b"X"
    with pytest.raises(NotFound):
        await tree.list(b"/d/full")
    await tree.rename(b"/d/b", b"/d/b")


@pytest.mark.holds("rule 14.34")
async def test_renames_that_are_refused(store: FakeWriter) -> None:
    tree = make_writable(store)
    for old, new, error in (
        (b"/d/none", b"/d/x", NotFound),
        (b"/d/a", b"/none/x", NotFound),
        (b"/d/a", b"/d/b/x", NotADirectory),
        (b"/d/a", b"/d/empty", IsADirectory),
        (b"/d/empty", b"/d/a", NotADirectory),
        (b"/d/empty", b"/d/full", DirectoryNotEmpty),
        (b"/d/full", b"/d/full/x/y", InvalidMove),
        (b"/d/full", b"/d/full/y", InvalidMove),
    ):
        with pytest.raises(error):
            await tree.rename(old, new)
    with pytest.raises(AlreadyExists):
        await tree.rename(b"/d/a", b"/d/b", noreplace=True)
    with pytest.raises(PathTooLong):
        await tree.rename(b"/d/a", b"/d/" + b"x" * 230)
    assert store.requests == 0


async def test_a_checksum_does_not_stay_with_the_name_of_another_file(fat: FakeWriter) -> None:
    """They have one size and one mtime."""
    tree = make_writable(fat)
    for name in (b"a", b"b"):
        fat.add(b"/d/" + name, name, 1_700_000_000)
    sums = {name: await tree.crc32(b"/d/" + name) for name in (b"a", b"b")}
    await tree.rename(b"/d/a", b"/d/b")
    assert await tree.crc32(b"/d/b") == sums[b"a"] != sums[b"b"]


# --- spelling


@pytest.mark.parametrize("name", [b"a.", b"A.", b"a. .", b"a ", b"empty.", b"A"])
async def test_another_spelling_of_a_name_is_refused(fat: FakeWriter, name: bytes) -> None:
    """FatFs drops dots and blanks at the end, and knows names in any case: `a.` is `a`."""
    tree = make_writable(fat)
    before = shape(fat)
    path = b"/d/" + name
    changes: tuple[Callable[[], Awaitable[None]], ...] = (
        lambda: write_file(tree, path, b"other"),
        lambda: tree.mkdir(path),
        lambda: tree.rename(b"/d/b", path),
    )
    for change in changes:
        with pytest.raises((AlreadyExists, FtpNak, NotFound)):
            await change()
    assert shape(fat) == before


# --- case


# --- what others left


def leave(store: FakeWriter, kind: Kind, owner: bytes, name: bytes, data: bytes) -> bytes:
    path = b"/d/" + Reserved(owner, kind, b"abc", name).name
    store.add(path, data)
    return path


async def test_strangers_temporaries_are_hidden_and_left_alone_for_long(
    autojump_clock: object, fat: FakeWriter
) -> None:
    tree = make_writable(fat, dir_timeout=1)
    temporary = leave(fat, Kind.NEW, b"zzzz", b"a", b"half")
    assert {name for name, _ in await tree.list(b"/d")} == {b"a", b"b", b"empty", b"full"}
    fat.files[temporary].data += b"way"  # it is alive
    await trio.sleep(STALE_AFTER)
    await tree.list(b"/d")
    assert temporary in fat.files
    await trio.sleep(STALE_AFTER)
    await tree.list(b"/d")
    assert temporary not in fat.files
    assert fat.files[b"/d/a"].data == b"A"


async def test_a_strangers_old_file_comes_back_in_the_end(autojump_clock: object, fat: FakeWriter) -> None:
    tree = make_writable(fat, dir_timeout=1)
    leave(fat, Kind.OLD, b"zzzz", b"gone", b"old")
    await tree.list(b"/d")
    await trio.sleep(STALE_AFTER)
    assert b"gone" in {name for name, _ in await tree.list(b"/d")}
    assert fat.files[b"/d/gone"].data == b"old"


async def test_nothing_is_cleaned_up_in_flight(autojump_clock: object, fat: FakeWriter) -> None:
    tree = make_writable(fat, dir_timeout=0)
    leave(fat, Kind.NEW, b"zzzz", b"a", b"half")
    tree.armed_changed(True)
    await tree.list(b"/d")
    await trio.sleep(2 * STALE_AFTER)
    await tree.list(b"/d")
    assert fat.requests == 0


async def test_cleaning_up_that_fails_does_not_fail_the_listing(
    autojump_clock: object, fat: FakeWriter
) -> None:
    tree = make_writable(fat, dir_timeout=1)
    leave(fat, Kind.NEW, b"zzzz", b"a", b"half")
    await tree.list(b"/d")
    await trio.sleep(STALE_AFTER)
    fat.fail_at[1] = PathTooLong("no")
    assert len(await tree.list(b"/d")) == 4


@pytest.mark.parametrize("kind", [name for name in sorted(KINDS) if KINDS[name].renames])
@pytest.mark.parametrize("requests", range(5))
async def test_power_lost_while_an_open_file_is_renamed_over_loses_neither(
    kind: str, requests: int, nursery: trio.Nursery, autojump_clock: object
) -> None:
    old = bytes(range(256)) * 2000
    async with trio.open_nursery() as cut_off:  # or it would go on when the power is back
        store = scene(FakeWriter(KINDS[kind], cut_off))
        store.add(b"/d/long", old)
        tree = make_writable(store)
        file = await tree.open(b"/d/long")
        await file.read(0, 10)
        store.freeze_at = requests
        with suppress(VehicleLost):
            await tree.rename(b"/d/a", b"/d/long")
        file.close()
        cut_off.cancel_scope.cancel()
    store.nursery = nursery
    store.revive()
    next_mount = make_writable(store)  # of the same name, so that what is left is nobody's
    await next_mount.list(b"/d")
    assert store.files[b"/d/long"].data in (old, b"A")
    assert b"A" in (store.files[b"/d/long"].data, store.files.get(b"/d/a", store.files[b"/d/b"]).data)
    assert litter(store) == []
