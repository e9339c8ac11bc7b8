"""The link model delivers what it should, when it should."""

from __future__ import annotations

import random
from typing import Any

import pytest

from mavftpfs.sim.linkmodel import Direction, Duplex, LinkModel, LinkSettings

UP, DOWN = Direction.TO_VEHICLE, Direction.TO_CLIENT


def model(**fields: Any) -> LinkModel:
    return LinkModel(random.Random(1), LinkSettings(**fields))


def drain(link: LinkModel, direction: Direction, now: float) -> list[tuple[float, bytes]]:
    """Return what arrives after `now`, with its times."""
    found = []
    while (due := link.next_deadline()) is not None:
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


def test_the_queue_drops_its_tail() -> None:
    link = model(rate=100.0, queue=50)
    taken = [link.push(UP, bytes(10), 0.0) for _ in range(7)]
    assert taken == [True] * 5 + [False] * 2
    assert link.room(UP) == 0
    link.pop(UP, 0.1)
    assert link.room(UP) == 10
    link.pop(UP, 10.0)
    assert link.room(UP) == 50
    assert link.dropped == 2


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


@pytest.mark.parametrize(
    ("fields", "low", "high"),
    [({"loss": 0.1}, 0.08, 0.12), ({"burst_loss": 0.1}, 0.06, 0.14), ({"loss": 1.0}, 1.0, 1.0)],
)
def test_loss_has_the_share_it_was_given(fields: dict[str, float], low: float, high: float) -> None:
    link = model(**fields)
    for i in range(10_000):
        link.push(UP, b"x", float(i))
    assert low <= 1 - len(link.pop(UP, 1e6)) / 10_000 <= high


def test_frames_are_doubled_held_up_and_damaged() -> None:
    doubled, held, damaged = model(duplicate=1.0), model(reorder=1.0, hold=0.5), model(corrupt=1.0)
    for link in (doubled, held, damaged):
        link.push(UP, bytes(10), 0.0)
    assert drain(doubled, UP, 0.0) == [(0.0, bytes(10))] * 2
    assert drain(held, UP, 0.0) == [(0.5, bytes(10))]
    ((_, frame),) = drain(damaged, UP, 0.0)
    assert (len(frame), frame != bytes(10)) == (10, True)


def test_a_cut_loses_what_is_on_the_way() -> None:
    link = model(rate=100.0, delay=1.0)
    for when in (0.0, 3.95, 4.5):
        link.push(UP, bytes(10), when)
    link.cut(5.0)
    link.push(UP, bytes(10), 5.5)
    link.restore(6.0)
    link.push(UP, bytes(10), 6.0)
    assert len(link.pop(UP, 10.0)) == 2
    link.cut(20.0)
    link.cut(21.0)
    assert link.is_cut(25.0)
    link.push(UP, bytes(10), 25.0)
    link.restore(30.0)
    assert not link.is_cut(30.0)
    assert link.is_cut(29.0)
    link.push(UP, bytes(10), 30.0)
    assert len(link.pop(UP, 40.0)) == 1
