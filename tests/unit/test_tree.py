"""The facade: walking, sharing sweeps, stale listings, the mount's root, sizes, checksums, news."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import replace
from random import Random

import pytest
import trio

from mavftpfs.cache.attributes import SECOND, UNKNOWN_MTIME
from mavftpfs.cache.directories import SWEEP_TRIES
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.cache.temporary import Kind, TemporaryName, new_owner
from mavftpfs.cache.tree import Stat, Tree
from mavftpfs.protocol.payload import Opcode, Payload, crc32
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    PathTooLong,
    ReadOnly,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.rigs import Rig, card, read_file, rig

FILE, DIRECTORY = EntryKind.FILE, EntryKind.DIRECTORY
OPEN, CRC = Opcode.OPEN_FILE_RO, Opcode.CALC_FILE_CRC32
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
A = b"/fs/microsd/a.txt"
MTIME = 1_700_000_000
FILES = {A: b"hello", b"/fs/microsd/log/2024-05-01/12_34_56.ulg": b"u" * 10, b"/top": b"t"}


@pytest.fixture
async def here() -> AsyncIterator[Rig]:
    """A server whose listings tell times."""
    async with rig("mavsdk", FILES) as made:
        made.put(A, b"hello", MTIME)
        yield made


px4 = card(FILES)


@pytest.fixture
def tree(here: Rig) -> Tree:
    return here.mount()


def listings(tree: Tree) -> int:
    """Return how many listings were asked for so far."""
    return int(str(tree.status()["listings_asked"]))


def hide(here: Rig, line: bytes) -> None:
    """Have listings leave a line out."""

    def change(request: Payload, reply: Payload) -> list[Payload]:
        data = reply.data.replace(line, b"") if request.opcode in LISTS else reply.data
        return [reply._replace(data=data, size=len(data))]

    here.server.change = change


def listed(here: Rig) -> list[bytes]:
    """Return which directories are listed from now on."""
    found: list[bytes] = []

    def note(request: Payload) -> None:
        if request.opcode in LISTS and request.offset == 0:
            found.append(request.data.rstrip(b"\0"))

    here.server.answer = note
    return found


# --- walking


@pytest.mark.holds("promise 4")
async def test_stat_walks_from_the_root_and_then_costs_nothing(here: Rig, tree: Tree) -> None:
    asked = listed(here)
    assert await tree.stat(A) == Stat(FILE, 5, MTIME * SECOND, 1.0)
    assert asked == [b"/", b"/fs", b"/fs/microsd"]
    assert (await tree.stat(b"/fs/microsd/log")).kind is DIRECTORY
    assert (await tree.stat(b"/fs")).valid_for == 1.0
    assert len(asked) == 3


async def test_absence_by_a_fresh_listing_costs_nothing(tree: Tree) -> None:
    for path in (b"/none", b"/none/deeper"):
        with pytest.raises(NotFound):
            await tree.stat(path)
    assert listings(tree) == 1
    assert tree.negative_valid_for(b"/none") == 2.0
    await trio.sleep(19)
    assert tree.negative_valid_for(b"/none") == pytest.approx(1.0, abs=0.1)
    await trio.sleep(2)
    assert tree.negative_valid_for(b"/none") == 0.0
    assert tree.negative_valid_for(b"/unknown/none") == 0.0


@pytest.mark.parametrize("dir_timeout", [0.0, 0.5])
async def test_the_kernel_believes_nothing_longer_than_a_listing(here: Rig, dir_timeout: float) -> None:
    tree = here.mount(dir_timeout=dir_timeout)
    file = await tree.create(b"/fs/microsd/new", exclusive=True)
    for path in (b"/", A, b"/fs/microsd/new"):
        assert (await tree.stat(path)).valid_for <= dir_timeout
    assert tree.negative_valid_for(b"/none") <= dir_timeout
    file.close()


@pytest.mark.holds("promise 6", "rule 14.30")
async def test_a_file_is_never_listed(here: Rig, tree: Tree) -> None:
    asked = listed(here)
    for path in (b"/top/x", b"/top/x/y", A + b"/b"):
        with pytest.raises(NotADirectory):
            await tree.stat(path)
    with pytest.raises(NotADirectory):
        await tree.list(b"/top")
    assert not {b"/top", A} & set(asked)


async def test_a_refused_directory_is_looked_for_again(px4: Rig) -> None:
    tree = px4.mount()
    await tree.stat(b"/fs/microsd")
    px4.card.rename(b"/fs/microsd", b"/elsewhere")
    with pytest.raises(FtpNak):
        await tree.list(b"/fs/microsd")
    asked = listed(px4)
    with pytest.raises(NotFound):
        await tree.list(b"/fs/microsd")
    assert asked == [b"/fs"]


async def test_hostile_paths(here: Rig, tree: Tree) -> None:
    with pytest.raises(LocalProtocolError):
        await tree.stat(b"/fs/../etc")
    with pytest.raises(PathTooLong):
        await tree.stat(b"/x" * 1000)
    assert here.faults.requests == []
    assert (await tree.stat(b"//fs/./microsd/")).kind is DIRECTORY


@pytest.mark.holds("rule 14.33")
async def test_a_name_too_long_to_be_asked_for_is_still_shown(here: Rig, tree: Tree) -> None:
    path = b"/fs/microsd/" + b"n" * 190
    here.put(path, b"x")
    assert (await tree.stat(path)).size == 1
    with pytest.raises(PathTooLong):
        await tree.open(path)


async def test_attributes_are_valid_no_longer_than_the_listing(tree: Tree) -> None:
    await tree.stat(b"/top")
    await trio.sleep(19.5)
    assert (await tree.stat(b"/top")).valid_for == pytest.approx(0.5, abs=0.1)


# --- sweeps


async def test_requests_for_one_listing_share_a_sweep() -> None:
    async with rig(files=FILES, link=LinkSettings(delay=0.5)) as here, trio.open_nursery() as askers:
        tree = here.mount()
        for _ in range(5):
            askers.start_soon(tree.list, b"/")
            askers.start_soon(tree.stat, b"/top")
    assert listings(tree) == 1


async def test_a_cancelled_sweep_goes_on_for_the_next_caller() -> None:
    async with rig(files=FILES, link=LinkSettings(delay=3.0)) as here:
        tree = here.mount()
        with trio.move_on_after(5):
            await tree.list(b"/")
        assert len(await tree.list(b"/")) == 2
        assert listings(tree) == 1


async def test_a_listing_that_is_always_raced_is_given_up_on(here: Rig, tree: Tree) -> None:
    here.server.answer = lambda request: tree._card.directories.put(b"/never", None)
    assert b"top" in dict(await tree.list(b"/"))
    assert listings(tree) == SWEEP_TRIES
    assert tree.negative_valid_for(b"/none") == 0.0


async def test_a_tree_that_is_only_read_shows_what_others_left(here: Rig) -> None:
    """Names like those of temporary files, too: there may be nothing else left of a file."""
    tree = here.mount(read_only=True)
    left = TemporaryName(new_owner(Random(1)), Kind.NEW, b"sss", b"a.txt").name
    for name in (left, b".a.txt.swp"):
        here.put(b"/fs/microsd/" + name, b"left")
        assert await read_file(tree, b"/fs/microsd/" + name) == b"left"
        tree.forget_caches()
    assert {left, b".a.txt.swp"} < set(dict(await tree.list(b"/fs/microsd")))
    with pytest.raises(ReadOnly):
        await tree.unlink(b"/fs/microsd/" + left)


# --- the vehicle is out of reach


@pytest.mark.holds("promise 4")
async def test_expired_listings_are_served_while_the_vehicle_is_lost(here: Rig, tree: Tree) -> None:
    await tree.list(b"/fs/microsd")
    await here.lose()
    await trio.sleep(100)
    asked = len(here.faults.requests)
    assert await tree.stat(A) == Stat(FILE, 5, MTIME * SECOND, 1.0)
    assert len(await tree.list(b"/fs/microsd")) == 2
    with pytest.raises(NotFound):
        await tree.stat(b"/fs/microsd/none")
    assert tree.negative_valid_for(b"/fs/microsd/none") == 2.0
    assert len(here.faults.requests) == asked
    with pytest.raises(VehicleLost):
        await tree.list(b"/fs/microsd/log")
    await here.find()
    here.put(b"/fs/microsd/b.txt", b"")
    assert len(await tree.list(b"/fs/microsd")) == 3


async def test_forgetting_the_caches(here: Rig, tree: Tree) -> None:
    kept = await tree.open(A)
    await kept.read(0, 5)
    await read_file(tree, b"/top")
    await tree.crc32(b"/top")
    tree.forget_caches()
    assert (tree._card.directories.entry_count, tree.status()["bytes_cached"]) == (0, 5)
    await tree.crc32(b"/top")
    assert here.count(CRC) == 2
    asked = here.count(OPEN, Opcode.READ_FILE)
    assert await kept.read(0, 5) == b"hello"
    assert here.count(OPEN, Opcode.READ_FILE) == asked


# --- the mount's root


async def test_a_subtree_is_mounted(here: Rig) -> None:
    tree = here.mount(root=b"/fs/microsd")
    assert {name for name, _ in await tree.list(b"/")} == {b"a.txt", b"log"}
    assert await read_file(tree, b"/a.txt") == b"hello"
    assert (await tree.stat(b"/log/2024-05-01")).kind is DIRECTORY
    assert await tree.stat(b"/") == Stat(DIRECTORY, 0, UNKNOWN_MTIME * SECOND, 1.0)
    with pytest.raises(NotFound):
        await tree.stat(b"/top")
    with pytest.raises(IsADirectory):
        await tree.open(b"/")


async def test_the_kernel_hears_of_paths_below_the_mounts_root(here: Rig) -> None:
    tree = here.mount(root=b"/fs/microsd")
    await tree.stat(b"/a.txt")
    here.put(A, b"hello again", MTIME + 1)
    await tree.open(b"/a.txt")
    assert here.invalidated == [b"/a.txt"]


async def test_a_root_that_no_listing_shows_may_be_listed(px4: Rig) -> None:
    hide(px4, b"Dfs\0")
    tree = px4.mount(root=b"/fs/microsd")
    assert {name for name, _ in await tree.list(b"/")} == {b"a.txt", b"log"}
    px4.card.rename(b"/fs", b"/elsewhere")
    await px4.reboot()
    with pytest.raises(FtpNak):
        await tree.list(b"/")


@pytest.mark.parametrize("root", [b"/top", b"/top/deeper", A])
async def test_a_root_that_is_a_file_is_not_listed(here: Rig, root: bytes) -> None:
    asked = listed(here)
    with pytest.raises(NotADirectory):
        await here.mount(root=root).list(b"/")
    assert root not in asked


@pytest.mark.holds("rule 14.32")
async def test_files_that_the_root_of_sitl_does_not_list_are_not_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(PROFILES, "ardupilot", replace(PROFILES["ardupilot"], root_omits_files=True))
    async with rig("ardupilot", FILES) as here:
        tree, asked = here.mount(), listed(here)
        shown = dict(await tree.list(b"/"))
        assert b"fs" in shown
        assert b"top" not in shown
        with pytest.raises(NotFound):
            await tree.open(b"/top")
        assert set(asked) == {b"/"}


# --- checksums


async def test_a_checksum_is_that_of_now(here: Rig, tree: Tree) -> None:
    """Size and time are the same."""
    for content in (b"hello", b"olleh"):
        here.put(A, content, MTIME)
        assert await tree.crc32(A) == crc32(content)


async def test_checksums_are_refused(here: Rig, tree: Tree) -> None:
    with pytest.raises(IsADirectory):
        await tree.crc32(b"/fs")
    await here.arm()
    with pytest.raises(Armed):
        await tree.crc32(b"/top")


# --- options and sharing


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
    assert not flights._running
