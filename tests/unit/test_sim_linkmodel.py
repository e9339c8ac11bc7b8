"""The link model delivers what it should, when it should, and the same again for the same seed."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.sim.linkmodel import Direction, Duplex, LinkModel, LinkSettings

UP, DOWN = Direction.TO_VEHICLE, Direction.TO_CLIENT


def model(**fields: Any) -> LinkModel:
    return LinkModel(random.Random(1), LinkSettings(**fields))


def drain(link: LinkModel, direction: Direction, now: float) -> list[tuple[float, bytes]]:
    """Return what arrives after `now`, with its times."""
    found = []
    while link.pending(direction):
        due = link.next_deadline()
        assert due is not None
        now = max(now, due)
        found += [(round(now, 6), frame) for frame in link.pop(direction, now)]
        link.pop(Direction(1 - direction), now)
    return found


def test_rate_and_delay() -> None:
    link = model(rate=100.0, delay=0.5)
    link.push(UP, bytes(10), 0.0)
    link.push(UP, bytes(20), 0.0)
    link.push(DOWN, bytes(10), 0.0)
    assert drain(link, UP, 0.0) == [(0.6, bytes(10)), (0.8, bytes(20))]
    assert link.counters(DOWN).delivered == 1


def test_the_queue_drops_its_tail() -> None:
    link = model(rate=100.0, queue=50)
    taken = [link.push(UP, bytes(10), 0.0) for _ in range(7)]
    assert taken == [True] * 5 + [False] * 2
    assert link.room(UP) == 0
    link.pop(UP, 0.1)
    assert link.room(UP) == 10
    link.pop(UP, 10.0)
    assert link.room(UP) == 50
    counters = link.counters(UP)
    assert (counters.pushed, counters.dropped, counters.delivered) == (7, 2, 5)


def test_half_duplex_shares_the_air_in_turn() -> None:
    link = model(rate=100.0, duplex=Duplex.HALF)
    for _ in range(3):
        link.push(UP, bytes(10), 0.0)
    for _ in range(3):
        link.push(DOWN, bytes(10), 0.0)
    assert len(link.pop(UP, 0.301)) == 2
    assert len(link.pop(DOWN, 0.301)) == 1
    assert link.room(DOWN) + link.room(UP) == 2 * 65_536 - 30
    assert drain(link, DOWN, 0.301) == [(0.4, bytes(10)), (0.6, bytes(10))]
    assert link.pop(UP, 0.6) == []
    assert link.counters(UP).delivered == 3


@pytest.mark.parametrize(
    ("fields", "low", "high"),
    [({"loss": 0.1}, 0.08, 0.12), ({"burst_loss": 0.1}, 0.06, 0.14), ({"loss": 1.0}, 1.0, 1.0)],
)
def test_loss_has_the_share_it_was_given(fields: dict[str, float], low: float, high: float) -> None:
    link = model(**fields)
    for i in range(10_000):
        link.push(UP, b"x", float(i))
    link.pop(UP, 1e6)
    assert low <= link.counters(UP).lost / 10_000 <= high


def test_a_cut_loses_what_is_on_the_way() -> None:
    link = model(rate=100.0, delay=1.0)
    for when in (0.0, 3.95, 4.5):
        link.push(UP, bytes(10), when)
    link.cut(5.0)
    link.push(UP, bytes(10), 5.5)
    link.restore(6.0)
    link.push(UP, bytes(10), 6.0)
    assert len(link.pop(UP, 10.0)) == 2
    assert link.counters(UP).cut == 3
    link.cut(20.0)
    link.cut(21.0)
    assert link.is_cut(25.0)
    link.push(UP, bytes(10), 25.0)
    link.restore(30.0)
    assert not link.is_cut(30.0)
    assert link.is_cut(29.0)
    link.push(UP, bytes(10), 30.0)
    assert len(link.pop(UP, 40.0)) == 1


LINKS = st.builds(
    LinkSettings,
    rate=st.none() | st.floats(100, 1e6),
    queue=st.integers(50, 5000),
    duplex=st.sampled_from(Duplex),
    delay=st.floats(0, 0.5),
    jitter=st.floats(0, 0.1),
    loss=st.floats(0, 1),
    burst_loss=st.floats(0, 1),
    duplicate=st.floats(0, 1),
    reorder=st.floats(0, 1),
    corrupt=st.floats(0, 1),
)
PUSHES = st.lists(
    st.tuples(st.sampled_from(Direction), st.binary(max_size=300), st.floats(0, 0.2)), max_size=60
)


def run(
    link: LinkModel, pushes: list[tuple[Direction, bytes, float]]
) -> list[tuple[float, Direction, bytes]]:
    """Push at the given pauses, waking at every deadline, until nothing is under way."""
    now, heard = 0.0, []
    for direction, frame, pause in [*pushes, (UP, b"", 100.0)]:
        stop = now + pause
        while (due := link.next_deadline()) is not None and due <= stop:
            now = max(now, due)
            for side in Direction:
                heard += [(now, side, got) for got in link.pop(side, now)]
        now = stop
        if pause < 100.0:
            link.push(direction, frame, now)
    return heard


@settings(max_examples=80, deadline=None)
@given(LINKS, PUSHES, st.integers(0, 5))
def test_every_frame_is_accounted_for_and_runs_repeat(
    chosen: LinkSettings, pushes: list[tuple[Direction, bytes, float]], seed: int
) -> None:
    link = LinkModel(random.Random(seed), chosen)
    heard = run(link, pushes)
    for side in Direction:
        c = link.counters(side)
        assert c.pushed == sum(direction is side for direction, _, _ in pushes)
        assert c.delivered == sum(direction is side for _, direction, _ in heard)
        assert c.pushed + c.duplicated == c.dropped + c.lost + c.cut + c.delivered + link.pending(side)
        assert link.pending(side) == 0
    assert run(LinkModel(random.Random(seed), chosen), pushes) == heard
