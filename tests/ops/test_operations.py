"""fuse.operations without a kernel: attributes, lookup counts, errnos, deadlines."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Coroutine
from typing import Any, cast

import pyfuse3
import pytest
import trio
import trio.testing
from pyfuse3 import FUSEError, RequestContext

from mavftpfs.cache.tree import Tree
from mavftpfs.client.connect import Space
from mavftpfs.client.mountpoint import XATTR_CRC32
from mavftpfs.mount.handles import ROOT_INO, DirectoryHandle, Presentation
from mavftpfs.mount.operations import UNKNOWN_SPACE, Operations
from mavftpfs.shared.errors import ListingIncomplete, PathTooLong
from tests.ops.faketree import FakeTree

CTX = cast(RequestContext, None)
TOKEN = cast(pyfuse3.ReaddirToken, None)
LOOK = Presentation(uid=1000, gid=100, file_mode=0o644, directory_mode=0o755, op_deadline=30.0)


def some_tree() -> FakeTree:
    return FakeTree({b"/a.txt": b"hello\n", b"/log/1.ulg": bytes(range(256)) * 4}, {b"/empty"})


def operations(tree: FakeTree | None = None, **more: Any) -> Operations:
    return Operations(cast(Tree, tree or some_tree()), LOOK, **more)


async def failure(call: Coroutine[Any, Any, object]) -> int:
    """Return the errno a handler ends with."""
    with pytest.raises(FUSEError) as caught:
        await call
    return caught.value.errno


async def ino_of(ops: Operations, *names: bytes) -> int:
    ino = ROOT_INO
    for name in names:
        ino = (await ops.lookup(ino, name, CTX)).st_ino
    return ino


class Listing:
    """Stands in for pyfuse3.readdir_reply: takes `room` entries a call, as a kernel buffer does."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, room: int = 1000) -> None:
        self.taken: list[tuple[bytes, int, int]] = []
        self.room = self.left = room
        monkeypatch.setattr(pyfuse3, "readdir_reply", self.reply)

    def reply(self, token: object, name: bytes, attr: pyfuse3.EntryAttributes, next_id: int) -> bool:
        if not self.left:
            return False
        self.left -= 1
        self.taken.append((name, attr.st_ino, next_id))
        return True

    async def read(self, ops: Operations, fh: int, start: int) -> int:
        """One readdir call; returns the offset to go on from."""
        self.left = self.room
        before = len(self.taken)
        await ops.readdir(fh, start, TOKEN)
        return self.taken[-1][2] if len(self.taken) > before else -1

    @property
    def names(self) -> list[bytes]:
        return [name for name, _, _ in self.taken if name not in (b".", b"..")]


# -- attributes and lookup counts -----------------------------------------------------------------


async def test_an_inode_forgotten_during_getattr_leaves_nothing_behind() -> None:
    tree = some_tree()
    ops = operations(tree)
    ino = await ino_of(ops, b"a.txt")
    tree.on_call = lambda name, path: ops.inodes.forget(ino, 1)
    assert (await ops.getattr(ino, CTX)).st_ino == ino
    ops.inodes.check_invariants()
    assert len(ops.inodes) == 1


async def test_a_parent_renamed_during_lookup_gives_the_name_its_new_path() -> None:
    tree = some_tree()
    ops = operations(tree)
    parent = await ino_of(ops, b"log")

    def rename(name: str, path: bytes) -> None:
        ops.inodes.rename(b"/log", b"/moved")

    tree.on_call = rename
    entry = await ops.lookup(parent, b"1.ulg", CTX)
    assert ops.inodes.known(b"/moved/1.ulg") == entry.st_ino
    ops.inodes.check_invariants()


# -- directories ----------------------------------------------------------------------------------


async def test_readdir_offsets_are_stable_while_the_directory_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tree = FakeTree({b"/f%02d" % index: b"" for index in range(10)})
    ops, listing = operations(tree), Listing(monkeypatch, 7)
    fh = await ops.opendir(ROOT_INO, CTX)
    offset = await listing.read(ops, fh, 0)
    del tree.files[b"/f00"], tree.files[b"/f07"]
    tree.files[b"/f03x"] = b""
    await listing.read(ops, fh, offset)
    assert listing.names == [b"f%02d" % index for index in range(10)]
    listing.taken.clear()
    await listing.read(ops, fh, 0)
    assert listing.names == [b"f01", b"f02", b"f03", b"f03x", b"f04"]


async def test_a_directory_lists_itself_and_its_parent_and_counts_no_lookup(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As `ls -la` shows them elsewhere; the kernel drops what it is told of these two."""
    ops, listing = operations(), Listing(monkeypatch)
    log = await ino_of(ops, b"log")
    await listing.read(ops, await ops.opendir(log, CTX), 0)
    assert listing.taken[:2] == [(b".", log, 1), (b"..", ROOT_INO, 2)]
    await ops.forget([(log, 1), (listing.taken[2][1], 1)])
    ops.inodes.check_invariants()
    assert len(ops.inodes) == 1


async def test_an_incomplete_listing_is_shown_and_then_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    tree, listing = some_tree(), Listing(monkeypatch, 2)
    ops = operations(tree)
    fh = await ops.opendir(ROOT_INO, CTX)
    tree.error = ListingIncomplete("cut short", (await some_tree().list(b"/"))[:2])
    offset = await listing.read(ops, fh, 0)
    offset = await listing.read(ops, fh, offset)
    assert await failure(listing.read(ops, fh, offset)) == errno.EIO
    assert listing.names == [b"a.txt", b"empty"]
    tree.error = ListingIncomplete("nothing came", [])
    assert await failure(listing.read(ops, fh, 0)) == errno.EIO
    tree.error = None
    offset = 0
    while offset >= 0:
        offset = await listing.read(ops, fh, offset)
    assert listing.names[-1] == b"log"


# -- files ----------------------------------------------------------------------------------------


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("short", [0, 1, 5])
async def test_a_short_reply_in_mid_file_is_an_error(short: int, caplog: pytest.LogCaptureFixture) -> None:
    tree = some_tree()
    ops = operations(tree)
    info = await ops.open(await ino_of(ops, b"a.txt"), os.O_RDONLY, CTX)
    tree.short_read = short
    assert await failure(ops.read(info.fh, 0, 100)) == errno.EIO
    assert "bug" in caplog.text


# -- the file system ------------------------------------------------------------------------------


@pytest.mark.holds("promise 4")
async def test_statfs_never_asks_the_tree() -> None:
    tree = some_tree()
    tree.error = AssertionError("asked")
    data = await operations(tree).statfs(CTX)
    assert data.f_blocks * data.f_frsize == UNKNOWN_SPACE
    known = await operations(tree, space=lambda: Space(1 << 30, 1 << 20)).statfs(CTX)
    assert known.f_blocks * known.f_frsize == 1 << 30
    assert known.f_bavail * known.f_frsize == known.f_bfree * known.f_frsize == 1 << 20
    assert tree.calls == []


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("name", [b"security.capability", b"system.posix_acl_access", b"user.x"])
async def test_unknown_attributes_never_ask_the_tree(name: bytes) -> None:
    tree = some_tree()
    ops = operations(tree)
    ino = await ino_of(ops, b"a.txt")
    tree.calls.clear()
    assert await failure(ops.getxattr(ino, name, CTX)) == errno.ENODATA
    assert tree.calls == []


# -- errors and deadlines -------------------------------------------------------------------------

Call = Callable[[Operations, int, int], Coroutine[Any, Any, object]]
CALLS: dict[str, Call] = {
    "lookup": lambda ops, ino, fh: ops.lookup(ROOT_INO, b"a.txt", CTX),
    "getattr": lambda ops, ino, fh: ops.getattr(ino, CTX),
    "readdir": lambda ops, ino, fh: ops.readdir(ops.directories.add(DirectoryHandle(ROOT_INO)), 0, TOKEN),
    "open": lambda ops, ino, fh: ops.open(ino, os.O_RDONLY, CTX),
    "read": lambda ops, ino, fh: ops.read(fh, 0, 6),
    "getxattr": lambda ops, ino, fh: ops.getxattr(ino, XATTR_CRC32, CTX),
}


async def prepared(tree: FakeTree) -> tuple[Operations, int, int]:
    ops = operations(tree)
    ino = await ino_of(ops, b"a.txt")
    return ops, ino, (await ops.open(ino, os.O_RDONLY, CTX)).fh


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (PathTooLong("x"), errno.ENAMETOOLONG),
        (FUSEError(errno.EXDEV), errno.EXDEV),
        (ValueError("a bug"), errno.EIO),
        (ExceptionGroup("bugs", [KeyError("y")]), errno.EIO),
    ],
    ids=str,
)
async def test_errors_become_errnos_and_a_bug_is_logged_with_its_traceback(
    call: Call, error: Exception, expected: int, caplog: pytest.LogCaptureFixture
) -> None:
    tree = some_tree()
    ops, ino, fh = await prepared(tree)
    tree.error = error
    assert await failure(call(ops, ino, fh)) == expected
    ops.inodes.check_invariants()
    logged = [bool(record.exc_info) for record in caplog.records if record.levelno == logging.ERROR]
    assert logged == [True] * (expected == errno.EIO)


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("name", CALLS)
async def test_every_handler_ends_in_time(name: str, autojump_clock: trio.testing.MockClock) -> None:
    tree = some_tree()
    ops, ino, fh = await prepared(tree)
    tree.delays = dict.fromkeys(("stat", "list", "open", "read", "crc32"), 100_000.0)
    started = trio.current_time()
    assert await failure(CALLS[name](ops, ino, fh)) == errno.ETIMEDOUT
    limit = {"getxattr": 601.0, "read": 601.0, "open": 14_500.0}.get(name, 34.0)
    assert 30.0 < trio.current_time() - started < limit
    ops.inodes.check_invariants()


@pytest.mark.holds("promise 2")
async def test_a_checksum_and_a_big_read_on_a_slow_radio_get_the_time_they_need(
    autojump_clock: trio.testing.MockClock,
) -> None:
    """128 KiB at 1.2 kB/s are 110 s; that the link makes progress is the tree's to judge."""
    tree = FakeTree({b"/a.txt": bytes(131072)})
    ops, ino, fh = await prepared(tree)
    tree.delays = {"read": 110.0, "crc32": 119.0}
    assert len(await ops.read(fh, 0, 131072)) == 131072
    assert len(await ops.getxattr(ino, XATTR_CRC32, CTX)) == 8
    tree.delays = {"read": 10_000.0}
    assert await failure(ops.read(fh, 0, 131072)) == errno.ETIMEDOUT


async def test_the_kernel_s_reads_ahead_end_with_the_program_that_closed_a_descriptor(
    autojump_clock: trio.testing.MockClock,
) -> None:
    """Once: after that somebody else shares the handle, and waits for what is read."""
    tree = FakeTree({b"/a.txt": bytes(262144)})
    ops, _, fh = await prepared(tree)
    ends: list[tuple[float, int]] = []

    async def read(size: int) -> None:
        try:
            await ops.read(fh, 0, size)
            ends.append((trio.current_time(), 0))
        except FUSEError as error:
            ends.append((trio.current_time(), error.errno))

    for errno_then in (errno.EINTR, 0):
        tree.delays = {"read": 20.0}
        began = trio.current_time()
        async with trio.open_nursery() as nursery:
            nursery.start_soon(read, 262144)
            nursery.start_soon(read, 4096)  # a program waits for a single page
            await trio.sleep(5.0)
            await ops.flush(fh)
        expected = sorted([(began + (5.0 if errno_then else 20.0), errno_then), (began + 20.0, 0)])
        assert sorted(ends) == expected
        ends.clear()
