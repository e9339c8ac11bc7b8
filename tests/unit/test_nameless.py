"""A file without a name that is still open: its bytes wait for no vehicle, and hold no other writer back."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.throttle import STALL
from mavftpfs.cache.tree import Tree
from tests.support.fake_writer import KINDS, FakeWriter, card, make_writable, write_file

KIB = 1024
DIRTY = 256 * KIB
FILE = b"/card/dir/file.txt"
NEW = b"/card/dir/new"
OLD = bytes(range(256)) * 2000
PIECES = 48
PIECE = 32 * KIB

LoseName = Callable[[Tree], Awaitable[None]]


store = card({FILE: OLD})


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    return make_writable(store, dirty_max=DIRTY)


async def unlink(tree: Tree) -> None:
    await tree.unlink(NEW)


async def rename_over(tree: Tree) -> None:
    await write_file(tree, b"/card/dir/other", b"it")
    await tree.rename(b"/card/dir/other", NEW, noreplace=False)


def piece(number: int) -> bytes:
    return bytes([number + 1]) * PIECE


async def fill(file: OpenFile, first: int = 0) -> None:
    for number in range(first, PIECES):
        await file.write(number * PIECE, piece(number))


async def assert_filled(file: OpenFile) -> None:
    assert file.size == PIECES * PIECE
    for number in range(PIECES):
        assert await file.read(number * PIECE, PIECE) == piece(number)


@pytest.mark.parametrize("lose_name", [unlink, rename_over])
async def test_much_more_than_dirty_max_is_written_and_read_back(
    autojump_clock: object, store: FakeWriter, tree: Tree, lose_name: LoseName
) -> None:
    file = await tree.create(NEW, exclusive=True)
    await lose_name(tree)
    there = {path: node.data for path, node in store.files.items()}
    before = trio.current_time()
    await fill(file)
    assert trio.current_time() - before < STALL
    held = tree.status()
    assert held["bytes_held"] >= PIECES * PIECE  # type: ignore[operator]
    assert held["bytes_held_on_disk"] > 0  # type: ignore[operator]
    await assert_filled(file)
    await file.flush()
    await file.fsync()
    await file.release()
    assert {path: node.data for path, node in store.files.items()} == there
    assert tree.undelivered() == []
    assert tree.status()["bytes_held"] == 0


async def test_it_holds_no_other_writer_back(autojump_clock: object, store: FakeWriter, tree: Tree) -> None:
    nameless = await tree.create(NEW, exclusive=True)
    await tree.unlink(NEW)
    await fill(nameless)
    other = await tree.create(NEW, exclusive=True)
    before = trio.current_time()
    await fill(other)
    assert trio.current_time() - before < STALL
    await other.release()
    assert store.files[NEW].data == b"".join(piece(number) for number in range(PIECES))
    await assert_filled(nameless)
    await nameless.release()
    assert len(store.files[NEW].data) == PIECES * PIECE


async def test_a_writer_who_waits_when_the_name_goes_is_let_go(
    autojump_clock: object, store: FakeWriter, tree: Tree, nursery: trio.Nursery
) -> None:
    store.write_delay = 1.0  # of each chunk: it would wait for more than an hour
    file = await tree.create(NEW, exclusive=True)
    ended: list[float] = []

    async def write() -> None:
        await fill(file)
        ended.append(trio.current_time())

    nursery.start_soon(write)
    await trio.sleep(20)
    assert not ended
    await tree.unlink(NEW)
    removed = trio.current_time()
    await trio.sleep(2 * STALL)
    assert len(ended) == 1
    assert ended[0] < removed + STALL
    await assert_filled(file)
    await file.release()
    assert NEW not in store.files


# --- the last reader closes it at any moment


async def rename_over_directory(tree: Tree) -> None:
    await tree.unlink(FILE)
    await tree.rename(b"/card/dir", b"/card/moved", noreplace=False)


async def replace_by_other(tree: Tree) -> None:
    await tree.rename(b"/card/other", FILE, noreplace=False)


LOSE: dict[str, LoseName] = {
    "unlink": lambda tree: tree.unlink(FILE),
    "rename over": replace_by_other,
    "directory renamed": rename_over_directory,
}


@pytest.mark.parametrize("kind", ["posix", "fat"])
@pytest.mark.parametrize("how", sorted(LOSE))
async def test_nothing_stays_when_the_last_reader_closes(
    nursery: trio.Nursery, autojump_clock: object, how: str, kind: str
) -> None:
    """Whatever request is under way then."""
    for request in range(1, 12):
        store = FakeWriter(KINDS[kind], nursery)
        store.write_delay = 1.0
        store.add(FILE, OLD)
        store.add(b"/card/other", b"it")
        tree = make_writable(store)
        reading = await tree.open(FILE)
        await reading.read(0, 1)
        asked = Asked(store, request)
        async with trio.open_nursery() as programs:
            programs.start_soon(close_beside, asked, reading)
            await LOSE[how](tree)
            reached = asked.event.is_set()
        await trio.sleep(5)
        assert [path for path in store.files if b".mavftpfs-" in path] == []
        assert store.crimes == []
        if not reached:
            break
    assert 1 < request < 11


class Asked:
    """Tells when the vehicle is asked for the n-th time."""

    def __init__(self, store: FakeWriter, number: int) -> None:
        self.event = trio.Event()
        self._left = number
        store.before_request = self._count

    def _count(self, *what: object) -> None:
        self._left -= 1
        if not self._left:
            self.event.set()


async def close_beside(asked: Asked, reading: OpenFile) -> None:
    """Close while the vehicle works on a request, or long after."""
    with trio.move_on_after(20):
        await asked.event.wait()
        await trio.sleep(0.5)
    await reading.release()
