"""Open files that are written: who sees what, what a close delivers, and files that lose their name."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import (
    AlreadyExists,
    FileBusy,
    FileTooLarge,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    NotSupported,
    ReadOnly,
)
from mavftpfs.shared.model import split
from tests.support.fake_store import make_tree, read_file
from tests.support.fake_writer import FakeWriter, card, make_writable, write_file

DATA = bytes(range(256)) * 300
FILE = b"/card/dir/file.bin"


store = card({FILE: DATA})


async def test_the_shells_redirection_is_one_delivery(store: FakeWriter, tree: Tree) -> None:
    """open(O_TRUNC), dup2, close, write, close: flush comes before the first byte."""
    file = await tree.open(FILE, write=True, truncate=True)
    await file.flush()
    assert store.requests == 0
    assert file.size == 0
    assert (await tree.stat(FILE)).size == 0
    await file.write(0, b"echo\n")
    await file.flush()
    renames = [entry for entry in store.log if entry[0] == "rename"]
    assert len(renames) == 1
    requests = store.requests
    await file.release()
    assert store.requests == requests
    assert store.files[FILE].data == b"echo\n"


async def test_reading_what_was_just_written_asks_nothing(store: FakeWriter, tree: Tree) -> None:
    await write_file(tree, b"/card/new", DATA)
    before = len(store.calls)
    assert await read_file(tree, b"/card/new") == DATA
    assert len(store.calls) == before


async def test_creating(store: FakeWriter, tree: Tree) -> None:
    with pytest.raises(AlreadyExists):
        await tree.create(FILE, exclusive=True)
    file = await tree.create(FILE, exclusive=False)
    assert file.size == len(DATA)
    await file.release()
    with pytest.raises(NotFound):
        await tree.create(b"/card/none/x", exclusive=False)
    with pytest.raises(NotADirectory):
        await tree.create(FILE + b"/x", exclusive=False)
    with pytest.raises(IsADirectory):
        await tree.create(b"/card/dir", exclusive=False)
    with pytest.raises(NotSupported):
        await tree.create(b"/card/.mavftpfs-abcdtabc-x", exclusive=False)
    assert store.requests == 0


async def test_a_write_waits_while_the_file_is_being_delivered(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    store.write_delay = 1
    one = await tree.create(b"/card/new", exclusive=True)
    two = await tree.open(b"/card/new", write=True)
    await one.write(0, b"one")
    async with trio.open_nursery() as both:
        both.start_soon(one.release)
        await trio.sleep(0.5)
        await two.write(0, b"ONE")
        assert store.files[b"/card/new"].data == b"one"
    await two.release()
    assert store.files[b"/card/new"].data == b"ONE"


async def test_handles_are_closed_once(tree: Tree) -> None:
    file = await tree.open(FILE, write=True)
    await file.release()
    await file.release()
    file.close()
    with pytest.raises(LocalProtocolError):
        await file.write(0, b"x")
    with pytest.raises(LocalProtocolError):
        await file.read(0, 1)
    reader = await tree.open(FILE)
    await reader.release()
    await reader.release()
    with pytest.raises(LocalProtocolError):
        await reader.write(0, b"x")


@pytest.mark.holds("rule 14.27")
async def test_no_file_is_larger_than_the_protocol_can_say(tree: Tree) -> None:
    file = await tree.open(FILE, write=True)
    with pytest.raises(FileTooLarge):
        await file.write(2**32 - 1, b"x")
    with pytest.raises(FileTooLarge):
        await file.truncate(2**32)
    await file.release()


async def test_read_only_and_virtual_trees_refuse_changes(store: FakeWriter) -> None:
    reading = make_tree(store)
    for ask in (reading.mkdir(b"/x"), reading.open(FILE, write=True), reading.unlink(FILE)):
        with pytest.raises(ReadOnly):
            await ask
    writing = make_writable(store)
    with pytest.raises(ReadOnly):
        await writing.create(b"/@SYS/x", exclusive=False)
    with pytest.raises(ReadOnly):
        await writing.rename(FILE, b"/@SYS/x")


@pytest.mark.holds("promise 6")
async def test_a_growing_file_is_busy(autojump_clock: object, store: FakeWriter) -> None:
    tree = make_writable(store, dir_timeout=1)
    await tree.stat(FILE)
    store.files[FILE].data += b"more"
    await trio.sleep(2)
    await tree.stat(FILE)
    for ask in (
        lambda: tree.open(FILE, write=True),
        lambda: tree.open(FILE, write=True, truncate=True),
        lambda: tree.unlink(FILE),
        lambda: tree.rename(FILE, b"/card/x"),
        lambda: tree.truncate(FILE, 0),
    ):
        with pytest.raises(FileBusy):
            await ask()
    reader = await tree.open(FILE)
    with pytest.raises(FileBusy):
        await tree.unlink(FILE)
    await reader.release()
    await trio.sleep(60)
    await tree.truncate(FILE, 0)
    assert store.files[FILE].data == b""


@pytest.mark.holds("promise 6")
async def test_growth_shows_when_a_file_is_opened_too_and_force_goes_on(store: FakeWriter) -> None:
    tree, forced = make_writable(store), make_writable(store, force=True)
    for each in (tree, forced):
        await each.stat(FILE)
    store.files[FILE].data += b"more"
    with pytest.raises(FileBusy):
        await tree.open(FILE, write=True)
    file = await forced.open(FILE, write=True)
    assert file.size == len(DATA) + 4
    await file.release()


# --- files without a name


async def test_a_file_that_is_read_is_hidden_until_it_is_closed(store: FakeWriter, tree: Tree) -> None:
    store.files[FILE].data = DATA * 10
    file = await tree.open(FILE)
    assert await file.read(0, 10) == DATA[:10]
    await tree.unlink(FILE)
    (hidden,) = store.files
    assert is_reserved(split(hidden)[1])
    assert await tree.list(b"/card/dir") == []
    with pytest.raises(NotFound):
        await tree.stat(hidden)
    assert await file.read(0, len(DATA) * 10) == DATA * 10
    with pytest.raises(FileBusy):
        await tree.rmdir(b"/card/dir")
    await file.release()
    assert store.files == {}
    await tree.rmdir(b"/card/dir")


async def test_a_hidden_file_follows_its_directory(store: FakeWriter, tree: Tree) -> None:
    store.files[FILE].data = DATA * 10
    file = await tree.open(FILE)
    await tree.unlink(FILE)
    await tree.rename(b"/card/dir", b"/card/other")
    assert await file.read(0, len(DATA) * 10) == DATA * 10
    await file.release()
    assert store.files == {}


async def test_open_files_below_a_renamed_directory_follow(store: FakeWriter, tree: Tree) -> None:
    writer = await tree.create(b"/card/dir/new", exclusive=True)
    await writer.write(0, b"abc")
    reader = await tree.open(FILE)
    await tree.rename(b"/card/dir", b"/card/there")
    assert await reader.read(0, len(DATA)) == DATA
    await writer.write(3, b"def")
    await writer.release()
    assert store.files[b"/card/there/new"].data == b"abcdef"
    assert (await tree.stat(b"/card/there/new")).size == 6
    with pytest.raises(NotFound):
        await tree.stat(b"/card/dir/new")
