"""A delivery that is called off because the file's name was to go, and goes on because it did not.

How names go in mid-delivery on every simulated server: tests/sim/test_overtaken.py.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable
from typing import TypeVar

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout
from mavftpfs.shared.model import Listing, split
from tests.support.deliveries import in_the_middle
from tests.support.fake_writer import CHUNK, KINDS, FakeWriter, Kind, litter, make_writable

FILE, NEW, OTHER = b"/card/dir/file.txt", b"/card/dir/new", b"/card/dir/other"
OLD = bytes(range(256)) * 20
DATA = bytes(reversed(range(256))) * 30
LARGE = DATA * 13
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


async def begun(tree: Tree, store: FakeWriter, path: bytes, data: bytes = DATA) -> OpenFile:
    """Return a file with a few of its bytes on their way."""
    file = await (
        tree.create(path, exclusive=True) if path == NEW else tree.open(path, write=True, truncate=True)
    )
    store.write_delay = 0.1
    await file.write(0, data)
    return file


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("error", [DENIED, SILENCE])
async def test_a_name_that_stays_gets_its_file(
    autojump_clock: object, store: FakeWriter, error: MavftpfsError
) -> None:
    """The program hears 0 when the card has it, as if nobody had tried."""
    tree, path = make_writable(store), FILE
    file = await begun(tree, store, path)
    async with in_the_middle(file, waiting=2):

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


# --- at any moment

Answer = TypeVar("Answer")


class Held(FakeWriter):
    """Keeps back an answer, so that the test decides what happens in the moment when it comes.

    Attributes:
        left: how many answers more until then.
    """

    def __init__(self, kind: Kind, nursery: trio.Nursery) -> None:
        super().__init__(kind, nursery)
        self.add(FILE, OLD)
        self.add(OTHER, OLD)
        self.held, self.go = trio.Event(), trio.Event()
        self.left = 0

    async def late(self, asked: Awaitable[Answer]) -> Answer:
        answer = await asked
        self.left -= 1
        if self.left == 0:
            self.held.set()
            await self.go.wait()
        return answer

    async def request(self, *what: object, in_flight: bool = False) -> None:
        await self.late(super().request(*what, in_flight=in_flight))

    async def stat_size(self, path: bytes) -> int:
        return await self.late(super().stat_size(path))

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        return await self.late(super().crc32(path, size=size))

    async def list_directory(self, path: bytes) -> Listing:
        return await self.late(super().list_directory(path))


async def take_when_answered(kind: str, path: bytes, nth: int, nursery: trio.Nursery) -> bool:
    """Remove a file in the moment when who delivers it has the nth answer, and did not go on yet; return
    False if that needs fewer."""
    store = Held(KINDS[kind], nursery)
    tree = make_writable(store, verify="none")
    file = await begun(tree, store, path)
    store.write_delay, store.linger = 0.0, 0.5
    store.left = nth
    async with trio.open_nursery() as waiting:
        waiting.start_soon(file.fsync)
        with trio.move_on_after(60) as scope:
            await store.held.wait()
        if scope.cancelled_caught:
            return False
        store.go.set()
        await tree.unlink(path)
    assert bytes(await file.read(0, len(DATA))) == DATA
    await file.release()
    for _ in range(2):
        await trio.sleep(60)
        await tree.list(split(path)[0])
    assert set(store.files) == {FILE, OTHER} - {path}, f"answer {nth}"
    assert store.crimes == []
    return True


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("kind", ["posix", "fat", "mavsdk"])
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_name_goes_in_the_moment_of_any_answer(
    autojump_clock: object, nursery: trio.Nursery, path: bytes, kind: str
) -> None:
    """Called off, the delivery may have got what it waited for, and may just be about to go on."""
    nth = 1
    while await take_when_answered(kind, path, nth, nursery):
        nth += 1
    assert nth > len(DATA) // CHUNK
    nursery.cancel_scope.cancel()


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_removal_that_was_given_up_loses_nothing(
    autojump_clock: object, store: FakeWriter, path: bytes
) -> None:
    """It had ended the upload: what that left on the vehicle is ours."""
    tree = make_writable(store)
    file = await begun(tree, store, path, LARGE)
    await trio.sleep(1.05)
    with trio.move_on_after(0.01) as scope:
        await tree.unlink(path)
    assert scope.cancelled_caught
    store.write_delay = 0.0
    await trio.sleep(5)
    await file.fsync()
    assert store.files[path].data == LARGE
    await file.release()
    await trio.sleep(60)
    await tree.list(split(path)[0])
    assert litter(store) == []


@pytest.mark.parametrize("more", [b"", b"more"])
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_delivery_that_was_given_up_at_its_very_end_goes_on(
    autojump_clock: object, store: FakeWriter, path: bytes, more: bytes
) -> None:
    """Nobody waits for the end of the upload any more, which takes nothing more."""
    tree = make_writable(store)
    file = await begun(tree, store, path)
    store.write_delay, store.linger = 0.0, 1.0
    with trio.move_on_after(0.5) as scope:
        await file.fsync()
    assert scope.cancelled_caught
    await file.write(len(DATA), more)
    await file.release()
    assert tree.undelivered() == []
    assert store.files[path].data == DATA + more
