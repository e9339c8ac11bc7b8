"""The `@` trees: what appears where, true sizes, snapshots, and how much traffic servers without them see."""

from __future__ import annotations

import pytest
import trio
import trio.testing

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.shared.errors import (
    DataUnproven,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from tests.support.fake_store import FakeStore, make_tree, read_file

LIE = 100_000
PARAM = b"/@PARAM/param.pck"
UARTS = b"/@SYS/uarts.txt"


def hide_unlistable(store: FakeStore) -> FakeStore:
    store.unlisted |= {b"/@PARAM", b"/@MISSION"}
    return store


@pytest.fixture
def store(nursery: trio.Nursery) -> FakeStore:
    """ArduPilot."""
    store = hide_unlistable(FakeStore(nursery))
    store.add(b"/APM/logs/1.BIN", b"log")
    store.add(UARTS, b"SERIAL0 on", claims=LIE)
    store.add(b"/@SYS/tasks.txt", b"TasksV2\n", claims=LIE)
    store.add(b"/@SYS/storage.bin", b"s" * 16384)
    store.add(b"/@ROMFS/defaults.parm", b"d" * 50)
    store.add(PARAM, b"p" * 14882)
    for name in (b"mission", b"fence", b"rally"):
        store.add(b"/@MISSION/" + name + b".dat", b"m" * 20)
    return store


@pytest.fixture
def px4(nursery: trio.Nursery) -> FakeStore:
    """A server that announces nothing."""
    store = hide_unlistable(FakeStore(nursery))
    store.add(b"/fs/a", b"a")
    return store


@pytest.fixture
def tree(store: FakeStore) -> Tree:
    return make_tree(store)


async def names(tree: Tree, path: bytes) -> set[bytes]:
    return {name for name, _ in await tree.list(path)}


def refuse(store: FakeStore, path: bytes, code: int = NakCode.FILE_NOT_FOUND, times: int = 99) -> None:
    store.fail["whole", path] = [FtpNak(Opcode.OPEN_FILE_RO, code)] * times


# --- what appears


async def test_unlistable_trees_appear_beside_announced_ones(tree: Tree) -> None:
    assert await names(tree, b"/") == {b"APM", b"@SYS", b"@ROMFS", b"@PARAM", b"@MISSION"}
    assert await names(tree, b"/@PARAM") == {b"param.pck"}
    assert await names(tree, b"/@MISSION") == {b"mission.dat", b"fence.dat", b"rally.dat"}
    assert (await tree.stat(b"/@PARAM")).kind is EntryKind.DIRECTORY
    assert (await tree.stat(b"/@PARAM")).valid_for == 1.0
    assert dict(await tree.list(b"/"))[b"@MISSION"].kind is EntryKind.DIRECTORY


async def test_a_server_without_trees_sees_one_probe_and_only_if_somebody_asks(px4: FakeStore) -> None:
    tree = make_tree(px4)
    assert await names(tree, b"/") == {b"fs"}
    assert px4.calls == [("list", b"/")]
    for path in (b"/@MISSION", b"/@MISSION/mission.dat", b"/@PARAM", PARAM, b"/@PARAM/x", b"/@SYS", UARTS):
        with pytest.raises(NotFound):
            await tree.stat(path)
    with pytest.raises(NotFound):
        await tree.list(b"/@PARAM")
    with pytest.raises(NotFound):
        await tree.open(PARAM)
    assert px4.calls == [("list", b"/"), ("whole", PARAM)]
    assert tree.negative_valid_for(b"/@PARAM") == 2.0
    px4.add(PARAM, b"new firmware")
    tree.rebooted()
    assert (await tree.stat(PARAM)).size == 12


async def test_param_that_opens_makes_the_trees_appear(px4: FakeStore) -> None:
    px4.add(PARAM, b"p" * 99)
    tree = make_tree(px4)
    assert await names(tree, b"/") == {b"fs"}
    assert (await tree.stat(b"/@PARAM")).kind is EntryKind.DIRECTORY
    assert await names(tree, b"/") == {b"fs", b"@PARAM", b"@MISSION"}
    assert await names(tree, b"/@PARAM") == {b"param.pck"}
    assert await names(tree, b"/@MISSION") == set()
    assert px4.count("whole", PARAM) == 1


async def test_a_probe_that_got_no_answer_is_no_answer(px4: FakeStore) -> None:
    px4.add(PARAM, b"p" * 99)
    px4.fail["whole", PARAM] = [RequestTimeout("silence")]
    tree = make_tree(px4)
    with pytest.raises(RequestTimeout):
        await tree.stat(b"/@PARAM")
    assert (await tree.stat(PARAM)).size == 99


# --- true sizes


async def test_stat_open_and_read_agree(store: FakeStore, tree: Tree) -> None:
    stat = await tree.stat(UARTS)
    assert (stat.size, stat.valid_for) == (10, 1.0)
    store.files[UARTS].data = b"meanwhile it became longer"
    handle = await tree.open(UARTS)
    assert (handle.size, handle.direct_io, handle.keep_cache) == (10, True, False)
    assert await handle.read(0, 4096) == b"SERIAL0 on"
    assert await handle.read(8, 4096) == b"on"
    assert await handle.read(10, 4096) == b""
    assert store.count("whole", UARTS) == 1
    handle.close()
    handle.close()
    with pytest.raises(LocalProtocolError):
        await handle.read(0, 1)


async def test_a_snapshot_lasts_dir_timeout(store: FakeStore, tree: Tree) -> None:
    await tree.stat(UARTS)
    await trio.sleep(19.9)
    assert (await tree.stat(UARTS)).valid_for == pytest.approx(0.1)
    await trio.sleep(0.2)
    store.files[UARTS].data = b"longer than before"
    handle = await tree.open(UARTS)
    assert store.invalidated == [UARTS]
    assert (handle.size, (await tree.stat(UARTS)).size) == (18, 18)
    await trio.sleep(21)
    await tree.open(UARTS)
    assert store.count("whole", UARTS) == 3
    assert await handle.read(0, 99) == b"longer than before"


async def test_romfs_is_an_ordinary_tree_read_whole(store: FakeStore, tree: Tree) -> None:
    path = b"/@ROMFS/defaults.parm"
    assert dict(await tree.list(b"/@ROMFS"))[b"defaults.parm"] == await tree.stat(path)
    assert (await tree.stat(path)).size == 50
    assert (await tree.stat(path)).valid_for == 1.0
    assert store.count("whole") == 0
    handle = await tree.open(path)
    assert handle.direct_io
    assert await handle.read(0, 99) == b"d" * 50
    assert store.count("reader") == 0


async def test_the_log_alias_is_read_by_blocks_where_it_is_the_root(store: FakeStore) -> None:
    store.add(b"/@MAV_LOG/1.BIN", b"log" * 1000)
    store.unlisted.add(b"/@MAV_LOG")
    tree = make_tree(store, root=b"/@MAV_LOG")
    assert await names(tree, b"/") == {b"1.BIN"}
    assert await read_file(tree, b"/1.BIN") == b"log" * 1000
    assert await tree.crc32(b"/1.BIN") == crc32(b"log" * 1000)  # they are real
    assert store.count("whole") == 0


async def test_a_large_file_is_not_read_to_answer_stat(store: FakeStore, tree: Tree) -> None:
    store.add(b"/@SYS/crash_dump.bin", b"c" * 200_000)
    assert b"crash_dump.bin" in await names(tree, b"/@SYS")
    assert (await tree.stat(b"/@SYS/crash_dump.bin")).size == 200_000
    assert store.count("whole", b"/@SYS/crash_dump.bin") == 0
    assert len(await read_file(tree, b"/@SYS/crash_dump.bin")) == 200_000


async def test_a_file_beyond_the_limit_is_an_error_to_open_but_not_to_stat(store: FakeStore) -> None:
    tree = make_tree(store, at_file_limit=5)
    stat = await tree.stat(UARTS)
    assert (stat.size, stat.valid_for) == (LIE, 0.0)
    with pytest.raises(DataUnproven):
        await tree.open(UARTS)
    assert b"uarts.txt" in await names(tree, b"/@SYS")


async def test_checksum_of_what_a_reader_gets(store: FakeStore, tree: Tree) -> None:
    assert await tree.crc32(PARAM) == crc32(b"p" * 14882)
    assert store.count("crc") == 0


# --- queries and odd names


async def test_absent_names_are_remembered_for_a_while(store: FakeStore, tree: Tree) -> None:
    for _ in range(2):
        with pytest.raises(NotFound):
            await tree.stat(b"/@PARAM/none")
    assert store.count("whole") == 1
    assert tree.negative_valid_for(b"/@PARAM/none") == 2.0
    await trio.sleep(21)
    store.add(b"/@PARAM/none", b"now")
    assert (await tree.stat(b"/@PARAM/none")).size == 3


async def test_names_that_cannot_be_cost_nothing(store: FakeStore, tree: Tree) -> None:
    for path in (b"/@PARAM/.hidden", b"/@PARAM/param.pck/x", b"/@MISSION/.Trash-1000"):
        with pytest.raises(NotFound):
            await tree.stat(path)
    with pytest.raises(NotADirectory):
        await tree.list(PARAM)
    with pytest.raises(NotADirectory):
        await tree.list(UARTS)
    with pytest.raises(IsADirectory):
        await tree.open(b"/@SYS")
    with pytest.raises(IsADirectory):
        await tree.open(b"/@PARAM")
    with pytest.raises(NotFound):
        await tree.stat(b"/@SYS/none")
    assert store.count("whole") == 0
    assert store.crimes == []


# --- files that are listed but do not open


async def test_what_is_listed_but_not_found_is_hidden(store: FakeStore, tree: Tree) -> None:
    refuse(store, UARTS)
    assert await names(tree, b"/@SYS") == {b"tasks.txt", b"storage.bin"}
    with pytest.raises(NotFound):
        await tree.stat(UARTS)
    with pytest.raises(NotFound):
        await tree.open(UARTS)
    assert tree.negative_valid_for(UARTS) == 2.0
    await trio.sleep(1000)
    assert await names(tree, b"/@SYS") == {b"tasks.txt", b"storage.bin"}
    assert store.count("whole", UARTS) == 1
    tree.rebooted()
    store.fail.clear()
    assert b"uarts.txt" in await names(tree, b"/@SYS")


async def test_other_refusals_do_not_hide(store: FakeStore, tree: Tree) -> None:
    refuse(store, UARTS, NakCode.FAIL)
    listed = dict(await tree.list(b"/@SYS"))[b"uarts.txt"]
    assert (listed.size, listed.valid_for) == (LIE, 0.0)
    assert b"uarts.txt" in await names(tree, b"/@SYS")
    assert (await tree.stat(UARTS)).size == LIE
    with pytest.raises(FtpNak):
        await tree.open(UARTS)


# --- slow and lost links


async def test_on_a_radio_listing_does_not_wait_for_all_files(
    store: FakeStore, nursery: trio.Nursery
) -> None:
    tree = make_tree(store, nursery=nursery)
    store.whole_delay = 2
    began = trio.current_time()
    first = dict(await tree.list(b"/@SYS"))
    assert trio.current_time() - began == pytest.approx(3)
    assert {name: stat.size for name, stat in first.items()} == {
        b"uarts.txt": 10,
        b"tasks.txt": LIE,
        b"storage.bin": 16384,
    }
    assert first[b"tasks.txt"].valid_for == 0.0
    await trio.sleep(10)
    second = dict(await tree.list(b"/@SYS"))
    assert second[b"tasks.txt"].size == 8
    assert (await tree.stat(b"/@SYS/tasks.txt")).size == 8


@pytest.mark.parametrize("error", [VehicleLost("gone"), RequestTimeout("silence")])
async def test_a_bad_link_ends_the_probing(store: FakeStore, tree: Tree, error: Exception) -> None:
    await tree.stat(b"/@SYS")
    store.fail["whole", UARTS] = [error]
    listed = dict(await tree.list(b"/@SYS"))
    assert listed[b"uarts.txt"].size == LIE
    assert store.count("whole") == 1
    assert dict(await tree.list(b"/@SYS"))[b"uarts.txt"].size == 10


async def test_while_lost_the_last_size_is_shown_and_opens_fail(store: FakeStore, tree: Tree) -> None:
    await tree.stat(UARTS)
    await trio.sleep(100)
    store.lost = True
    assert (await tree.stat(UARTS)).size == 10
    tree.link_lost()
    assert (await tree.stat(UARTS)).valid_for == 0.0
    with pytest.raises(VehicleLost):
        await tree.open(UARTS)
    with pytest.raises(VehicleLost):
        await tree.open(PARAM)


# --- the memory of snapshots


async def test_snapshots_stay_within_their_budget(store: FakeStore) -> None:
    tree = make_tree(store, at_cache_size=100)
    store.add(b"/@SYS/big", b"z" * 101)
    for i in range(5):
        store.add(b"/@SYS/%d" % i, b"x" * 40)
    for i in range(5):
        await read_file(tree, b"/@SYS/%d" % i)
    assert tree.status()["bytes_cached"] == 80
    assert await read_file(tree, b"/@SYS/big") == b"z" * 101
    assert tree.status()["bytes_cached"] == 0
    asked = store.count("whole")
    assert (await tree.stat(b"/@SYS/4")).size == 40
    assert store.count("whole") == asked + 1
