"""A delivery that is called off because the file's name was to go, and goes on because it did not.

How names go in mid-delivery on every simulated server: tests/sim/test_calling_off.py.
"""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.asides import is_reserved
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import AlreadyExists, FtpNak, MavftpfsError, NotFound, RequestTimeout
from mavftpfs.shared.model import split
from tests.support.fake_writer import KINDS, FakeWriter, make_writable, write_file

FILE, NEW, OTHER = b"/card/dir/file.txt", b"/card/dir/new", b"/card/dir/other"
OLD = bytes(range(256)) * 20
DATA = bytes(reversed(range(256))) * 30
DENIED = FtpNak(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, 13)
SILENCE = RequestTimeout("no answer")


@pytest.fixture(params=["posix", "fat", "mavsdk"])
async def store(
    nursery: trio.Nursery, autojump_clock: object, request: pytest.FixtureRequest
) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS[request.param], nursery)
    for path in (FILE, OTHER):
        store.add(path, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


async def begun(tree: Tree, store: FakeWriter, path: bytes) -> OpenFile:
    """Return a file with a few of its bytes on their way."""
    file = await (
        tree.create(path, exclusive=True) if path == NEW else tree.open(path, write=True, truncate=True)
    )
    await file.write(0, DATA)
    store.write_delay = 0.1
    return file


def litter(store: FakeWriter) -> list[bytes]:
    return [path for path in store.files if is_reserved(split(path)[1])]


@pytest.mark.parametrize("error", [DENIED, SILENCE])
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_name_that_stays_gets_its_file(
    autojump_clock: object, store: FakeWriter, path: bytes, error: MavftpfsError
) -> None:
    """The program hears 0 when the card has it, as if nobody had tried."""
    tree = make_writable(store)
    file = await begun(tree, store, path)
    async with trio.open_nursery() as waiting:
        for _ in range(2):
            waiting.start_soon(file.fsync)
        await trio.sleep(1.05)

        def fail(what: object, *names: object) -> None:
            if what == "remove" and names == (path,):
                raise error

        store.before_request = fail
        with pytest.raises(type(error)):
            await tree.unlink(path)
        store.before_request = None
        assert store.files[path].data != DATA
    assert store.files[path].data == DATA
    assert tree.undelivered() == []
    await file.release()
    await tree.list(split(path)[0])
    assert litter(store) == []


async def test_a_rename_that_may_not_replace_stops_nothing(autojump_clock: object, store: FakeWriter) -> None:
    tree = make_writable(store)
    file = await begun(tree, store, NEW)
    async with trio.open_nursery() as waiting:
        waiting.start_soon(file.fsync)
        await trio.sleep(1.05)
        with pytest.raises(AlreadyExists):
            await tree.rename(OTHER, NEW, noreplace=True)
    assert len(store.uploads) == 1
    assert store.files[NEW].data == DATA
    await file.release()


async def test_a_file_that_is_being_renamed_can_be_removed(autojump_clock: object, store: FakeWriter) -> None:
    """Whoever is first at the vehicle: the file is gone, by this name and by the other."""
    tree = make_writable(store)
    file = await begun(tree, store, NEW)
    async with trio.open_nursery() as both:

        async def rename() -> None:
            with pytest.raises(NotFound):
                await tree.rename(NEW, b"/card/dir/newer")

        both.start_soon(rename)
        await trio.sleep(1.05)
        before = trio.current_time()
        await tree.unlink(NEW)
        assert trio.current_time() - before < 1.0
    assert set(store.files) == {FILE, OTHER}
    assert bytes(await file.read(0, len(DATA))) == DATA
    await file.release()


async def test_an_upload_that_is_about_to_begin_by_itself_is_called_off(
    autojump_clock: object, store: FakeWriter
) -> None:
    """Nobody waits for it: the first it does is to try what the server does to open files."""
    tree = make_writable(store, dirty_max=64 * 1024)
    file = await tree.open(FILE, write=True)
    store.write_delay = 5.0
    await file.write(100, bytes(64 * 1024))
    await trio.sleep(0.1)
    before = trio.current_time()
    await tree.unlink(FILE)
    assert trio.current_time() - before < 1.5 * store.write_delay  # the file gets a hidden name, no more
    store.write_delay = 0.0
    await trio.sleep(60)
    assert await file.read(0, 100) == OLD[:100]
    await file.release()
    await tree.list(split(FILE)[0])
    assert set(store.files) == {OTHER}


async def test_a_name_that_went_is_free_for_another_file(autojump_clock: object, store: FakeWriter) -> None:
    tree = make_writable(store)
    file = await begun(tree, store, FILE)
    async with trio.open_nursery() as waiting:
        waiting.start_soon(file.fsync)
        await trio.sleep(1.05)
        await tree.unlink(FILE)
        store.write_delay = 0.0
        await write_file(tree, FILE, b"another")
    await file.write(0, b"!")
    await file.release()
    await trio.sleep(60)
    assert store.files[FILE].data == b"another"
    assert litter(store) == []
