"""Names of ours that programs do not see: what of them stands in the way, and where they may be put."""

from __future__ import annotations

import errno
from collections.abc import AsyncIterator
from random import Random

import pytest
import trio

from mavftpfs.cache.asides import DELETED_AFTER, STALE_AFTER, new_owner
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FileBusy, FtpNak, PathTooLong
from tests.support.fake_writer import KINDS, FakeWriter, litter, make_writable


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["posix"], nursery)
    store.add(b"/d/a", b"A")
    store.add_directory(b"/d/empty")
    store.add_directory(b"/d/other")
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


# --- directories that only look empty


STRANGERS = (b".mavftpfs-wxyzdaaa", b".mavftpfs-wxyztaaa-file", b".mavftpfs-wxyzoaaa-file", b".mavftpfs-")


@pytest.mark.parametrize("name", STRANGERS)
async def test_what_another_mount_may_need_keeps_a_directory_busy(store: FakeWriter, name: bytes) -> None:
    tree = make_writable(store)
    store.add(b"/d/empty/" + name, b"perhaps an only copy")
    assert not await tree.list(b"/d/empty")
    with pytest.raises(FileBusy):
        await tree.rmdir(b"/d/empty")
    with pytest.raises(FileBusy):
        await tree.rename(b"/d/other", b"/d/empty", noreplace=False)
    assert store.files[b"/d/empty/" + name].data == b"perhaps an only copy"


async def test_what_another_mount_left_long_ago_does_not(store: FakeWriter, autojump_clock: object) -> None:
    tree = make_writable(store)
    store.add(b"/d/empty/.mavftpfs-wxyzdaaa", b"")
    with pytest.raises(FileBusy):
        await tree.rmdir(b"/d/empty")
    await trio.sleep(STALE_AFTER)
    with pytest.raises(FileBusy):  # somebody may be reading it
        await tree.rmdir(b"/d/empty")
    await trio.sleep(DELETED_AFTER)
    await tree.rmdir(b"/d/empty")
    assert b"/d/empty" not in store.directories


@pytest.mark.parametrize("over", [False, True])
async def test_our_own_leftovers_do_not_keep_a_directory(store: FakeWriter, over: bool) -> None:
    """As those of trying out what the server does, or of a mount that was killed."""
    tree = make_writable(store)
    owner = new_owner(Random(1))  # as make_writable's
    for kind in (b"d", b"t"):
        store.add(b"/d/empty/.mavftpfs-" + owner + kind + b"aaa", b"")
    if over:
        await tree.rename(b"/d/other", b"/d/empty", noreplace=False)
        assert b"/d/other" not in store.directories
    else:
        await tree.rmdir(b"/d/empty")
        assert b"/d/empty" not in store.directories


async def test_a_directory_replaced_by_a_rename_gives_up_unlinked_files_first(store: FakeWriter) -> None:
    tree = make_writable(store)
    store.add(b"/d/empty/read", b"read on")
    reading = await tree.open(b"/d/empty/read")
    await tree.unlink(b"/d/empty/read")
    await tree.rename(b"/d/other", b"/d/empty", noreplace=False)
    assert bytes(await reading.read(0, 100)) == b"read on"
    await reading.release()
    assert litter(store) == []


async def test_a_name_that_could_not_be_moved_up_is_not_kept_alive(store: FakeWriter) -> None:
    tree = make_writable(store)
    store.add(b"/d/empty/read", b"read on")
    reading = await tree.open(b"/d/empty/read")
    await tree.unlink(b"/d/empty/read")
    store.fail_at[store.requests + 1] = FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.EACCES)
    with pytest.raises(FtpNak):
        await tree.rmdir(b"/d/empty")
    assert bytes(await reading.read(0, 100)) == b"read on"
    await reading.release()
    await tree.rmdir(b"/d/empty")
    assert b"/d/empty" not in store.directories


async def test_an_open_file_without_room_for_another_name_is_removed(store: FakeWriter) -> None:
    root = b"/" + b"r" * 60
    path = b"/" + b"n" * 138
    store.add(root + path, b"x" * 5000)
    tree = make_writable(store, root=root)
    reading = await tree.open(path)
    await tree.unlink(path)
    assert root + path not in store.files
    await reading.release()


# --- trying out what the server does


async def append(tree: Tree, path: bytes) -> None:
    file = await tree.open(path, write=True)
    await file.write(file.size, b"more")
    await file.release()


DEEP = b"/d/" + b"p" * 100 + b"/" + b"q" * 90
REFUSED = FtpNak(Opcode.CREATE_FILE, NakCode.FAIL_ERRNO, errno.EACCES)


async def test_a_directory_above_that_cannot_be_written_proves_nothing(store: FakeWriter) -> None:
    tree = make_writable(store)
    store.add(DEEP + b"/f", b"old, ")
    store.fail_at[1] = REFUSED
    await append(tree, DEEP + b"/f")
    assert store.log[0][0] == "probe"
    assert store.files[DEEP + b"/f"].data == b"old, more"
    assert store.traits.wo_truncates, "what is not known is taken to be the worse"


async def test_a_directory_that_cannot_be_written_is_an_error(store: FakeWriter) -> None:
    tree = make_writable(store)
    store.fail_at[1] = REFUSED
    with pytest.raises(FtpNak):
        await append(tree, b"/d/a")
    assert store.traits.wo_truncates is None


async def test_without_room_for_trying_out_the_worse_is_assumed(store: FakeWriter) -> None:
    root = b"/" + b"r" * 186
    store.add(root + b"/f", b"old, ")
    tree = make_writable(store, root=root)
    with pytest.raises(PathTooLong):
        await append(tree, b"/f")
    assert store.requests == 0
    assert store.files[root + b"/f"].data == b"old, "
