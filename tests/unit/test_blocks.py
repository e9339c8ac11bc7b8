"""Blocks of files: presence, budget, waiters, deadlines, and provisional bytes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import trio
import trio.testing

from mavftpfs.cache.blocks import BLOCK_SIZE, BlockCache, Blocks
from mavftpfs.shared.errors import RequestTimeout, VehicleLost
from tests.support.transfers import content

KIB = 1024
PATIENCE = 30.0


def make_blocks(cache: BlockCache, size: int) -> Blocks:
    blocks = Blocks(cache)
    blocks.size = size
    return blocks


def make_cache(budget: int = 1024 * KIB) -> BlockCache:
    return BlockCache(budget, clock=trio.current_time, patience=PATIENCE)


def deliver(blocks: Blocks, offset: int, data: bytes) -> None:
    blocks.on_data(offset, data)
    blocks.on_batch(len(data))
    blocks.check_invariants()


async def read(
    blocks: Blocks, start: int, stop: int, want: Callable[[], None] = lambda: None
) -> bytes | memoryview | None:
    async with blocks._cache.reads:
        want()
        await blocks.wait_for(start, stop)
        return blocks.get(start, stop)


class Reading:
    """A read under way in a nursery."""

    def __init__(self, blocks: Blocks, start: int, stop: int) -> None:
        self.blocks = blocks
        self.range = (start, stop)
        self.wanted: list[list[tuple[int, int]]] = []
        self.results: list[bytes | None] = []
        self.errors: list[Exception] = []
        self.took = 0.0
        self.scope = trio.CancelScope()

    async def run(self) -> None:
        began = trio.current_time()
        with self.scope:
            try:
                data = await read(self.blocks, *self.range, self._want)
                self.results.append(None if data is None else bytes(data))
            except Exception as error:
                self.errors.append(error)
        self.took = trio.current_time() - began

    def _want(self) -> None:
        self.wanted.append(self.blocks.missing(*self.range))


async def start_read(nursery: trio.Nursery, blocks: Blocks, start: int, stop: int) -> Reading:
    reading = Reading(blocks, start, stop)
    nursery.start_soon(reading.run)
    await trio.testing.wait_all_tasks_blocked()
    return reading


# --- presence


async def test_a_read_within_a_block_is_a_view_that_cannot_be_written() -> None:
    blocks = make_blocks(make_cache(), 100)
    deliver(blocks, 0, content(100))
    view = blocks.get(10, 20)
    assert isinstance(view, memoryview)
    assert view.readonly


# --- budget


async def test_least_recently_read_blocks_go_first() -> None:
    cache = make_cache(4 * BLOCK_SIZE)
    first, second = make_blocks(cache, 3 * BLOCK_SIZE), make_blocks(cache, 2 * BLOCK_SIZE)
    deliver(first, 0, content(3 * BLOCK_SIZE))
    deliver(second, 0, content(BLOCK_SIZE))
    assert first.get(0, 1) is not None
    deliver(second, BLOCK_SIZE, content(BLOCK_SIZE))
    assert first.missing(0, 3 * BLOCK_SIZE) == [(BLOCK_SIZE, 2 * BLOCK_SIZE)]
    assert cache.bytes_cached == 4 * BLOCK_SIZE
    cache.check_invariants()


async def test_blocks_with_waiters_are_not_evicted(nursery: trio.Nursery) -> None:
    cache = make_cache(4 * BLOCK_SIZE)
    waited = make_blocks(cache, 2 * BLOCK_SIZE)
    deliver(waited, 0, content(BLOCK_SIZE))
    reading = await start_read(nursery, waited, 0, 2 * BLOCK_SIZE)
    other = make_blocks(cache, 10 * BLOCK_SIZE)
    for index in range(10):
        deliver(other, index * BLOCK_SIZE, content(BLOCK_SIZE))
    deliver(waited, BLOCK_SIZE, content(BLOCK_SIZE))
    await trio.testing.wait_all_tasks_blocked()
    assert reading.results == [content(BLOCK_SIZE) * 2]
    cache.check_invariants()
    waited.drop()
    assert waited.block(0) is None


# --- waiting


@pytest.mark.holds("promise 4")
async def test_only_bytes_of_the_own_range_are_progress(nursery: trio.Nursery) -> None:
    blocks = make_blocks(make_cache(), 1000)
    mine = await start_read(nursery, blocks, 0, 100)
    for step in range(60):
        await trio.sleep(1)
        deliver(blocks, 100 + step, b"x")
        deliver(blocks, 100, b"x")
    assert [type(error) for error in mine.errors] == [RequestTimeout]
    assert mine.took == pytest.approx(PATIENCE)


async def test_failure_reaches_those_who_wait_and_no_later_read(nursery: trio.Nursery) -> None:
    blocks = make_blocks(make_cache(), 100)
    readings = [await start_read(nursery, blocks, 0, 50), await start_read(nursery, blocks, 0, 100)]
    deliver(blocks, 0, content(50))
    blocks.on_failed(VehicleLost("gone"))
    await trio.testing.wait_all_tasks_blocked()
    assert readings[0].results == [content(50)]
    assert [str(error) for error in readings[1].errors] == ["gone"]
    again = await start_read(nursery, blocks, 0, 100)
    assert again.wanted == [[(50, 100)]]
    deliver(blocks, 50, content(100)[50:])
    await trio.testing.wait_all_tasks_blocked()
    assert again.results == [content(100)]


async def test_a_cancelled_read_leaves_nothing_behind(nursery: trio.Nursery) -> None:
    cache = make_cache(4 * BLOCK_SIZE)
    blocks = make_blocks(cache, 100)
    reading = await start_read(nursery, blocks, 0, 100)
    reading.scope.cancel()
    await trio.testing.wait_all_tasks_blocked()
    assert not blocks.pinned()
    again = await start_read(nursery, blocks, 0, 100)
    deliver(blocks, 0, content(100))
    await trio.testing.wait_all_tasks_blocked()
    assert again.results == [content(100)]


# --- turns


async def test_reads_that_wait_pin_no_more_than_half_and_take_turns(nursery: trio.Nursery) -> None:
    cache = make_cache(8 * BLOCK_SIZE)
    blocks = make_blocks(cache, 20 * BLOCK_SIZE)
    readings = [await start_read(nursery, blocks, i * BLOCK_SIZE, (i + 1) * BLOCK_SIZE) for i in range(4)]
    assert [len(reading.wanted) for reading in readings] == [1, 1, 0, 0]
    deliver(blocks, 0, content(BLOCK_SIZE))
    await trio.testing.wait_all_tasks_blocked()
    assert [len(reading.wanted) for reading in readings] == [1, 1, 1, 0]
    readings[1].scope.cancel()
    await trio.testing.wait_all_tasks_blocked()
    assert [len(reading.wanted) for reading in readings] == [1, 1, 1, 1]


# --- dropped bytes


async def test_a_drop_wakes_reads_that_wait(nursery: trio.Nursery) -> None:
    blocks = make_blocks(make_cache(), 100)
    reading = await start_read(nursery, blocks, 0, 100)
    blocks.drop()
    await trio.testing.wait_all_tasks_blocked()
    assert reading.results == [None]
