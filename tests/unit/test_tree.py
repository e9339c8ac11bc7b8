"""The facade: walking, sharing sweeps, stale listings, the mount's root, sizes, checksums, news."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from random import Random

import pytest
import trio
import trio.testing

from mavftpfs.cache.attributes import SECOND, UNKNOWN_MTIME
from mavftpfs.cache.directories import SWEEP_TRIES
from mavftpfs.cache.options import MIN_CACHE_SIZE, CacheOptions
from mavftpfs.cache.reserved import Kind, Reserved, new_owner
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.cache.tree import Stat, Tree
from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    PathTooLong,
    ReadOnly,
    RequestTimeout,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from tests.support.fake_store import FakeFile, FakeStore, make_tree, read_file

FILE, DIRECTORY = EntryKind.FILE, EntryKind.DIRECTORY


@pytest.fixture
def store(nursery: trio.Nursery) -> FakeStore:
    store = FakeStore(nursery)
    store.add(b"/fs/microsd/a.txt", b"hello", 1_700_000_000)
    store.add(b"/fs/microsd/log/2024-05-01/12_34_56.ulg", b"u" * 10)
    store.add(b"/top", b"t")
    return store


@pytest.fixture
def tree(store: FakeStore) -> Tree:
    return make_tree(store)


# --- walking


@pytest.mark.holds("promise 4")
async def test_stat_walks_from_the_root_and_then_costs_nothing(store: FakeStore, tree: Tree) -> None:
    assert await tree.stat(b"/fs/microsd/a.txt") == Stat(FILE, 5, 1_700_000_000 * SECOND, 1.0)
    assert store.calls == [("list", b"/"), ("list", b"/fs"), ("list", b"/fs/microsd")]
    assert (await tree.stat(b"/fs/microsd/log")).kind is DIRECTORY
    assert await tree.stat(b"/fs") == Stat(DIRECTORY, 0, UNKNOWN_MTIME * SECOND, 1.0)
    assert len(store.calls) == 3


async def test_absence_by_a_fresh_listing_costs_nothing(store: FakeStore, tree: Tree) -> None:
    with pytest.raises(NotFound):
        await tree.stat(b"/none")
    with pytest.raises(NotFound):
        await tree.stat(b"/none/deeper")
    assert store.calls == [("list", b"/")]
    assert tree.negative_valid_for(b"/none") == 2.0
    await trio.sleep(19)
    assert tree.negative_valid_for(b"/none") == pytest.approx(1.0)
    await trio.sleep(2)
    assert tree.negative_valid_for(b"/none") == 0.0
    assert tree.negative_valid_for(b"/unknown/none") == 0.0


@pytest.mark.holds("promise 6", "rule 14.30")
async def test_a_file_is_never_listed(store: FakeStore, tree: Tree) -> None:
    for path in (b"/top/x", b"/top/x/y", b"/fs/microsd/a.txt/b"):
        with pytest.raises(NotADirectory):
            await tree.stat(path)
    with pytest.raises(NotADirectory):
        await tree.list(b"/top")
    assert store.crimes == []


async def test_a_refused_directory_is_looked_for_again(store: FakeStore, tree: Tree) -> None:
    await tree.stat(b"/fs/microsd")
    store.remove(b"/fs/microsd")
    with pytest.raises(FtpNak):
        await tree.list(b"/fs/microsd")
    with pytest.raises(NotFound):
        await tree.list(b"/fs/microsd")
    assert store.count("list", b"/fs") == 2


async def test_hostile_paths(store: FakeStore, tree: Tree) -> None:
    with pytest.raises(LocalProtocolError):
        await tree.stat(b"/fs/../etc")
    with pytest.raises(PathTooLong):
        await tree.stat(b"/x" * 1000)
    assert store.calls == []
    assert (await tree.stat(b"//fs/./microsd/")).kind is DIRECTORY


@pytest.mark.holds("rule 14.33")
async def test_a_name_too_long_to_be_asked_for_is_still_shown(store: FakeStore, tree: Tree) -> None:
    name = b"n" * 190
    store.add(b"/fs/microsd/" + name, b"x")
    assert (await tree.stat(b"/fs/microsd/" + name)).size == 1
    with pytest.raises(PathTooLong):
        await tree.open(b"/fs/microsd/" + name)


async def test_attributes_are_valid_no_longer_than_the_listing(store: FakeStore, tree: Tree) -> None:
    await tree.stat(b"/top")
    await trio.sleep(19.5)
    assert (await tree.stat(b"/top")).valid_for == pytest.approx(0.5)


# --- sweeps


async def test_requests_for_one_listing_share_a_sweep(store: FakeStore, tree: Tree) -> None:
    store.list_delay = 1
    async with trio.open_nursery() as askers:
        for _ in range(5):
            askers.start_soon(tree.list, b"/")
            askers.start_soon(tree.stat, b"/top")
    assert store.count("list") == 1
    assert tree.status()["listings_asked"] == 1


@pytest.mark.parametrize("background", [False, True])
async def test_a_cancelled_sweep(store: FakeStore, nursery: trio.Nursery, background: bool) -> None:
    """With a nursery it goes on for the next caller; without one the other caller starts anew."""
    tree = make_tree(store, nursery=nursery if background else None)
    store.list_delay = 40
    lists = []

    async def ask() -> None:
        lists.append(await tree.list(b"/"))

    async with trio.open_nursery() as askers:
        with trio.move_on_after(30):
            async with trio.open_nursery() as inner:
                inner.start_soon(tree.list, b"/")
                await trio.testing.wait_all_tasks_blocked()
                askers.start_soon(ask)
    assert len(lists) == 1
    assert trio.current_time() == pytest.approx(40 if background else 70)
    assert store.count("list") == (1 if background else 2)


async def test_a_listing_that_is_always_raced_is_given_up_on(store: FakeStore, tree: Tree) -> None:
    store.during_list = lambda path: tree._directories.put(b"/never", None)
    assert b"top" in dict(await tree.list(b"/"))
    assert store.count("list", b"/") == SWEEP_TRIES
    assert tree.negative_valid_for(b"/none") == 0.0


async def test_a_tree_that_is_only_read_shows_what_others_left(store: FakeStore, tree: Tree) -> None:
    """Names like those of our own, too: there may be nothing else left of a file."""
    left = Reserved(new_owner(Random(1)), Kind.NEW, b"sss", b"a.txt").name
    for name in (left, b".a.txt.swp"):
        store.add(b"/fs/microsd/" + name, b"left")
        assert await read_file(tree, b"/fs/microsd/" + name) == b"left"
        tree.forget_caches()
    assert {left, b".a.txt.swp"} < set(dict(await tree.list(b"/fs/microsd")))
    with pytest.raises(ReadOnly):
        await tree.unlink(b"/fs/microsd/" + left)


# --- the vehicle is out of reach


@pytest.mark.holds("promise 4")
async def test_expired_listings_are_served_while_the_vehicle_is_lost(store: FakeStore, tree: Tree) -> None:
    await tree.list(b"/fs/microsd")
    await trio.sleep(100)
    store.lost = True
    assert (await tree.stat(b"/fs/microsd/a.txt")).size == 5
    assert await tree.stat(b"/fs/microsd/a.txt") == Stat(FILE, 5, 1_700_000_000 * SECOND, 0.0)
    assert len(await tree.list(b"/fs/microsd")) == 2
    with pytest.raises(NotFound):
        await tree.stat(b"/fs/microsd/none")
    assert tree.negative_valid_for(b"/fs/microsd/none") == 0.0
    with pytest.raises(VehicleLost):
        await tree.list(b"/fs/microsd/log")
    store.lost = False
    tree.link_back()
    store.add(b"/fs/microsd/b.txt", b"")
    assert len(await tree.list(b"/fs/microsd")) == 3


async def test_forgetting_the_caches(store: FakeStore, tree: Tree) -> None:
    kept = await tree.open(b"/fs/microsd/a.txt")
    await kept.read(0, 5)
    await read_file(tree, b"/top")
    await tree.crc32(b"/top")
    tree.forget_caches()
    status = tree.status()
    assert (status["listings_cached"], status["entries_cached"], status["bytes_cached"]) == (0, 0, 5)
    await tree.crc32(b"/top")
    assert store.count("crc") == 2
    calls = len(store.calls)
    assert await kept.read(0, 5) == b"hello"
    assert len(store.calls) == calls


# --- the mount's root


async def test_a_subtree_is_mounted(store: FakeStore) -> None:
    tree = make_tree(store, root=b"/fs/microsd")
    assert {name for name, _ in await tree.list(b"/")} == {b"a.txt", b"log"}
    assert await read_file(tree, b"/a.txt") == b"hello"
    assert (await tree.stat(b"/log/2024-05-01")).kind is DIRECTORY
    assert await tree.stat(b"/") == Stat(DIRECTORY, 0, UNKNOWN_MTIME * SECOND, 1.0)
    with pytest.raises(NotFound):
        await tree.stat(b"/top")
    with pytest.raises(IsADirectory):
        await tree.open(b"/")
    assert store.count("list", b"/") == 1


async def test_the_kernel_hears_of_paths_below_the_mounts_root(store: FakeStore) -> None:
    tree = make_tree(store, root=b"/fs/microsd")
    await tree.stat(b"/a.txt")
    store.add(b"/fs/microsd/a.txt", b"hello again", 1_700_000_001)
    await tree.open(b"/a.txt")
    assert store.invalidated == [b"/a.txt"]


async def test_a_root_that_no_listing_shows_may_be_listed(store: FakeStore) -> None:
    store.unlisted.add(b"/fs")
    tree = make_tree(store, root=b"/fs/microsd")
    assert {name for name, _ in await tree.list(b"/")} == {b"a.txt", b"log"}
    store.remove(b"/fs")
    tree.rebooted()
    with pytest.raises(FtpNak):
        await tree.list(b"/")


@pytest.mark.parametrize("root", [b"/top", b"/top/deeper", b"/fs/microsd/a.txt"])
async def test_a_root_that_is_a_file_is_not_listed(store: FakeStore, root: bytes) -> None:
    tree = make_tree(store, root=root)
    with pytest.raises(NotADirectory):
        await tree.list(b"/")
    assert store.crimes == []


# --- SITL's root


async def test_dot_shows_what_root_hides(store: FakeStore, tree: Tree) -> None:
    store.add(b"/@SYS/tasks.txt", b"x")
    store.unlisted |= {b"/top"}
    store.dot = {b"top": store.files[b"/top"], b"fs": FakeFile(b"not this one")}
    stats = dict(await tree.list(b"/"))
    assert stats[b"top"].size == 1
    assert stats[b"fs"].kind is DIRECTORY
    assert await read_file(tree, b"/top") == b"t"
    assert store.count("list", b".") == 1
    await trio.sleep(21)
    await tree.stat(b"/top")
    assert store.count("list", b".") == 2


async def test_dot_is_asked_of_no_other_server(store: FakeStore, tree: Tree) -> None:
    store.remove(b"/top")
    await tree.list(b"/")
    store.add(b"/@SYS/x", b"x")
    store.add(b"/top", b"t")
    await trio.sleep(21)
    await tree.list(b"/")
    assert store.count("list", b".") == 0


# --- sizes that listings do not tell


async def test_an_unknown_size_is_learnt_by_opening(store: FakeStore, tree: Tree) -> None:
    store.files[b"/top"].has_size = False
    stats = dict(await tree.list(b"/"))
    assert stats[b"top"] == Stat(FILE, 0, UNKNOWN_MTIME * SECOND, 0.0)
    assert store.count("open") == 0
    assert await tree.stat(b"/top") == Stat(FILE, 1, UNKNOWN_MTIME * SECOND, 1.0)
    assert await tree.stat(b"/top") == Stat(FILE, 1, UNKNOWN_MTIME * SECOND, 1.0)
    assert dict(await tree.list(b"/"))[b"top"].size == 1
    assert store.count("open") == 1
    assert store.readers[0].closed
    assert await read_file(tree, b"/top") == b"t"


async def test_a_file_of_unknown_size_that_does_not_open_counts_as_empty(
    store: FakeStore, tree: Tree
) -> None:
    store.files[b"/top"].has_size = False
    store.fail["reader", b"/top"] = [FtpNak(Opcode.OPEN_FILE_RO, NakCode.FAIL)]
    assert (await tree.stat(b"/top")).size == 0
    assert (await tree.stat(b"/top")).size == 0
    assert store.count("reader") == 1


# --- checksums


@pytest.mark.parametrize(("mtime", "asked"), [(1_700_000_000, 2), (315_532_800, 4), (None, 4)])
async def test_a_checksum_is_kept_as_long_as_size_and_mtime(
    store: FakeStore, tree: Tree, mtime: int | None, asked: int
) -> None:
    """An mtime of a clock that was not set tells nothing."""
    path = b"/fs/microsd/a.txt"
    for number, content in enumerate((b"hello", b"olleh")):
        store.add(path, content, None if mtime is None else mtime + number)
        for _ in range(2):
            assert await tree.crc32(path) == crc32(content)
            await trio.sleep(30)
    assert store.count("crc") == asked


async def test_checksums_are_refused(store: FakeStore, tree: Tree) -> None:
    store.armed = True
    with pytest.raises(Armed):
        await tree.crc32(b"/top")
    with pytest.raises(IsADirectory):
        await tree.crc32(b"/fs")


# --- options and sharing


@pytest.mark.parametrize(
    "wrong",
    [
        {"dir_timeout": -1},
        {"cache_size": MIN_CACHE_SIZE - 1},
        {"root": b"/a/"},
        {"root": b"a"},
        {"attr_timeout": float("nan")},
    ],
)
def test_wrong_options(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        CacheOptions(**wrong)  # type: ignore[arg-type]


async def test_a_bug_in_shared_work_reaches_everyone_and_nothing_stays() -> None:
    flights: SingleFlight[int, int] = SingleFlight()

    async def work() -> int:
        await trio.sleep(1)
        raise ZeroDivisionError

    caught = []

    async def ask() -> None:
        try:
            await flights.run(1, work)
        except ZeroDivisionError as error:
            caught.append(error)

    async with trio.open_nursery() as askers:
        askers.start_soon(ask)
        askers.start_soon(ask)
    assert len(caught) == 2
    assert len(flights) == 0


async def test_who_came_later_gets_no_time_out_of_who_was_there() -> None:
    """He waited a moment, and the vehicle may be back."""
    flights: SingleFlight[str, int] = SingleFlight()
    begun: list[float] = []

    async def work() -> int:
        begun.append(trio.current_time())
        await trio.sleep(30)
        if len(begun) == 1:
            raise RequestTimeout("silence")
        return 1

    async with trio.open_nursery() as nursery:
        nursery.start_soon(times_out, flights, work)
        await trio.sleep(29)
        assert await flights.run("key", work) == 1
    assert begun == [0, 30]


async def times_out(flights: SingleFlight[str, int], work: Callable[[], Awaitable[int]]) -> None:
    with pytest.raises(RequestTimeout):
        await flights.run("key", work)
