"""fuse.writing without a kernel: what each call asks of the tree, what is kept, which errors come back."""

from __future__ import annotations

import errno
import mmap
import os
import stat
from typing import cast

import pyfuse3
import pytest
from pyfuse3 import EntryAttributes, SetattrFields

from mavftpfs.mount.handles import ROOT_INO
from mavftpfs.shared.errors import Armed, NoSpace, RequestTimeout
from tests.ops.faketree import MTIME, FakeFile, FakeTree
from tests.ops.test_operations import CTX, failure, ino_of, operations, some_tree

NANO = 1_000_000_000


class Fields:
    """Stands in for pyfuse3.SetattrFields, which only the library can make."""

    def __init__(self, *names: str) -> None:
        for name in ("size", "mode", "uid", "gid", "atime", "mtime", "ctime"):
            setattr(self, f"update_{name}", name in names)


def fields(*names: str) -> SetattrFields:
    return cast(SetattrFields, Fields(*names))


def attributes(**values: int) -> EntryAttributes:
    entry = EntryAttributes()
    for name, value in values.items():
        setattr(entry, name, value)
    return entry


async def test_a_read_handle_cannot_write_and_its_fsync_is_about_the_file() -> None:
    tree = some_tree()
    ops = operations(tree)
    info = await ops.open(await ino_of(ops, b"a.txt"), os.O_RDONLY, CTX)
    await ops.fsync(info.fh, True)
    assert await failure(ops.write(info.fh, 0, b"x")) == errno.EBADF
    tree.error = NoSpace("the card is full")
    await ops.flush(info.fh)
    assert await failure(ops.fsync(info.fh, False)) == errno.ENOSPC


@pytest.mark.holds("promise 2")
async def test_what_a_failing_delivery_says_reaches_flush_and_fsync_but_release_only_logs() -> None:
    tree = some_tree()
    ops = operations(tree)
    info = await ops.open(await ino_of(ops, b"a.txt"), os.O_RDWR, CTX)
    tree.error = NoSpace("the card is full")
    assert await failure(ops.flush(info.fh)) == errno.ENOSPC
    assert await failure(ops.fsync(info.fh, False)) == errno.ENOSPC
    await ops.release(info.fh)
    assert tree.opened[0].closed


async def test_every_change_passes_the_trees_refusal_on() -> None:
    tree = some_tree()
    ops = operations(tree)
    ino = await ino_of(ops, b"a.txt")
    tree.error = Armed("armed")
    calls = [
        ops.create(ROOT_INO, b"n", 0o644, os.O_WRONLY, CTX),
        ops.open(ino, os.O_WRONLY, CTX),
        ops.mkdir(ROOT_INO, b"d", 0o755, CTX),
        ops.rmdir(ROOT_INO, b"empty", CTX),
        ops.unlink(ROOT_INO, b"a.txt", CTX),
        ops.rename(ROOT_INO, b"a.txt", ROOT_INO, b"b", 0, CTX),
        ops.setattr(ino, attributes(st_size=1), fields("size"), None, CTX),
    ]
    assert [await failure(call) for call in calls] == [errno.EROFS] * len(calls)
    assert ops.inodes.known(b"/a.txt") == ino


async def test_modes_owners_and_times_are_kept_and_follow_a_rename() -> None:
    ops = operations()
    ino = await ino_of(ops, b"a.txt")
    wanted = attributes(
        st_mode=0o100751, st_uid=7, st_gid=8, st_atime_ns=5 * NANO + 1, st_mtime_ns=6 * NANO + 2
    )
    await ops.setattr(ino, wanted, fields("mode", "uid", "gid", "atime", "mtime"), None, CTX)
    await ops.forget([(ino, 1)])
    ino = await ino_of(ops, b"a.txt")
    await ops.rename(ROOT_INO, b"a.txt", ROOT_INO, b"b.txt", 0, CTX)
    tree = cast(FakeTree, ops._tree)
    tree.times[b"/b.txt"] = tree.times.pop(b"/a.txt")
    entry = await ops.getattr(ino, CTX)
    assert stat.S_IMODE(entry.st_mode) == 0o751
    assert (entry.st_uid, entry.st_gid) == (7, 8)
    assert (entry.st_atime_ns, entry.st_mtime_ns) == (5 * NANO + 1, 6 * NANO + 2)
    tree.times[b"/b.txt"] = 99  # changed on the vehicle
    assert (await ops.getattr(ino, CTX)).st_mtime_ns == 99


async def test_a_removed_name_forgets_what_was_kept() -> None:
    tree = some_tree()
    ops = operations(tree)
    ino = await ino_of(ops, b"a.txt")
    await ops.setattr(ino, attributes(st_mode=0o100700), fields("mode"), None, CTX)
    await ops.unlink(ROOT_INO, b"a.txt", CTX)
    tree.files[b"/a.txt"] = b"another"
    entry = await ops.lookup(ROOT_INO, b"a.txt", CTX)
    assert entry.st_ino != ino
    assert stat.S_IMODE(entry.st_mode) == 0o644
    assert entry.st_mtime_ns == MTIME * NANO


async def test_the_times_that_are_set_on_a_directory_are_kept() -> None:
    ops = operations()
    log = await ino_of(ops, b"log")
    await ops.setattr(
        log, attributes(st_atime_ns=5, st_mtime_ns=6 * NANO + 2), fields("atime", "mtime"), None, CTX
    )
    entry = await ops.getattr(log, CTX)
    assert (entry.st_atime_ns, entry.st_mtime_ns) == (5, 6 * NANO + 2)


async def test_an_open_file_without_a_name_still_has_attributes_and_can_be_cut() -> None:
    ops = operations()
    ino = await ino_of(ops, b"a.txt")
    info = await ops.open(ino, os.O_RDWR, CTX)
    await ops.unlink(ROOT_INO, b"a.txt", CTX)
    entry = await ops.setattr(ino, attributes(st_size=2), fields("size"), info.fh, CTX)
    assert (entry.st_size, entry.st_nlink) == (2, 0)
    await ops.release(info.fh)
    assert await failure(ops.getattr(ino, CTX)) == errno.ESTALE


async def test_rename_flags() -> None:
    ops = operations()
    call = ops.rename(ROOT_INO, b"a.txt", ROOT_INO, b"b", pyfuse3.RENAME_EXCHANGE, CTX)
    assert await failure(call) == errno.EINVAL
    tree = cast(FakeTree, ops._tree)
    tree.files[b"/b"] = b""
    call = ops.rename(ROOT_INO, b"a.txt", ROOT_INO, b"b", pyfuse3.RENAME_NOREPLACE, CTX)
    assert await failure(call) == errno.EEXIST


async def _fails(*_: object) -> None:
    raise RequestTimeout("silence")


async def test_an_open_that_fails_after_all_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel sends no release for it, and a writer that stays blocks the file for ever."""
    tree = some_tree()
    ops = operations(tree, refresh=_fails)
    ino = await ino_of(ops, b"a.txt")
    for name, flags, owner, broken in (
        (b"a.txt", os.O_WRONLY | os.O_TRUNC, FakeFile, "truncate"),
        (b"new", os.O_WRONLY, FakeTree, "stat"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, broken, _fails)
            assert await failure(ops.create(ROOT_INO, name, 0o600, flags, CTX)) == errno.ETIMEDOUT
    tree.files[b"/a.txt"] = b"longer than the kernel was told"
    assert await failure(ops.open(ino, os.O_RDWR, CTX)) == errno.ETIMEDOUT
    assert [file.closed for file in tree.opened] == [1, 1, 1]
    assert not list(ops.files)


# -- pages of a mapping come by any handle, also one that appends: they belong where they lie ----------

PAGE = mmap.PAGESIZE
SIZE = 2 * PAGE + 100
OLD = bytes(range(256)) * (SIZE // 256) + b"end" * 100
PAGES = {"first": (0, PAGE), "middle": (PAGE, 2 * PAGE), "last": (2 * PAGE, SIZE), "all": (0, SIZE)}


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("which", PAGES)
async def test_a_mapped_page_is_not_appended(which: str) -> None:
    start, stop = PAGES[which]
    tree = FakeTree({b"/f": OLD[:SIZE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    info = await ops.open(ino, os.O_RDWR | os.O_APPEND, CTX)
    assert await ops.write(info.fh, start, b"m" * (stop - start)) == stop - start
    assert await ops.write(info.fh, SIZE, b"appended") == 8
    await ops.flush(info.fh)
    expected = OLD[:start] + b"m" * (stop - start) + OLD[stop:SIZE] + b"appended"
    assert tree.files[b"/f"] == expected


async def test_what_is_appended_to_a_file_that_grew_follows_its_end() -> None:
    """The kernel goes on counting from the size it knew, page borders or not."""
    tree = FakeTree({b"/f": OLD[:PAGE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    tree.files[b"/f"] = OLD[: 2 * PAGE]
    info = await ops.open(ino, os.O_WRONLY | os.O_APPEND, CTX)
    await ops.write(info.fh, PAGE, b"a" * PAGE)
    await ops.write(info.fh, 2 * PAGE, b"b" * 10)
    await ops.flush(info.fh)
    assert tree.files[b"/f"] == OLD[: 2 * PAGE] + b"a" * PAGE + b"b" * 10


async def test_a_file_emptied_by_an_open_is_appended_to_from_its_start() -> None:
    tree = FakeTree({b"/f": OLD[:SIZE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    info = await ops.open(ino, os.O_WRONLY | os.O_APPEND | os.O_TRUNC, CTX)
    await ops.write(info.fh, 0, b"a" * PAGE)
    await ops.write(info.fh, PAGE, b"b" * PAGE)
    await ops.flush(info.fh)
    assert tree.files[b"/f"] == b"a" * PAGE + b"b" * PAGE
