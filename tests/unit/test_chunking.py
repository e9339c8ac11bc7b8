"""The proof that only short chunks pass; the rest is in tests/sim/test_chunk_auto.py."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.chunking import LONE_LOSSES, LONE_SECONDS, SHORT, SUSPICIOUS_LOSSES, ChunkSize
from mavftpfs.protocol.payload import MAX_DATA

pytestmark = pytest.mark.holds("fault long frames")


def use(chunks: ChunkSize, passing: int, *, seconds: float, now: float = 0.0) -> set[int]:
    """Send one request after the other over a link that loses what is longer; return the sizes that went
    out."""
    sizes = set()
    end = now + seconds
    while now < end:
        size = chunks.next_size(now)
        sizes.add(size)
        if size > passing:
            chunks.on_lost(size, now, now)
        else:
            chunks.on_answered(size, 1, now, now)
        now += 0.05
    return sizes


def test_full_ones_at_first_and_while_any_passes() -> None:
    chunks = ChunkSize()
    rng = random.Random(1)
    for step in range(100_000):
        assert chunks.next_size(step * 0.01) == MAX_DATA
        if rng.random() < 0.36:  # a fifth is lost each way
            chunks.on_lost(MAX_DATA, step * 0.01, step * 0.01)
        else:
            chunks.on_answered(MAX_DATA, 1, step * 0.01, step * 0.01)
    assert not chunks.trying


def test_a_lone_request_needs_fewer_losses() -> None:
    chunks = ChunkSize()
    for _ in range(LONE_LOSSES):
        assert not chunks.trying
        chunks.on_lost(MAX_DATA, 1.0, 1.0)
    chunks.on_lost(MAX_DATA, 1.0, 1.0 + LONE_SECONDS)
    assert chunks.trying


def test_a_link_that_was_away_changes_nothing() -> None:
    chunks = ChunkSize()
    use(chunks, 0, seconds=2.0)
    assert chunks.trying
    assert MAX_DATA in use(chunks, MAX_DATA, seconds=0.2, now=2.0)
    assert chunks.size == MAX_DATA
    assert not chunks.trying


def test_what_was_lost_at_once_before_a_full_one_passed_changes_nothing() -> None:
    """A card that pauses loses hundreds in a row, which a later answer proves."""
    chunks = ChunkSize()
    chunks.on_answered(MAX_DATA, 1, 2.0, 2.1)
    for _ in range(100):
        chunks.on_lost(MAX_DATA, 1.0, 2.1)
    assert not chunks.trying


def test_long_ones_that_were_in_flight_when_only_short_ones_passed_prove_nothing_more() -> None:
    chunks = ChunkSize()
    use(chunks, 100, seconds=3.0)
    assert (chunks.trying, chunks.size) == (False, SHORT)
    for _ in range(SUSPICIOUS_LOSSES):
        chunks.on_lost(MAX_DATA, 2.0, 3.0)
    assert (chunks.trying, chunks.size) == (False, SHORT)


def test_the_size_that_a_user_asked_for_stays() -> None:
    chunks = ChunkSize(110)
    assert use(chunks, 0, seconds=60.0) == {110}
    assert chunks.most == chunks.size == 110
