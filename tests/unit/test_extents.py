"""Sets of byte ranges, example by example, and held against a set of ints."""

from __future__ import annotations

import random

import pytest

from mavftpfs.shared.extents import ExtentSet


def test_touching_and_overlapping_ranges_merge() -> None:
    extents = ExtentSet([(0, 10), (20, 30), (10, 20), (25, 40)])
    assert list(extents) == [(0, 40)]
    assert len(extents) == 1
    assert extents.total == 40
    assert extents.end == 40


def test_empty_ranges_change_nothing() -> None:
    extents = ExtentSet([(5, 5), (9, 3)])
    extents.discard(4, 4)
    assert extents.empty
    assert extents.end == 0
    assert extents.first() is None
    assert extents.take_first(10) is None
    assert extents.covers(7, 7)
    assert not extents.overlaps(7, 7)


def test_discard_splits() -> None:
    extents = ExtentSet([(0, 100)])
    extents.discard(40, 60)
    extents.discard(200, 300)
    extents.discard(95, 105)
    assert list(extents) == [(0, 40), (60, 95)]
    assert 39 in extents
    assert 40 not in extents
    assert extents.overlaps(30, 50)
    assert not extents.overlaps(40, 60)
    assert not extents.covers(30, 70)


def test_missing_and_intersection() -> None:
    extents = ExtentSet([(10, 20), (30, 40)])
    assert extents.missing(0, 50) == [(0, 10), (20, 30), (40, 50)]
    assert extents.missing(12, 18) == []
    assert extents.intersection(15, 35) == [(15, 20), (30, 35)]


def test_take_first_cuts() -> None:
    extents = ExtentSet([(5, 10), (20, 30)])
    assert extents.take_first(3) == (5, 8)
    assert extents.take_first(3) == (8, 10)
    assert extents.first() == (20, 30)


def test_copies_are_independent() -> None:
    extents = ExtentSet([(0, 3)])
    twin = extents.copy()
    twin.clear()
    assert extents == ExtentSet([(0, 3)])
    assert extents != twin
    assert extents != {0, 1, 2}
    assert repr(extents) == "ExtentSet([0, 3))"


def test_truth_and_hash_are_refused() -> None:
    with pytest.raises(TypeError):
        bool(ExtentSet())
    with pytest.raises(TypeError):
        hash(ExtentSet())


def _ranges(numbers: set[int]) -> list[tuple[int, int]]:
    starts = sorted(number for number in numbers if number - 1 not in numbers)
    stops = sorted(number + 1 for number in numbers if number + 1 not in numbers)
    return list(zip(starts, stops, strict=True))


def test_any_sequence_of_changes_leaves_what_a_plain_set_would_hold() -> None:
    rng = random.Random(7)
    for _ in range(300):
        extents, numbers = ExtentSet(), set[int]()
        for _ in range(30):
            start = rng.randrange(40)
            stop = start + rng.randrange(-2, 9)
            asked = set(range(start, stop))
            if rng.random() < 0.6:
                extents.add(start, stop)
                numbers |= asked
            else:
                extents.discard(start, stop)
                numbers -= asked
            assert list(extents) == _ranges(numbers)
            low, high = sorted((rng.randrange(45), rng.randrange(45)))
            wanted = set(range(low, high))
            assert extents.missing(low, high) == _ranges(wanted - numbers)
            assert extents.covers(low, high) == (wanted <= numbers)
            assert extents.overlaps(low, high) == bool(wanted & numbers)
            inside = {number for part in extents.intersection(low, high) for number in range(*part)}
            assert inside == wanted & numbers
