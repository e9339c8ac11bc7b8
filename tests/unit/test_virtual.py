"""The `@` trees: what appears where, true sizes, snapshots, and how much traffic servers without them see."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.shared.errors import (
    DataUnproven,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    ReadOnly,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.pseudo import VirtualTrees
from tests.support.replies import request
from tests.support.rigs import Rig, card, read_file, rig

LIE = 100_000
PARAM = b"/@PARAM/param.pck"
UARTS = b"/@SYS/uarts.txt"
SYS = {b"uarts.txt": b"SERIAL0 on", b"tasks.txt": b"TasksV2\n", b"storage.bin": b"s" * 16384}
TEXTS = {b"params.parm", b"changed.parm", b"params.params", b"last_error.txt"}
OPEN, READ = Opcode.OPEN_FILE_RO, Opcode.READ_FILE


def trees(here: Rig) -> VirtualTrees:
    """Return what the simulated vehicle has below `@`."""
    return here.server._storage.virtual


def fill(here: Rig) -> None:
    trees(here).sys_files = dict(SYS)
    trees(here).romfs = {b"defaults.parm": b"d" * 50}


@pytest.fixture
async def here() -> AsyncIterator[Rig]:
    """ArduPilot."""
    async with rig("ardupilot5", {b"/APM/logs/1.BIN": b"log"}) as made:
        fill(made)
        yield made


px4 = card({b"/fs/a": b"a"})
nuttx = card({b"/fs/a": b"a"}, profiles=("px4-nuttx",))
px4_2026 = card({b"/fs/a": b"a"}, profiles=("px4-2026",))


@pytest.fixture
def tree(here: Rig) -> Tree:
    return here.mount()


async def names(tree: Tree, path: bytes) -> set[bytes]:
    return {name for name, _ in await tree.list(path)}


# --- what appears


async def test_unlistable_trees_appear_beside_announced_ones(tree: Tree) -> None:
    assert await names(tree, b"/") == {b"APM", b"@SYS", b"@ROMFS", b"@PARAM", b"@MISSION"}
    assert await names(tree, b"/@PARAM") == {b"param.pck", *TEXTS}
    missions = {b"mission", b"fence", b"rally"}
    packed, texts = {name + b".dat" for name in missions}, {name + b".waypoints" for name in missions}
    assert await names(tree, b"/@MISSION") == packed | texts | {b"last_error.txt"}
    assert (await tree.stat(b"/@PARAM")).kind is EntryKind.DIRECTORY
    assert (await tree.stat(b"/@PARAM")).valid_for == 1.0
    assert dict(await tree.list(b"/"))[b"@MISSION"].kind is EntryKind.DIRECTORY


async def test_a_server_without_trees_sees_one_probe(px4: Rig) -> None:
    tree = px4.mount()
    assert await names(tree, b"/") == {b"fs"}
    for path in (b"/@MISSION", b"/@MISSION/mission.dat", b"/@PARAM", PARAM, b"/@PARAM/x", b"/@SYS", UARTS):
        with pytest.raises(NotFound):
            await tree.stat(path)
    with pytest.raises(NotFound):
        await tree.list(b"/@PARAM")
    with pytest.raises(NotFound):
        await tree.open(PARAM)
    assert px4.count(OPEN) == 1
    assert tree.negative_valid_for(b"/@PARAM") == 2.0
    px4.put(PARAM, b"new firmware")
    await px4.reboot()
    assert (await tree.stat(PARAM)).size == 12


async def test_beside_another_client_a_server_is_probed_only_if_somebody_asks(px4_2026: Rig) -> None:
    px4_2026.connection.scheduler.server.others.heard_at = trio.current_time()
    tree = px4_2026.mount()
    assert await names(tree, b"/") == {b"fs"}
    assert px4_2026.count(OPEN) == 0
    assert (await tree.stat(b"/@PARAM")).kind is EntryKind.DIRECTORY
    assert px4_2026.count(OPEN) == 1
    assert await names(tree, b"/") == {b"fs", b"@PARAM"}


async def test_the_probe_waits_for_no_session_that_a_killed_program_left(nuttx: Rig) -> None:
    """The end of such a session takes ten seconds of silence, for which only an open should wait."""
    nuttx.faults.lose_reply_to(OPEN)
    left = request(1, OPEN, data=b"/fs/microsd/fs/a").encode()
    nuttx.server.handle(left, Address(254, 25), trio.current_time())
    tree, began = nuttx.mount(root=b"/"), trio.current_time()
    assert await names(tree, b"/") == {b"fs"}
    assert trio.current_time() - began < 4.0
    await trio.sleep(1.0)
    asked, began = nuttx.count(OPEN), trio.current_time()
    assert await names(tree, b"/fs") == {b"microsd"}
    assert trio.current_time() - began < 1.0
    assert await names(tree, b"/") == {b"fs"}
    assert nuttx.count(OPEN) == asked
    assert await read_file(tree, b"/fs/microsd/fs/a") == b"a"


async def test_parameters_that_open_make_their_directory_appear(px4_2026: Rig) -> None:
    """Unless the probe got no answer, which is none."""
    tree = px4_2026.mount()
    await px4_2026.lose()
    with pytest.raises((RequestTimeout, VehicleLost)):
        await tree.stat(b"/@PARAM")
    await px4_2026.find()
    assert (await tree.stat(b"/@PARAM")).kind is EntryKind.DIRECTORY
    assert await names(tree, b"/") == {b"fs", b"@PARAM"}
    assert await names(tree, b"/@PARAM") == {b"param.pck", *TEXTS}
    with pytest.raises(NotFound):
        await tree.list(b"/@MISSION")
    packed = trees(px4_2026).content(b"@PARAM/param.pck", 239)
    assert (await tree.stat(PARAM)).size == len(packed)
    assert await read_file(tree, PARAM) == packed


# --- true sizes


async def test_stat_open_and_read_agree(here: Rig, tree: Tree) -> None:
    stat = await tree.stat(UARTS)
    assert (stat.size, stat.valid_for) == (10, 1.0)
    trees(here).sys_files[b"uarts.txt"] = b"meanwhile it became longer"
    handle = await tree.open(UARTS)
    assert (handle.size, handle.direct_io, handle.keep_cache) == (10, True, False)
    assert await handle.read(0, 4096) == b"SERIAL0 on"
    assert await handle.read(8, 4096) == b"on"
    assert await handle.read(10, 4096) == b""
    assert await tree.crc32(UARTS) == crc32(SYS[b"uarts.txt"]), "that of what a reader gets"
    assert here.count(OPEN) == 1
    assert here.count(Opcode.CALC_FILE_CRC32) == 0
    handle.close()
    handle.close()
    with pytest.raises(LocalProtocolError):
        await handle.read(0, 1)


async def test_a_snapshot_lasts_dir_timeout(here: Rig, tree: Tree) -> None:
    await tree.stat(UARTS)
    await trio.sleep(19.5)
    assert (await tree.stat(UARTS)).valid_for == pytest.approx(0.5, abs=0.2)
    await trio.sleep(0.7)
    trees(here).sys_files[b"uarts.txt"] = b"longer than before"
    handle = await tree.open(UARTS)
    assert here.invalidated == [UARTS]
    assert (handle.size, (await tree.stat(UARTS)).size) == (18, 18)
    await trio.sleep(21)
    await tree.open(UARTS)
    assert here.count(OPEN) == 3
    assert await handle.read(0, 99) == b"longer than before"


async def test_romfs_is_an_ordinary_tree(here: Rig, tree: Tree) -> None:
    path = b"/@ROMFS/defaults.parm"
    assert dict(await tree.list(b"/@ROMFS"))[b"defaults.parm"] == await tree.stat(path)
    assert (await tree.stat(path)).size == 50
    assert (await tree.stat(path)).valid_for == 1.0
    assert here.count(OPEN) == 0
    assert await read_file(tree, path) == b"d" * 50
    with pytest.raises(ReadOnly):
        await tree.open(path, write=True)


async def test_the_log_alias_is_read_by_blocks_where_it_is_the_root(here: Rig) -> None:
    here.put(b"/@MAV_LOG/1.BIN", b"log" * 1000)
    tree = here.mount(root=b"/@MAV_LOG")
    assert await names(tree, b"/") == {b"1.BIN"}
    handle = await tree.open(b"/1.BIN")
    assert (await handle.read(0, 10), handle.direct_io) == (b"loglogloglo"[:10], False)
    handle.close()
    assert await tree.crc32(b"/1.BIN") == crc32(b"log" * 1000)  # they are real
    assert here.count(Opcode.CALC_FILE_CRC32) == 1


async def test_a_large_file_is_not_read_to_answer_stat(here: Rig, tree: Tree) -> None:
    trees(here).sys_files[b"storage.bin"] = b"c" * 200_000
    path = b"/@SYS/storage.bin"
    assert b"storage.bin" in await names(tree, b"/@SYS")
    assert (await tree.stat(path)).size == 200_000
    assert here.count(OPEN) == 2, "the others"
    assert len(await read_file(tree, path)) == 200_000


# --- odd names


async def test_absent_names_are_remembered_for_a_while(here: Rig, tree: Tree) -> None:
    for asked in (1, 2):
        for _ in range(2):
            with pytest.raises(NotFound):
                await tree.stat(b"/@PARAM/none")
        assert here.count(OPEN) == asked
        assert tree.negative_valid_for(b"/@PARAM/none") == 2.0
        await trio.sleep(21)


async def test_names_that_cannot_be_cost_nothing(here: Rig, tree: Tree) -> None:
    for path in (b"/@PARAM/.hidden", b"/@PARAM/param.pck/x", b"/@MISSION/.Trash-1000", b"/@SYS/none"):
        with pytest.raises(NotFound):
            await tree.stat(path)
    for path in (PARAM, UARTS):
        with pytest.raises(NotADirectory):
            await tree.list(path)
    for path in (b"/@SYS", b"/@PARAM"):
        with pytest.raises(IsADirectory):
            await tree.open(path)
    assert here.count(OPEN) == 0


# --- files that are listed but do not open


async def test_what_is_listed_but_not_found_is_hidden(here: Rig, tree: Tree) -> None:
    trees(here).sys_files[b"uarts.txt"] = b""  # so the vehicle does not open it
    for _ in range(2):
        assert await names(tree, b"/@SYS") == {b"tasks.txt", b"storage.bin"}
        with pytest.raises(NotFound):
            await tree.stat(UARTS)
        with pytest.raises(NotFound):
            await tree.open(UARTS)
        assert tree.negative_valid_for(UARTS) == 2.0
        assert here.count(OPEN) == 3
        await trio.sleep(1000)
    await here.reboot()
    trees(here).sys_files[b"uarts.txt"] = b"SERIAL0 on"
    assert b"uarts.txt" in await names(tree, b"/@SYS")


@pytest.mark.parametrize(("limit", "error"), [(5, DataUnproven), (1 << 20, FtpNak)])
async def test_what_cannot_be_read_is_an_error_to_open_but_is_shown(
    here: Rig, limit: int, error: type[Exception]
) -> None:
    """The file is too long, or the vehicle refuses it."""
    if error is FtpNak:
        here.faults.refuse(OPEN, NakCode.FAIL, times=99)
    tree = here.mount(at_file_limit=limit)
    stat = await tree.stat(UARTS)
    assert (stat.size, stat.valid_for) == (LIE, 0.0)
    with pytest.raises(error):
        await tree.open(UARTS)
    listed = dict(await tree.list(b"/@SYS"))[b"uarts.txt"]
    assert (listed.size, listed.valid_for) == (LIE, 0.0)


# --- slow and lost links


async def test_on_a_radio_listing_does_not_wait_for_all_files() -> None:
    """The one that is being read when the time is over goes on."""
    async with rig("ardupilot5", link=LinkSettings(delay=0.3)) as here:
        fill(here)
        tree = here.mount()
        await tree.stat(b"/@SYS")
        began = trio.current_time()
        first = dict(await tree.list(b"/@SYS"))
        assert 3 < trio.current_time() - began < 6
        sizes = {name: stat.size for name, stat in first.items()}
        assert sizes == {b"uarts.txt": 10, b"tasks.txt": LIE, b"storage.bin": 16384}
        assert first[b"tasks.txt"].valid_for == 0.0
        await trio.sleep(10)
        opened = here.count(OPEN)
        assert dict(await tree.list(b"/@SYS"))[b"tasks.txt"].size == 8
        assert here.count(OPEN) <= opened + 1  # of the file that nobody had begun to read


async def test_a_bad_link_ends_the_probing(here: Rig, tree: Tree) -> None:
    tree = here.mount(probe_time=1000.0)
    await names(tree, b"/")
    here.faults.ignore(OPEN)
    began = trio.current_time()
    assert dict(await tree.list(b"/@SYS"))[b"uarts.txt"].size == LIE
    assert trio.current_time() - began < 40.0  # one file's time


async def test_while_lost_the_last_size_is_shown_and_opens_fail(here: Rig, tree: Tree) -> None:
    await tree.stat(UARTS)
    await here.lose()
    await trio.sleep(100)
    stat = await tree.stat(UARTS)
    assert (stat.size, stat.valid_for) == (10, 0.0)
    for path in (UARTS, PARAM):
        with pytest.raises(VehicleLost):
            await tree.open(path)


# --- the memory of snapshots


async def test_snapshots_stay_within_their_budget(here: Rig) -> None:
    tree = here.mount(at_cache_size=100)
    trees(here).sys_files = {b"big": b"z" * 101} | {b"%d" % number: b"x" * 40 for number in range(5)}
    for number in range(5):
        await read_file(tree, b"/@SYS/%d" % number)
    assert tree.status()["bytes_cached"] == 80
    assert await read_file(tree, b"/@SYS/big") == b"z" * 101
    assert tree.status()["bytes_cached"] == 0
    asked = here.count(OPEN)
    assert (await tree.stat(b"/@SYS/4")).size == 40
    assert here.count(OPEN) == asked + 1
