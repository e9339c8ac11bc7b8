"""The local disk behind a mount: it fails, fills up, outlives a killed process, and is left clean."""

from __future__ import annotations

import errno
import json
import os
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from random import Random

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError, NoSpace, VehicleLost
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, make_writable, write_file

pytestmark = pytest.mark.holds("promise 3")

BIG = os.urandom(70_000)
FILE = b"/card/log.bin"


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["posix"], nursery)
    store.add_directory(b"/card")
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


def failing(*_: object) -> bytes:
    raise OSError(errno.EIO, "bad sector")


async def begin(tree: Tree, store: FakeWriter, data: bytes = BIG) -> OpenFile:
    """A file of which more was written than memory takes, while the vehicle is away."""
    file = await tree.create(FILE, exclusive=True)
    store.lost = True
    await file.write(0, data)
    return file


async def test_a_disk_that_fails_is_the_error_of_one_file(
    store: FakeWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = make_writable(store, dirty_max=65536)
    file = await begin(tree, store)
    store.lost = False
    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", failing)
        for act in (file.flush, file.fsync, file.release):
            with pytest.raises(MavftpfsError) as told:
                await act()
            assert errno_for(told.value) == errno.EIO
        with pytest.raises(MavftpfsError) as told:
            await read_file(tree, FILE)
        assert errno_for(told.value) == errno.EIO
        await write_file(tree, b"/card/other", b"small")
        assert store.files[b"/card/other"].data == b"small"
        assert tree.undelivered() == [FILE]
    assert await tree.drain(10) == []
    assert store.files[FILE].data == BIG


async def test_a_disk_that_fails_when_all_is_delivered_harms_nothing(
    store: FakeWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last close would have kept the content as what was read."""
    tree = make_writable(store, dirty_max=65536)
    file = await begin(tree, store)
    store.lost = False
    await file.fsync()
    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", failing)
        await file.release()
    assert await read_file(tree, FILE) == BIG


async def test_a_cut_that_fails_changes_nothing(store: FakeWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = make_writable(store, dirty_max=65536)
    file = await begin(tree, store)
    store.lost = False
    await file.fsync()
    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", failing)
        with pytest.raises(MavftpfsError) as told:
            await file.truncate(10)
        assert errno_for(told.value) == errno.EIO
    assert file.size == len(BIG)
    await file.write(0, b"X")
    await file.release()
    assert store.files[FILE].data == b"X" + BIG[1:]


async def test_a_full_disk_is_told_to_the_writer_and_costs_nothing_accepted(
    store: FakeWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = make_writable(store, dirty_max=1)  # more memory than that is not taken
    file = await begin(tree, store, BIG[:65_000])  # more than that would have the writer wait
    really = os.pwrite

    def pwrite(descriptor: int, data: bytes, offset: int) -> int:
        if offset + len(data) > 65_000:
            raise OSError(errno.ENOSPC, "full")
        return really(descriptor, data, offset)

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(NoSpace):
        await file.write(65_000 - 10, b"more than fits")
    assert file.size == 65_000
    store.lost = False
    await file.release()
    assert store.files[FILE].data == BIG[:65_000]


async def test_the_log_says_once_that_the_full_disk_is_the_one_here(
    store: FakeWriter, caplog: pytest.LogCaptureFixture
) -> None:
    """To a program ENOSPC means the card."""
    tree = make_writable(store, dirty_max=1, spool_max=65_010)
    file = await begin(tree, store, BIG[:65_000])
    for _ in range(3):
        with pytest.raises(NoSpace):
            await file.write(65_000, b"more than fits")
    (said,) = caplog.messages
    assert "here, not on the vehicle" in said
    assert "spool_max" in said
    store.lost = False
    await file.release()
    again = await tree.create(b"/card/again", exclusive=True)
    await again.write(0, BIG[:65_000])
    caplog.clear()
    with pytest.raises(NoSpace):
        await again.write(65_000, b"more than fits")
    assert len(caplog.messages) == 1, "there was room meanwhile, so it is news"


# --- a process that is killed


async def killed(tree: Tree, spool: SpoolDirectory, tmp_path: Path) -> dict[str, tuple[str, bytes]]:
    """What the next mount of the vehicle finds: file -> (path on the vehicle, bytes)."""
    spool.close()
    again = SpoolDirectory(tmp_path / "spool", Random(2))
    found = again.rescue(tmp_path / "recovered")
    again.close()
    return {
        path.name: (json.loads(path.with_name(path.name + ".json").read_text())["path"], path.read_bytes())
        for path in found
    }


@pytest.fixture
def spool(tmp_path: Path) -> SpoolDirectory:
    return SpoolDirectory(tmp_path / "spool", Random(1))


async def written(store: FakeWriter, spool: SpoolDirectory) -> tuple[Tree, OpenFile]:
    """Return a mount and a file of it of which more was written than memory takes."""
    tree = make_writable(store, spool=spool, dirty_max=65536)
    file = await tree.create(FILE, exclusive=True)
    await file.write(0, BIG)
    return tree, file


async def test_killed_after_a_rename(store: FakeWriter, spool: SpoolDirectory, tmp_path: Path) -> None:
    tree, file = await written(store, spool)
    await tree.rename(FILE, b"/card/name", noreplace=False)
    store.lost = True
    await file.write(0, b"X")
    assert await killed(tree, spool, tmp_path) == {"card__name": ("/card/name", b"X" + BIG[1:])}


async def test_killed_after_it_was_unlinked(store: FakeWriter, spool: SpoolDirectory, tmp_path: Path) -> None:
    tree, file = await written(store, spool)
    await tree.unlink(FILE)
    assert bytes(await file.read(0, len(BIG))) == BIG
    assert await killed(tree, spool, tmp_path) == {}


@pytest.mark.parametrize("how", ["unlink", "rename over it"])
async def test_removing_what_was_not_delivered_frees_its_place(store: FakeWriter, how: str) -> None:
    tree = make_writable(store, dirty_max=65536, spool_max=2 * len(BIG))
    for _ in range(5):
        file = await begin(tree, store)
        with pytest.raises(MavftpfsError):
            await file.flush()
        file.close()
        store.lost = False
        if how == "unlink":
            await tree.unlink(FILE)
        else:
            await write_file(tree, b"/card/other", b"small")
            await tree.rename(b"/card/other", FILE, noreplace=False)
            await tree.unlink(FILE)
        assert tree.status()["bytes_held_on_disk"] == 0


async def test_killed_after_fsync_and_more(store: FakeWriter, spool: SpoolDirectory, tmp_path: Path) -> None:
    tree, file = await written(store, spool)
    await file.fsync()
    store.lost = True
    await file.write(len(BIG), b"!")
    assert await killed(tree, spool, tmp_path) == {"card__log.bin": ("/card/log.bin", BIG + b"!")}


async def test_killed_while_a_delivered_file_is_open(
    store: FakeWriter, spool: SpoolDirectory, tmp_path: Path
) -> None:
    tree, file = await written(store, spool)
    await file.fsync()
    assert await killed(tree, spool, tmp_path) == {}


# --- what stays behind


async def test_nothing_stays_in_the_directory_for_temporaries(
    store: FakeWriter, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    tree = make_writable(store, dirty_max=65536)
    file = await begin(tree, store)
    assert os.listdir(tmp_path)
    with pytest.raises(VehicleLost):
        await file.release()
    store.lost = False
    await write_file(tree, b"/card/second", BIG)
    assert await tree.drain(10) == []
    assert os.listdir(tmp_path) == []
    assert store.files[FILE].data == store.files[b"/card/second"].data == BIG


async def test_what_is_recovered_has_its_whole_size(store: FakeWriter, tmp_path: Path) -> None:
    tree = make_writable(store)
    file = await tree.create(FILE, exclusive=True)
    await file.write(0, b"abc")
    await file.truncate(1000)
    store.lost = True
    (saved,) = tree.recover_to(tmp_path / "r")
    assert saved.read_bytes() == b"abc".ljust(1000, b"\0")
