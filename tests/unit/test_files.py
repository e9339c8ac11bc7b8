"""Open files: what is kept, what is asked again, what an old handle sees, and doubtful bytes."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import (
    DataUnproven,
    FileChanged,
    IsADirectory,
    LocalProtocolError,
    NotFound,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig, card, read_file, rig
from tests.support.transfers import content

KIB = 1024
MIB = 1024 * KIB
LOG = b"/logs/a.bin"
MTIME = 1_700_000_000
OPEN, READ = Opcode.OPEN_FILE_RO, Opcode.READ_FILE
LISTS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
EXPIRED = 21.0
"""Seconds after which neither a listing nor what was known of a file holds."""


DATA = content(300_000)

here = card({LOG: DATA})


@pytest.fixture
async def timed() -> AsyncIterator[Rig]:
    """A server whose listings tell times."""
    async with rig("mavsdk") as made:
        made.put(LOG, DATA, MTIME)
        yield made


# --- reading


async def test_a_read_larger_than_the_cache_is_served_in_pieces(here: Rig) -> None:
    big = content(MIB + 256 * KIB)
    here.put(b"/big", big)
    tree = here.mount(cache_size=MIB)
    handle = await tree.open(b"/big")
    assert await handle.read(0, len(big)) == big
    handle.close()
    assert int(str(tree.status()["bytes_cached"])) <= MIB


async def test_a_second_reader_of_the_file_shares_blocks_and_session(here: Rig) -> None:
    tree = here.mount()
    first, second = await tree.open(LOG), await tree.open(LOG)
    async with trio.open_nursery() as readers:
        readers.start_soon(first.read, 0, len(DATA))
        readers.start_soon(second.read, 0, len(DATA))
    assert here.count(OPEN) == 1
    assert here.count(READ) == -(-len(DATA) // 239)
    first.close()
    assert await second.read(0, 10) == DATA[:10]
    second.close()
    second.close()
    with pytest.raises(LocalProtocolError):
        await second.read(0, 1)
    assert tree._card.live == {}


async def test_sequential_reads_fetch_ahead_until_somebody_seeks() -> None:
    """Until the file is closed: tests/sim/test_open_files.py."""
    async with rig(link=LinkSettings(rate=30_000.0, delay=0.02)) as here:
        here.put(b"/big", content(2 * MIB))
        handle = await here.mount().open(b"/big")
        for at in range(0, 64 * KIB, 16 * KIB):
            await handle.read(at, 16 * KIB)
        asked = here.count(READ)
        await trio.sleep(2.0)
        assert here.count(READ) > asked + 50
        asked = here.count(READ)
        await handle.read(1 * MIB, 239)
        await trio.sleep(10.0)
        assert here.count(READ) < asked + 50
        await handle.release()


@pytest.mark.holds("promise 6", "rule 14.30")
async def test_a_directory_is_not_opened(here: Rig) -> None:
    tree = here.mount()
    for path in (b"/logs", b"/"):
        with pytest.raises(IsADirectory):
            await tree.open(path)
    with pytest.raises(NotFound):
        await tree.open(b"/logs/none")
    assert here.count(OPEN) == 0


# --- close-to-open


async def test_equal_size_and_mtime_prove_the_cache_for_ever(timed: Rig) -> None:
    tree = timed.mount()
    await read_file(tree, LOG)
    await trio.sleep(1000)
    handle = await tree.open(LOG)
    assert handle.keep_cache
    assert await handle.read(0, len(DATA)) == DATA
    assert timed.count(OPEN) == 1


async def test_without_mtime_the_proof_lasts_dir_timeout(here: Rig) -> None:
    tree = here.mount()
    await read_file(tree, LOG)
    await trio.sleep(19)
    (await tree.open(LOG)).close()
    assert here.count(OPEN) == 1
    await trio.sleep(1.5)
    here.put(LOG, DATA[::-1])
    handle = await tree.open(LOG)
    assert not handle.keep_cache
    assert await handle.read(0, len(DATA)) == DATA[::-1]


@pytest.mark.parametrize("grown", [False, True])
async def test_a_newer_listing_can_end_a_recent_proof(here: Rig, grown: bool) -> None:
    tree = here.mount()
    await read_file(tree, LOG)
    await trio.sleep(5)
    tree._card.directories.expire(b"/logs")
    if grown:
        here.put(LOG, DATA + b"more")
    handle = await tree.open(LOG)
    assert handle.keep_cache is not grown
    assert handle.size == len(here.data(LOG))
    assert here.count(OPEN) == (2 if grown else 1)


@pytest.mark.holds("fault growing file", "rule 14.21")
async def test_a_grown_file_is_served_at_the_size_of_its_last_open(here: Rig) -> None:
    tree = here.mount()
    old = await tree.open(LOG)
    await old.read(0, 100)
    here.put(LOG, DATA + b"more")
    await trio.sleep(EXPIRED)
    assert await old.read(len(DATA), 100) == b""
    new = await tree.open(LOG)
    assert not new.keep_cache
    for handle in (old, new):
        assert handle.size == len(DATA) + 4
        assert await handle.read(0, 10**6) == DATA + b"more"


async def test_a_read_under_which_the_file_grew_ends_at_its_new_end(here: Rig) -> None:
    """The kernel takes a reply that is shorter than the size it knows for the end."""
    tree = here.mount()
    old = await tree.open(LOG)
    here.put(LOG, DATA + b"more")
    await trio.sleep(EXPIRED)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(tree.open, LOG)
        await trio.sleep(0.001)
        assert await old.read(len(DATA) - 100, 4096) == DATA[-100:] + b"more"


@pytest.mark.holds("fault replaced file")
async def test_a_file_that_others_replaced_lost_its_name(timed: Rig) -> None:
    """Otherwise the two would meet in the kernel's page cache."""
    tree = timed.mount()
    old = await tree.open(LOG)
    timed.put(LOG, DATA[::-1], MTIME + 9)
    await trio.sleep(EXPIRED)
    new = await tree.open(LOG)
    assert [old.has_name, new.has_name] == [False, True]
    assert not new.keep_cache


async def test_the_ack_beats_the_listing(timed: Rig) -> None:
    tree = timed.mount()
    await tree.stat(LOG)
    timed.put(LOG, DATA + b"more", MTIME + 9)
    handle = await tree.open(LOG)
    assert handle.size == len(DATA) + 4
    assert (await tree.stat(LOG)).size == len(DATA) + 4
    assert timed.invalidated == [LOG]
    assert await handle.read(len(DATA), 10) == b"more"
    handle.close()
    assert (await tree.open(LOG)).keep_cache


async def open_partly_cached(here: Rig, tree: Tree) -> OpenFile:
    """Open a large file again of which the beginning was read."""
    here.put(b"/big", content(MIB))
    handle = await tree.open(b"/big")
    await handle.read(0, 4 * KIB)
    handle.close()
    await trio.sleep(3.0)  # the server's session is closed
    return await tree.open(b"/big")


@pytest.mark.holds("fault idle close", "rule 14.9")
async def test_a_partly_cached_file_is_opened_again_only_when_bytes_are_wanted(here: Rig) -> None:
    handle = await open_partly_cached(here, here.mount())
    assert here.count(OPEN) == 1
    await handle.read(512 * KIB, 4 * KIB)
    assert here.count(OPEN) == 2


async def test_a_file_that_shrank_before_it_was_opened_again(here: Rig) -> None:
    tree = here.mount()
    handle = await open_partly_cached(here, tree)
    here.put(b"/big", b"short")
    for at in (512 * KIB, 0):
        with pytest.raises(FileChanged):
            await handle.read(at, 4)
    assert b"/big" in here.invalidated
    handle.close()
    assert await read_file(tree, b"/big") == b"short"


async def test_closed_files_are_bounded(here: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mavftpfs.cache.card.MAX_CLOSED", 3)
    tree = here.mount()
    for number in range(5):
        here.put(b"/many/%d" % number, b"x")
    for number in range(5):
        await read_file(tree, b"/many/%d" % number)
    assert (await tree.open(b"/many/4")).keep_cache
    assert not (await tree.open(b"/many/1")).keep_cache


# --- reboot


@pytest.mark.holds("promise 5")
async def test_a_file_that_is_gone_after_a_reboot(here: Rig) -> None:
    handle = await here.mount().open(LOG)
    await handle.read(0, 1000)
    here.take(LOG)
    await here.reboot()
    with pytest.raises(FileChanged):
        await handle.read(0, 1000)


# --- doubtful bytes (promise 1)


async def test_bytes_that_stay_suspect_are_an_error() -> None:
    """In time: a handler waits for 33 s."""
    async with rig(files={LOG: DATA}, link=LinkSettings(delay=0.05)) as here:
        wrong = True
        here.server.change = lambda request, reply: [
            reply._replace(data=bytes(reply.size)) if wrong and request.opcode == READ else reply
        ]

        async def raise_doubt() -> None:
            while wrong:
                here.connection.scheduler.server.distrust(reads=True)
                await trio.sleep(0.05)

        handle = await here.mount().open(LOG)
        here.nursery.start_soon(raise_doubt)
        began = trio.current_time()
        with pytest.raises(DataUnproven):
            await handle.read(0, 100)
        assert trio.current_time() < began + 20
        wrong = False
        assert await handle.read(0, len(DATA)) == DATA


async def test_a_closed_file_whose_bytes_were_dropped_is_read_again_without_a_listing(timed: Rig) -> None:
    """A tree is read twice over a link that doubles: with a listing for each file that took minutes."""
    tree = timed.mount()
    await read_file(tree, LOG)
    timed.connection.scheduler.server.distrust(reads=True)
    assert timed.invalidated == [LOG]
    listings = timed.count(*LISTS)
    assert await read_file(tree, LOG) == DATA
    assert (timed.count(OPEN), timed.count(*LISTS)) == (2, listings)


async def test_a_file_that_became_smaller_while_its_bytes_were_doubted(here: Rig) -> None:
    handle = await here.mount().open(LOG)
    await handle.read(0, 100)
    here.put(LOG, DATA[:1000])
    here.connection.scheduler.server.distrust(reads=True)
    with pytest.raises(FileChanged):
        await handle.read(0, 100)


@pytest.mark.parametrize("doubted", [False, True])
async def test_closing_the_last_handle_under_a_read_ends_it(doubted: bool) -> None:
    """doubted: the file is being opened anew."""
    async with rig(files={LOG: DATA}, link=LinkSettings(delay=1.0)) as here:
        tree = here.mount()
        handle = await tree.open(LOG)
        if doubted:
            here.connection.scheduler.server.distrust(reads=True)

        async def read() -> None:
            with pytest.raises(LocalProtocolError):
                await handle.read(0, 100)

        async with trio.open_nursery() as readers:
            readers.start_soon(read)
            await trio.sleep(0.5)
            began = trio.current_time()
            handle.close()
        assert trio.current_time() - began < 5
        assert await read_file(tree, LOG) == DATA
