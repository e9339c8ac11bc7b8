"""The cache holds the bytes that arrived of a file, and readahead stays within its bounds."""

from __future__ import annotations

import random
from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.cache.blocks import BLOCK_SIZE, BlockCache, Blocks
from mavftpfs.cache.readahead import MAX_WINDOW, Readahead

KIB = 1024


# --- one file's blocks against bytes


@dataclass
class Step:
    """The next event for the blocks."""

    what: str
    start: int = 0
    size: int = 0


steps = st.builds(
    Step,
    st.sampled_from(["data", "data", "data", "evict", "clear"]),
    st.integers(0, 3 * BLOCK_SIZE),
    st.one_of(st.integers(0, 300), st.integers(0, 2 * BLOCK_SIZE)),
)


@given(st.integers(0, 3 * BLOCK_SIZE), st.lists(steps, max_size=40), st.integers())
def test_blocks_hold_what_came_first_and_only_that(size: int, script: list[Step], seed: int) -> None:
    """After each step, what is readable equals a model of bytes."""
    cache = BlockCache(2 * BLOCK_SIZE, clock=lambda: 0.0, patience=30)
    blocks = Blocks(cache)
    blocks.size = size
    held: dict[int, int] = {}
    rng = random.Random(seed)
    sample = sorted({0, size - 1, BLOCK_SIZE - 1, BLOCK_SIZE, *(rng.randrange(size or 1) for _ in range(30))})
    for number, step in enumerate(script):
        stop = min(step.start + step.size, size)
        if step.what == "data":
            blocks.on_data(step.start, bytes([number]) * step.size)
            blocks.on_batch(step.size)
            for at in sample:
                if step.start <= at < stop:
                    held.setdefault(at, number)
        elif step.what == "clear" or blocks.block(step.start // BLOCK_SIZE) is None:
            blocks.drop()
        else:
            blocks.evict(step.start // BLOCK_SIZE)
        gone = {at for at in held if blocks.block(at // BLOCK_SIZE) is None}
        held = {at: byte for at, byte in held.items() if at not in gone}
        blocks.check_invariants()
        cache.check_invariants()
        for at in sample:
            if 0 <= at < size:
                view = blocks.get(at, at + 1)
                assert (None if view is None else view[0]) == held.get(at)


# --- readahead


@given(
    st.integers(0, 10**7),
    st.lists(st.tuples(st.integers(0, 10**7), st.integers(1, 300_000)), max_size=30),
    st.integers(0, MAX_WINDOW),
    st.integers(0, MAX_WINDOW),
)
def test_readahead_stays_within_the_file_and_its_bounds(
    size: int, reads: list[tuple[int, int]], limit: int, small: int
) -> None:
    ahead = Readahead(size)
    for start, length in reads:
        stop = min(start + length, size)
        if start >= stop:
            continue
        plan = ahead.on_read(start, stop, limit=limit, small=small)
        assert 0 <= plan.start <= plan.stop <= size
        assert plan.stop - plan.start <= MAX_WINDOW
        if plan.start < plan.stop:
            assert plan.start >= stop
            assert plan.stop <= max(stop + limit, small)


@given(st.integers(1, 10**7), st.integers(1, 256 * KIB))
def test_a_sequential_reader_is_never_asked_for_the_same_byte_twice(size: int, step: int) -> None:
    ahead = Readahead(size)
    step = max(step, size // 200)
    asked = 0
    for start in range(0, size, step):
        plan = ahead.on_read(start, min(start + step, size), limit=MAX_WINDOW, small=64 * KIB)
        assert not plan.seeked
        if plan.start < plan.stop:
            assert plan.start >= asked
            asked = plan.stop
