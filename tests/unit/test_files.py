"""Open files: what is kept, what is asked again, what an old handle sees, and doubtful bytes."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator

import pytest
import trio
import trio.testing

from mavftpfs.cache.files import MAX_CLOSED
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import (
    DataUnproven,
    FileChanged,
    IsADirectory,
    LocalProtocolError,
    NotFound,
    VehicleLost,
)
from tests.support.fake_store import FakeStore, make_tree, read_file

KIB = 1024
MIB = 1024 * KIB
LOG = b"/logs/a.bin"


def content(size: int, seed: int = 7) -> bytes:
    return random.Random(seed).randbytes(size + -size % 4)[:size]  # shorter ones are prefixes of longer ones


DATA = content(300_000)


@pytest.fixture
async def store(nursery: trio.Nursery) -> AsyncIterator[FakeStore]:
    store = FakeStore(nursery)
    store.chunk = 16 * KIB
    store.add(LOG, DATA, 1_700_000_000)
    yield store
    assert store.crimes == []


@pytest.fixture
def tree(store: FakeStore) -> Tree:
    return make_tree(store)


# --- reading


async def test_a_read_larger_than_the_cache_is_served_in_pieces(store: FakeStore) -> None:
    big = content(5 * MIB)
    store.add(b"/big", big)
    tree = make_tree(store, cache_size=MIB)
    handle = await tree.open(b"/big")
    assert await handle.read(0, len(big)) == big
    handle.close()
    assert int(str(tree.status()["bytes_cached"])) <= MIB


async def test_a_second_reader_of_the_file_shares_blocks_and_session(store: FakeStore, tree: Tree) -> None:
    first, second = await tree.open(LOG), await tree.open(LOG)
    async with trio.open_nursery() as readers:
        readers.start_soon(first.read, 0, len(DATA))
        readers.start_soon(second.read, 0, len(DATA))
    assert store.count("reader") == store.count("open") == 1
    first.close()
    assert not store.readers[0].closed
    second.close()
    second.close()
    assert store.readers[0].closed
    assert store.readers[0].drops == 1
    with pytest.raises(LocalProtocolError):
        await second.read(0, 1)
    assert tree._files.open_versions == {}


async def test_sequential_reads_fetch_ahead_and_release_drops_it(store: FakeStore, tree: Tree) -> None:
    store.add(b"/big", content(8 * MIB))
    handle = await tree.open(b"/big")
    for at in range(0, 512 * KIB, 128 * KIB):
        await handle.read(at, 128 * KIB)
    reader = store.readers[0]
    assert not reader.ahead.empty
    await handle.read(7 * MIB, 4 * KIB)
    assert reader.drops == 1
    await handle.read(512 * KIB, 4 * KIB)
    assert reader.drops == 1
    handle.close()
    assert reader.ahead.empty


@pytest.mark.holds("promise 6", "rule 14.30")
async def test_a_directory_is_not_opened(tree: Tree) -> None:
    with pytest.raises(IsADirectory):
        await tree.open(b"/logs")
    with pytest.raises(IsADirectory):
        await tree.open(b"/")
    with pytest.raises(NotFound):
        await tree.open(b"/logs/none")


# --- close-to-open


async def test_equal_size_and_mtime_prove_the_cache_for_ever(store: FakeStore, tree: Tree) -> None:
    await read_file(tree, LOG)
    await trio.sleep(1000)
    handle = await tree.open(LOG)
    assert handle.keep_cache
    assert await handle.read(0, len(DATA)) == DATA
    assert store.count("open") == 1
    assert store.count("list", b"/logs") == 2


async def test_without_mtime_the_proof_lasts_dir_timeout(store: FakeStore, tree: Tree) -> None:
    store.add(LOG, DATA)
    await read_file(tree, LOG)
    await trio.sleep(19)
    (await tree.open(LOG)).close()
    assert store.count("open") == 1
    await trio.sleep(1.5)
    store.files[LOG].data = DATA[::-1]
    handle = await tree.open(LOG)
    assert not handle.keep_cache
    assert await handle.read(0, len(DATA)) == DATA[::-1]
    assert store.count("open") == 2


@pytest.mark.parametrize("grown", [False, True])
async def test_a_newer_listing_can_end_a_recent_proof(store: FakeStore, tree: Tree, grown: bool) -> None:
    store.add(LOG, DATA)
    await read_file(tree, LOG)
    await trio.sleep(5)
    tree._directories.rebooted()
    if grown:
        store.add(LOG, DATA + b"more")
    handle = await tree.open(LOG)
    assert handle.keep_cache is not grown
    assert handle.size == len(store.files[LOG].data)
    assert store.count("open") == (2 if grown else 1)


async def test_a_changed_mtime_starts_a_new_version(store: FakeStore, tree: Tree) -> None:
    old = await tree.open(LOG)
    await old.read(0, 100)
    store.add(LOG, DATA[::-1], 1_700_000_001)
    await trio.sleep(21)
    new = await tree.open(LOG)
    assert set(store.invalidated) == {LOG}
    assert not new.keep_cache
    assert await new.read(0, len(DATA)) == DATA[::-1]
    for _ in range(2):
        with pytest.raises(FileChanged):
            await old.read(0, 100)
    old.close()
    assert await new.read(5, 5) == DATA[::-1][5:10]


async def test_a_smaller_ack_is_another_file_even_if_the_listing_is_old(store: FakeStore) -> None:
    tree = make_tree(store, dir_timeout=5)
    store.list_delay = 2  # the listing stays fresh for 100 s, the proof for 5
    store.add(LOG, DATA)
    old = await tree.open(LOG)
    await old.read(0, 100)
    store.add(LOG, b"short")
    await trio.sleep(6)
    new = await tree.open(LOG)
    assert new.size == 5
    assert (await tree.stat(LOG)).size == 5
    with pytest.raises(FileChanged):
        await old.read(0, 100)


@pytest.mark.holds("fault growing file", "rule 14.21")
async def test_a_grown_file_is_served_at_its_opened_size(store: FakeStore, tree: Tree) -> None:
    store.add(LOG, DATA)
    old = await tree.open(LOG)
    await old.read(0, 100)
    store.add(LOG, DATA + b"more")
    await trio.sleep(21)
    new = await tree.open(LOG)
    assert (old.size, new.size) == (len(DATA), len(DATA) + 4)
    assert await new.read(len(DATA), 100) == b"more"
    assert await old.read(0, 10**6) == DATA
    assert await old.read(len(DATA), 100) == b""
    held = int(str(tree.status()["bytes_cached"]))
    old.close()
    assert int(str(tree.status()["bytes_cached"])) == held - len(DATA)
    new.close()
    assert all(reader.closed for reader in store.readers)


@pytest.mark.holds("fault replaced file")
async def test_versions_do_not_meet_in_the_kernels_page_cache(store: FakeStore, tree: Tree) -> None:
    old = await tree.open(LOG)
    assert not old.direct_io
    store.add(LOG, DATA + b"more", 1_700_000_009)
    await trio.sleep(21)
    new = await tree.open(LOG)
    assert new.direct_io
    new.close()
    assert (await tree.open(LOG)).direct_io
    await old.read(0, 100)
    old.close()
    newest = await tree.open(LOG)
    assert not newest.direct_io
    assert not newest.keep_cache
    assert (await tree.open(LOG)).keep_cache


async def test_the_ack_beats_the_listing(store: FakeStore, tree: Tree) -> None:
    await tree.stat(LOG)
    store.add(LOG, DATA + b"more", 1_700_000_009)
    handle = await tree.open(LOG)
    assert handle.size == len(DATA) + 4
    assert (await tree.stat(LOG)).size == len(DATA) + 4
    assert store.invalidated == [LOG]
    assert await handle.read(len(DATA), 10) == b"more"
    handle.close()
    again = await tree.open(LOG)
    assert again.keep_cache


@pytest.mark.holds("rule 14.27")
async def test_a_size_that_does_not_fit_the_ack_is_an_error_not_a_short_file(
    store: FakeStore, tree: Tree
) -> None:
    store.files[LOG].claims = (1 << 32) + len(DATA)
    with pytest.raises(DataUnproven):
        await tree.open(LOG)
    assert all(reader.closed for reader in store.readers)


async def open_partly_cached(store: FakeStore, tree: Tree) -> OpenFile:
    """Open a large file again of which the beginning was read."""
    store.add(b"/big", content(MIB), 5)
    handle = await tree.open(b"/big")
    await handle.read(0, 4 * KIB)
    handle.close()
    return await tree.open(b"/big")


@pytest.mark.holds("fault idle close", "rule 14.9")
async def test_a_partly_cached_file_is_opened_again_only_when_bytes_are_wanted(
    store: FakeStore, tree: Tree
) -> None:
    handle = await open_partly_cached(store, tree)
    assert store.count("open", b"/big") == 1
    await handle.read(512 * KIB, 4 * KIB)
    assert store.count("open", b"/big") == 2


async def test_a_file_that_shrank_before_it_was_opened_again(store: FakeStore, tree: Tree) -> None:
    handle = await open_partly_cached(store, tree)
    store.add(b"/big", b"short", 6)
    with pytest.raises(FileChanged):
        await handle.read(512 * KIB, 4 * KIB)
    with pytest.raises(FileChanged):
        await handle.read(0, 4)
    assert b"/big" in store.invalidated
    handle.close()
    assert await read_file(tree, b"/big") == b"short"


async def test_closed_files_are_bounded(store: FakeStore, tree: Tree) -> None:
    for i in range(MAX_CLOSED + 3):
        store.add(b"/many/%d" % i, b"x", 5)
    for i in range(MAX_CLOSED + 3):
        (await tree.open(b"/many/%d" % i)).close()
    assert (await tree.open(b"/many/%d" % (MAX_CLOSED + 2))).keep_cache
    assert not (await tree.open(b"/many/1")).keep_cache


# --- reboot


@pytest.mark.holds("promise 5")
async def test_a_file_that_is_gone_after_a_reboot(store: FakeStore, tree: Tree) -> None:
    handle = await tree.open(LOG)
    await handle.read(0, 1000)
    store.remove(LOG)
    tree.rebooted()
    with pytest.raises(FileChanged):
        await handle.read(0, 1000)


async def test_a_reboot_with_the_link_still_down_proves_nothing(store: FakeStore, tree: Tree) -> None:
    handle = await tree.open(LOG)
    await handle.read(0, 1000)
    await trio.sleep(1)
    tree.rebooted()
    store.lost = True
    tree.link_lost()
    with pytest.raises(VehicleLost):
        await handle.read(0, 1000)
    store.lost = False
    tree.link_back()
    assert await handle.read(0, 1000) == DATA[:1000]


async def test_after_a_reboot_recency_is_no_proof(store: FakeStore, tree: Tree) -> None:
    store.add(LOG, DATA)
    await read_file(tree, LOG)
    tree.rebooted()
    handle = await tree.open(LOG)
    assert not handle.keep_cache
    assert store.count("open") == 2
    handle.close()


# --- doubtful bytes (promise 1)


def spoil(path: bytes, offset: int, data: bytes) -> bytes:
    return bytes(byte ^ 0xFF for byte in data)


async def test_wrong_bytes_are_fetched_again(store: FakeStore, tree: Tree) -> None:
    store.suspect_chunks, store.spoil = 2, spoil
    handle = await tree.open(LOG)
    assert await handle.read(0, 40_000) == DATA[:40_000]
    assert await handle.read(0, len(DATA)) == DATA
    assert set(store.invalidated) == {LOG}


async def test_bytes_that_stay_suspect_are_an_error(store: FakeStore, tree: Tree) -> None:
    """In time: a handler waits for 33 s."""
    began = trio.current_time()
    store.suspect_chunks, store.spoil = 10**6, spoil
    handle = await tree.open(LOG)
    with pytest.raises(DataUnproven):
        await handle.read(0, 100)
    assert trio.current_time() < began + 20
    store.suspect_chunks = 0
    assert await handle.read(0, len(DATA)) == DATA


async def test_a_closed_file_whose_bytes_were_dropped_is_read_again_without_a_listing(
    store: FakeStore, tree: Tree
) -> None:
    """A tree is read twice over a link that doubles: with a listing for each file that took minutes."""
    handle = await tree.open(LOG)
    await handle.read(0, len(DATA))
    sink = store.readers[0].sink
    handle.close()
    sink.on_suspect("late news")
    assert store.invalidated == [LOG]
    listings = store.count("list")
    assert await read_file(tree, LOG) == DATA
    assert store.count("list") == listings
    assert store.count("reader") == 2


@pytest.mark.parametrize("delay", [0.0, 0.002])
async def test_closing_the_last_handle_under_a_read_ends_it(
    store: FakeStore, tree: Tree, delay: float
) -> None:
    (await tree.open(LOG)).close()
    handle = await tree.open(LOG)
    store.chunk_delay = 1
    errors = []

    async def read() -> None:
        try:
            await handle.read(0, 100)
        except LocalProtocolError as error:
            errors.append(error)

    began = trio.current_time()
    async with trio.open_nursery() as readers:
        readers.start_soon(read)
        if delay:
            await trio.sleep(delay)
        else:  # while the reader is being opened
            while store.count("reader") != 2:
                await trio.lowlevel.checkpoint()
        handle.close()
    assert len(errors) == 1
    assert trio.current_time() < began + 1
    assert all(reader.closed for reader in store.readers)
    assert await read_file(tree, LOG) == DATA
