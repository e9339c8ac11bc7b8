"""Delivering while nobody waits: uploads that begin again, back-pressure without one, and redelivery."""

from __future__ import annotations

import errno

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.cache.writeback import PAUSES
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, VehicleLost
from tests.support.fake_writer import KINDS, FakeWriter, card, make_writable

OLD = bytes(range(256)) * 400
FILE = b"/card/dir/file.txt"
NEW = b"/card/new"
KIB = 1024


store = card({FILE: OLD})


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    return make_writable(store, dirty_max=128 * KIB)


def refuse_opens(store: FakeWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have no upload opened while the vehicle is lost, as the session does."""
    honest = store.open_upload

    async def open_upload(*args: object, **kwargs: object) -> object:
        store.require_link()
        return await honest(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "open_upload", open_upload)


async def fill(file: OpenFile, start: int, count: int) -> None:
    for number in range(count):
        await file.write(start + number * 32 * KIB, bytes(32 * KIB))


# --- uploads that could not begin


async def test_a_lost_link_holds_writers_back_before_any_upload_began(
    store: FakeWriter, tree: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_opens(store, monkeypatch)
    file = await tree.create(NEW, exclusive=True)
    store.lost = True
    with pytest.raises(VehicleLost):
        await fill(file, 0, 100)
    taken = file.size
    assert taken <= 128 * KIB + 32 * KIB
    store.lost = False
    await fill(file, taken, 20)
    await file.release()
    assert len(store.files[NEW].data) == taken + 20 * 32 * KIB


async def test_what_can_only_go_at_the_close_holds_nobody_back(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    """A part of a file that has to be sent whole: the local disk takes it."""
    store = FakeWriter(KINDS["mavsdk"], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store, dirty_max=64 * KIB)
    file = await tree.open(FILE, write=True)
    before = trio.current_time()
    for at in range(0, 80 * KIB, 8 * KIB):
        await file.write(at + 1000, b"x" * 8 * KIB)
    assert trio.current_time() - before < 1
    assert not [entry for entry in store.log if entry[0] == "write"]
    await file.release()
    assert store.files[FILE].data[1000:1008] == b"x" * 8
    nursery.cancel_scope.cancel()


# --- redelivery


async def close_in_vain(tree: Tree) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"content")
    with pytest.raises(MavftpfsError):
        await file.release()


async def test_what_a_close_did_not_deliver_is_delivered_without_news(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    """The link failed and returned between two looks at it."""
    store.fail_at[1] = RequestTimeout("silence")
    await close_in_vain(tree)
    assert tree.undelivered() == [NEW]
    await trio.sleep(2 * PAUSES[0])
    assert tree.undelivered() == []
    assert store.files[NEW].data == b"content"
    assert list(tree._writing._context.nodes) == []


async def test_attempts_grow_seldom_and_go_on(autojump_clock: object, store: FakeWriter, tree: Tree) -> None:
    await tree.list(b"/card")
    asked: list[float] = []

    def note(*_: object) -> None:
        asked.append(trio.current_time())
        store.lost = store.lost or len(asked) == 1

    store.before_request = note
    await close_in_vain(tree)
    await trio.sleep(1000)
    times = sorted(set(asked))
    assert 30 < len(times) < 60
    assert times[-1] - times[-2] == pytest.approx(PAUSES[1], abs=2)
    store.lost = False
    await trio.sleep(2 * PAUSES[1])
    assert tree.undelivered() == []
    count = len(asked)
    await trio.sleep(1000)
    assert len(asked) == count, "it ended"
    store.before_request = None
    store.files.clear()
    tree.forget_caches()
    store.fail_at[store.requests + 1] = RequestTimeout("silence")
    await close_in_vain(tree)
    await trio.sleep(2 * PAUSES[0])
    assert tree.undelivered() == [], "the next one begins anew"


async def test_a_refusal_is_not_repeated_before_there_is_news(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    denied = FtpNak(Opcode.CREATE_FILE, NakCode.FAIL_ERRNO, errno.EACCES)
    store.fail_at = dict.fromkeys(range(1, 20), denied)
    await close_in_vain(tree)
    requests = store.requests
    await trio.sleep(1000)
    assert store.requests == requests
    store.fail_at.clear()
    tree.link_back()
    await trio.sleep(1)
    assert tree.undelivered() == []


async def test_an_open_file_is_left_to_its_program(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"content")
    store.fail_at[1] = RequestTimeout("silence")
    with pytest.raises(RequestTimeout):
        await file.fsync()
    await trio.sleep(100)
    assert tree.undelivered() == [NEW]
    store.lost = True
    with pytest.raises(VehicleLost):
        await file.release()
    store.lost = False
    await trio.sleep(2 * PAUSES[1])
    assert tree.undelivered() == []
