"""Rare coincidences that once lost or mixed up bytes: each test is one of them."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FileChanged, FtpNak
from tests.support.fake_writer import KINDS, FakeWriter, card

OLD = bytes(range(256)) * 4
FILE = b"/card/dir/file.txt"
FULL = FtpNak(Opcode.CREATE_FILE, NakCode.FAIL_ERRNO, 28)


store = card({FILE: OLD})


async def test_a_file_that_could_not_be_made_can_be_removed(store: FakeWriter, tree: Tree) -> None:
    file = await tree.create(b"/card/dir/new", exclusive=True)
    await file.write(0, b"abc")
    store.fail_at = dict.fromkeys(range(1, 5), FULL)  # the removal of what was sent, too
    with pytest.raises(FtpNak):
        await file.flush()
    with pytest.raises(FtpNak):
        await file.release()
    await tree.unlink(b"/card/dir/new")
    assert tree.undelivered() == []
    assert b"new" not in [name for name, _ in await tree.list(b"/card/dir")]


async def test_a_file_renamed_while_it_is_closed_is_forgotten(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    store.write_delay = 0.01
    file = await tree.create(b"/card/dir/a", exclusive=True)
    await file.write(0, b"ours")
    async with trio.open_nursery() as nursery:
        nursery.start_soon(file.release)
        await trio.sleep(0.005)
        nursery.start_soon(lambda: tree.rename(b"/card/dir/a", b"/card/dir/b"))
    assert tree.status()["bytes_held"] == 0
    store.add(b"/card/dir/b", b"theirs, longer")
    await trio.sleep(100)
    assert (await tree.stat(b"/card/dir/b")).size == len(b"theirs, longer")


async def test_a_write_in_the_moment_a_delivery_begins_is_not_forgotten(
    store: FakeWriter, tree: Tree
) -> None:
    file = await tree.open(FILE, write=True)
    for number in range(30):  # which of the two comes first is left to chance
        mark = b"%04d" % number
        await file.truncate(900 - number)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(file.flush)
            nursery.start_soon(file.write, 10, mark)
        await file.flush()
        assert store.files[FILE].data[10:14] == mark
    file.close()


@pytest.mark.parametrize("truncating", [False, True])
@pytest.mark.parametrize("now", [OLD + b"grown on the vehicle", OLD[:10]])
async def test_a_part_is_not_written_into_a_file_that_changed(
    store: FakeWriter, tree: Tree, now: bytes, truncating: bool
) -> None:
    store.kind = KINDS["mavsdk" if truncating else "posix"]
    file = await tree.open(FILE, write=True)
    await file.read(0, len(OLD))
    await file.write(len(OLD), b"appended")
    store.add(FILE, now)
    for _ in range(2):
        with pytest.raises(FileChanged):
            await file.flush()
    file.close()
    assert store.files[FILE].data == now
    assert tree.undelivered() == [FILE]


async def test_an_error_of_an_empty_file_is_told_at_the_close_too(store: FakeWriter, tree: Tree) -> None:
    file = await tree.create(b"/card/dir/empty", exclusive=True)
    store.fail_at = dict.fromkeys(range(1, 5), FULL)  # the removal of what was sent, too
    with pytest.raises(FtpNak):
        await file.fsync()
    with pytest.raises(FtpNak):
        await file.flush()
    await file.flush()
    assert store.files[b"/card/dir/empty"].data == b""
    file.close()


async def test_emptying_does_not_trust_a_remembered_size_of_nothing(store: FakeWriter, tree: Tree) -> None:
    store.add(b"/card/dir/log", b"")
    await tree.stat(b"/card/dir/log")
    store.add(b"/card/dir/log", b"grown")
    file = await tree.open(b"/card/dir/log", write=True, truncate=True)
    await file.fsync()
    file.close()
    assert store.files[b"/card/dir/log"].data == b""
