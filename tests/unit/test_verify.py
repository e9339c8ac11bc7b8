"""What is compared after a delivery, by the option verify= and by what is known of the content."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import (
    Armed,
    VerificationFailed,
)
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, make_writable, write_file

pytestmark = pytest.mark.holds("promise 2")

OLD = bytes(range(256)) * 400
FILE = b"/card/dir/file.txt"
PART = (100, b"changed")


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["posix"], nursery)
    store.traits.wo_truncates = False
    store.add(FILE, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


async def change(tree: Tree, *parts: tuple[int, bytes]) -> None:
    file = await tree.open(FILE, write=True)
    try:
        for offset, data in parts:
            await file.write(offset, data)
        await file.release()
    finally:
        file.close()


async def test_a_checksum_is_given_the_time_that_the_size_needs(store: FakeWriter) -> None:
    tree = make_writable(store)
    await write_file(tree, FILE, b"x" * 5000)
    assert store.crc_sizes == [5000]


@pytest.mark.parametrize("kind", ["posix", "fat", "mavsdk"])
async def test_what_was_sent_and_cut_off_is_not_there_though_nothing_is_verified(
    nursery: trio.Nursery, autojump_clock: object, kind: str
) -> None:
    store = FakeWriter(KINDS[kind], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store, verify="none")
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, b"n" * 100_000)
    await trio.sleep(20)
    assert store.used > len(OLD), "it is sent while the program writes"
    await file.truncate(50_000)
    await file.release()
    assert store.files[FILE].data == b"n" * 50_000
    nursery.cancel_scope.cancel()


async def test_an_empty_file_has_no_checksum_worth_asking(store: FakeWriter) -> None:
    tree = make_writable(store)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.release()
    assert store.count("crc") == 0


async def test_a_size_that_differs_is_enough(store: FakeWriter) -> None:
    def cut(what: object, *paths: bytes) -> None:
        if what == "terminate":
            store.before_request = None
            store.files[paths[0]].data = b"cut"

    store.before_request = cut
    tree = make_writable(store, verify="size")
    await write_file(tree, b"/card/new", b"x" * 5000)
    assert store.before_request is None
    assert store.files[b"/card/new"].data == b"x" * 5000


async def test_zeros_that_were_cut_off_are_noticed_though_the_checksum_is_right(store: FakeWriter) -> None:
    def cut(what: object, *paths: bytes) -> None:
        if what == "terminate":
            store.before_request = None
            store.files[paths[0]].data = bytes(300)

    store.before_request = cut
    await write_file(make_writable(store), b"/card/new", bytes(5000))
    assert store.before_request is None
    assert store.files[b"/card/new"].data == bytes(5000)


async def test_a_checksum_that_is_not_asked_for_in_flight_sends_nothing_again(store: FakeWriter) -> None:
    """A second copy could not be checked either."""
    store.fail[("crc", b"*")] = [Armed("flying")]
    tree = make_writable(store, verify="crc", write_armed=True)
    with pytest.raises(VerificationFailed):
        await write_file(tree, b"/card/new", b"x" * 5000)
    assert store.count("crc") == 1


@pytest.mark.parametrize("path", [b"/card/new", FILE])
async def test_armed_while_the_checksum_is_asked_for(
    autojump_clock: object, store: FakeWriter, monkeypatch: pytest.MonkeyPatch, path: bytes
) -> None:
    """As at any other moment (promise 9); what is there is compared after it was disarmed."""
    tree, ask = make_writable(store, verify="crc"), store.crc32

    async def ask_in_flight(path: bytes, *, size: int | None = None) -> int:
        tree.armed_changed(True)
        store.armed = True
        return await ask(path, size=size)

    with monkeypatch.context() as patch:
        patch.setattr(store, "crc32", ask_in_flight)
        with pytest.raises(Armed):
            await write_file(tree, path, b"x" * 5000)
    sent = [what for what in store.log if what[0] == "write"]
    store.armed = False
    tree.armed_changed(False)
    await trio.sleep(60)
    assert tree.undelivered() == []
    assert store.files[path].data == b"x" * 5000
    assert [what for what in store.log if what[0] == "write"] == sent
    assert set(store.files) == {FILE, path}


@pytest.mark.parametrize("part", [PART, (0, OLD[::-1])])
async def test_what_is_remembered_of_a_file_goes_with_its_old_bytes(
    store: FakeWriter, part: tuple[int, bytes]
) -> None:
    """Its size stays the same, and no listing tells a time."""
    tree = make_writable(store)
    assert await tree.crc32(FILE) == crc32(OLD)
    assert await read_file(tree, FILE) == OLD
    await change(tree, part)
    new = OLD[: part[0]] + part[1] + OLD[part[0] + len(part[1]) :]
    assert await tree.crc32(FILE) == crc32(new)
    assert await read_file(tree, FILE) == new


@pytest.mark.parametrize("restarts", [False, True])
async def test_what_was_written_is_believed_from_the_moment_when_it_was_verified(
    autojump_clock: object, store: FakeWriter, restarts: bool
) -> None:
    """Not from when the program closed it: somebody else may have changed it before that."""
    tree = make_writable(store, dir_timeout=20)
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, OLD)
    await file.fsync()
    await trio.sleep(0 if restarts else 15)
    store.files[FILE].data = OLD[::-1]
    if restarts:
        tree.rebooted()
    await file.release()
    await trio.sleep(0 if restarts else 15)
    assert await read_file(tree, FILE) == OLD[::-1]
