"""What is kept from one mount to the next: served only where it is provably the file, else read again."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import trio

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.kept import CRC_LIMIT, CRC_PAUSE, SETTLED, KeptCache
from mavftpfs.cache.kept_disk import KeptDisk
from mavftpfs.cache.tree import Tree
from mavftpfs.cache.versions import BLOCK_SIZE, BlockCache
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FileChanged
from tests.support.rigs import Rig, read_file, rig
from tests.support.transfers import content

LOG = b"/logs/a.bin"
DATA = content(300_000)
NOW = 1_800_000_000.0
MTIME = 1_700_000_000
ENOUGH = 2 * SETTLED + 1
OPEN, CRC = Opcode.OPEN_FILE_RO, Opcode.CALC_FILE_CRC32


class Mounts:
    """Mounts of one vehicle, one after the other, with one cache directory."""

    def __init__(self, here: Rig, path: Path) -> None:
        self.here = here
        self.path = path
        self.vehicle: bytes | None = b"vehicle"
        self.crc_limit = 1 << 20
        self.growing: set[bytes] = set()
        self.caches: list[KeptCache] = []
        self.disk_delay = 0.0

    async def run(self, work: Callable[..., object], *args: object) -> object:
        """Work as a thread would, on virtual time."""
        await trio.sleep(self.disk_delay)
        return work(*args)

    def mount(self, **options: Any) -> Tree:
        """Return a tree that knows nothing but what lies in the directory."""

        def keep(directories: Directories, blocks: BlockCache) -> KeptCache:
            directories.is_growing = self.growing.__contains__  # type: ignore[assignment,method-assign]
            self.caches.append(
                KeptCache(
                    KeptDisk(self.path, 1 << 24),
                    directories,
                    blocks,
                    identity=lambda: self.vehicle,
                    crc32=self.here.connection.store.crc32,
                    crc_limit=lambda: self.crc_limit,
                    wall=lambda: NOW,
                    run=self.run,
                )
            )
            return self.caches[-1]

        self.here.faults.requests.clear()
        return self.here.mount(keep=keep, **options)

    async def read_and_settle(self) -> None:
        """Read the file in a mount of its own, which ends after a while."""
        tree = self.mount()
        assert await read_file(tree, LOG) == self.here.data(LOG)
        await trio.sleep(ENOUGH)

    def asked(self) -> tuple[int, int]:
        """Return how often a file was opened, and a checksum asked for, since the last mount."""
        return self.here.count(OPEN), self.here.count(CRC)


@pytest.fixture
async def mounts(tmp_path: Path) -> AsyncIterator[Mounts]:
    """Of a server whose listings tell times."""
    async with rig("mavsdk") as here:
        here.put(LOG, DATA, MTIME)
        yield Mounts(here, tmp_path / "cache")


@pytest.fixture
async def undated(tmp_path: Path) -> AsyncIterator[Mounts]:
    """Of one whose listings tell none."""
    async with rig("px4", {LOG: DATA}) as here:
        yield Mounts(here, tmp_path / "cache")


@pytest.mark.parametrize("change", ["size", "mtime", "vehicle", "unknown vehicle", "growing", "young"])
async def test_anything_else_is_read_again(mounts: Mounts, change: str) -> None:
    await mounts.read_and_settle()
    new = content(len(DATA), seed=8)
    mtime = MTIME
    if change == "size":
        new += b"x"
    elif change == "mtime":
        mtime += 1
    elif change == "young":
        mtime = int(NOW)
    elif change == "growing":
        mounts.growing.add(LOG)
    else:
        mounts.vehicle = b"other" if change == "vehicle" else None
    mounts.here.put(LOG, new, mtime)
    assert await read_file(mounts.mount(), LOG) == new
    assert mounts.asked() == (1, 0)


@pytest.mark.parametrize(
    "why", ["young", "growing", "vehicle unknown", "changed", "suspect", "soon", "other", "rebooted"]
)
async def test_what_is_not_beyond_doubt_is_not_kept(mounts: Mounts, why: str) -> None:
    if why == "young":
        mounts.here.put(LOG, DATA, int(NOW) - 1)
    if why == "growing":
        mounts.growing.add(LOG)
    if why == "vehicle unknown":
        mounts.vehicle = None
    tree = mounts.mount(dir_timeout=5)
    handle = await tree.open(LOG)
    for at in range(0, len(DATA), BLOCK_SIZE):
        await handle.read(at, BLOCK_SIZE)
    if why == "changed":
        mounts.here.put(LOG, DATA, MTIME + 1)
        await trio.sleep(6)
        await tree.list(b"/logs")
    if why == "other":
        mounts.vehicle = b"other"
    if why == "rebooted":
        tree.rebooted()
    if why == "suspect":
        await trio.sleep(9)
        mounts.here.connection.scheduler.doubt.raise_it("somebody else")
    await trio.sleep(SETTLED - 1 if why == "soon" else ENOUGH)
    assert mounts.caches[0].written == 0
    handle.close()


@pytest.mark.holds("promise 1")
async def test_nor_is_what_was_kept_a_file_that_was_moved_to_its_name(mounts: Mounts) -> None:
    """Of the same size and time, as copies and parameter files may be; nor in a later mount."""
    other = content(len(DATA), seed=8)
    mounts.here.put(b"/logs/b.bin", other, MTIME)
    await mounts.read_and_settle()
    tree = mounts.mount()
    await tree.rename(b"/logs/b.bin", LOG)
    assert await read_file(tree, LOG) == other
    assert await read_file(mounts.mount(), LOG) == other


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("moved_away", ["file", "directory"])
async def test_nor_one_that_was_moved_there_with_its_directory(mounts: Mounts, moved_away: str) -> None:
    """Two directories of one layout change places, as a backup that is put back."""
    other = content(len(DATA), seed=8)
    mounts.here.put(b"/new/a.bin", other, MTIME)
    mounts.here.put_directory(b"/new/empty")
    await mounts.read_and_settle()
    tree = mounts.mount()
    if moved_away == "file":
        await tree.unlink(LOG)
        await tree.rmdir(b"/logs")
    else:
        await tree.rename(b"/logs", b"/old")
    await tree.rename(b"/new", b"/logs")
    assert await read_file(tree, LOG) == other
    assert await read_file(mounts.mount(), LOG) == other


async def test_what_is_kept_of_an_older_file_is_not_read_again(mounts: Mounts) -> None:
    await mounts.read_and_settle()
    assert await read_file(mounts.mount(), LOG) == DATA
    assert mounts.asked() == (0, 0)


async def test_without_an_mtime_a_checksum_decides(undated: Mounts) -> None:
    await undated.read_and_settle()
    assert await read_file(undated.mount(), LOG) == DATA
    assert undated.asked() == (0, 1)
    other = b"/logs/never_read"
    undated.here.put(other, DATA)
    assert await read_file(undated.mount(), other) == DATA
    assert undated.asked() == (1, 0)
    new = content(len(DATA), seed=9)
    undated.here.put(LOG, new)
    assert await read_file(undated.mount(), LOG) == new
    assert undated.asked() == (1, 1)


@pytest.mark.parametrize("dated", [True, False])
async def test_what_was_read_whole_just_before_the_unmount_costs_a_checksum(
    mounts: Mounts, undated: Mounts, dated: bool
) -> None:
    here = mounts if dated else undated
    tree = here.mount()
    assert await read_file(tree, LOG) == DATA
    await tree.keep_whole_files()
    assert here.caches[0].written == len(DATA) // BLOCK_SIZE + 1
    assert await read_file(here.mount(), LOG) == DATA
    assert here.asked() == (0, 1)
    new = content(len(DATA), seed=9)
    here.here.put(LOG, new, MTIME)
    assert await read_file(here.mount(), LOG) == new
    assert here.asked() == (1, 1)


LEFT_OUT = ["armed or large", "in part", "growing", "rebooted", "in doubt"]


@pytest.mark.parametrize(("why", "dated"), [("young", True), *product(LEFT_OUT, [True, False])])
async def test_what_is_not_kept_at_an_unmount(mounts: Mounts, undated: Mounts, why: str, dated: bool) -> None:
    here = mounts if dated else undated
    if why == "young":
        here.here.put(LOG, DATA, int(NOW) - 1)
    tree = here.mount()
    if why == "in part":
        handle = await tree.open(LOG)
        await handle.read(len(DATA) - 1, 1)
        handle.close()
    else:
        assert await read_file(tree, LOG) == DATA
    if why == "armed or large":
        here.crc_limit = len(DATA) - 1
    if why == "growing":
        here.growing.add(LOG)
    if why == "rebooted":
        tree.rebooted()
    if why == "in doubt":
        here.here.connection.scheduler.doubt.raise_it("somebody else")
    await tree.keep_whole_files()
    assert here.caches[0].written == 0


@pytest.mark.parametrize("why", ["not allowed", "refused", "silent", "incomplete"])
async def test_without_an_mtime_and_a_checksum_all_is_read(undated: Mounts, why: str) -> None:
    await undated.read_and_settle()
    if why == "not allowed":
        undated.crc_limit = 0
    if why == "incomplete":
        max((p for p in undated.path.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size).unlink()
    if why == "refused":
        undated.here.faults.refuse(CRC, NakCode.FAIL)
    if why == "silent":
        undated.here.faults.ignore(CRC)
    tree = undated.mount()
    began = trio.current_time()
    assert await read_file(tree, LOG) == DATA
    assert trio.current_time() - began < 2 * CRC_LIMIT
    assert undated.here.count(OPEN) == 1


async def test_a_checksum_that_did_not_come_is_asked_for_again_after_a_while(undated: Mounts) -> None:
    await undated.read_and_settle()
    undated.here.faults.at(CRC, lambda: None, times=99, drop=True)
    tree = undated.mount()
    await read_file(tree, LOG)
    undated.here.faults.call_off()
    asked = undated.here.count(CRC)
    for more in (0, 1):
        await trio.sleep(0.6 * CRC_PAUSE)
        tree.forget_caches()
        await read_file(tree, LOG)
        assert undated.here.count(CRC) == asked + more


async def test_a_full_disk_ends_the_keeping_not_the_reading(
    mounts: Mounts, caplog: pytest.LogCaptureFixture
) -> None:
    tree = mounts.mount()

    def full(name: str, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    mounts.caches[0]._disk.write = full  # type: ignore[method-assign]
    for _ in range(2):
        assert await read_file(tree, LOG) == DATA
        await trio.sleep(ENOUGH)
    assert [record.getMessage() for record in caplog.records if "cache_dir" in record.getMessage()] == [
        "nothing more is kept in cache_dir: [Errno 28] No space left on device"
    ]


async def test_a_file_that_changes_while_the_disk_is_slow(mounts: Mounts) -> None:
    await mounts.read_and_settle()
    tree = mounts.mount(dir_timeout=5)
    old = await tree.open(LOG)
    mounts.disk_delay = 10.0
    new = content(len(DATA), seed=3)
    mounts.here.put(LOG, new, MTIME + 5)
    await trio.sleep(6)
    mounts.here.nursery.start_soon(tree.open, LOG)
    with pytest.raises(FileChanged):
        await old.read(2 * BLOCK_SIZE, 100)
    assert await read_file(tree, LOG) == new
    old.close()


@pytest.mark.parametrize("dated", [True, False])
async def test_a_file_that_changes_while_it_is_opened_from_the_disk(
    mounts: Mounts, undated: Mounts, dated: bool
) -> None:
    if not dated:
        mounts = undated
    await mounts.read_and_settle()
    tree = mounts.mount(dir_timeout=5)
    await tree.list(b"/logs")
    new = content(len(DATA), seed=3)
    mounts.disk_delay = 10.0 if dated else 4.0

    async def change() -> None:
        await trio.sleep(6)
        mounts.here.put(LOG, new, MTIME + 5)
        await tree.list(b"/logs")

    mounts.here.nursery.start_soon(change)
    assert await read_file(tree, LOG) == new
