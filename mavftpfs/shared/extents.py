"""Sets of half-open byte ranges. Layer: shared; pure.

An ExtentSet is kept as two parallel sorted lists of starts and stops of disjoint, non-touching,
non-empty ranges. Sets stay small (a burst with gaps), so list operations beat cleverer trees.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator


class ExtentSet:
    """A set of non-negative integers stored as half-open extents [start, stop). ExtentSet(other) copies."""

    __slots__ = ("_starts", "_stops")

    def __init__(self, extents: Iterable[tuple[int, int]] = ()) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []
        for start, stop in extents:
            self.add(start, stop)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Yield the present (start, stop) in ascending order; the caller may change the set meanwhile."""
        return iter(list(zip(self._starts, self._stops, strict=True)))

    def __len__(self) -> int:
        """Return the number of extents (not of bytes)."""
        return len(self._starts)

    def __bool__(self) -> bool:
        raise TypeError("ask .empty or .total, truth of an ExtentSet is ambiguous")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ExtentSet):
            return NotImplemented
        return self._starts == other._starts and self._stops == other._stops

    __hash__ = None  # type: ignore[assignment]  # mutable

    def __repr__(self) -> str:
        inner = ", ".join(f"[{a}, {b})" for a, b in self)
        return f"ExtentSet({inner})"

    @property
    def empty(self) -> bool:
        """Whether no byte is in the set."""
        return not self._starts

    @property
    def total(self) -> int:
        """The number of bytes in the set."""
        return sum(self._stops) - sum(self._starts)

    @property
    def end(self) -> int:
        """One past the last byte, 0 if empty."""
        return self._stops[-1] if self._stops else 0

    def add(self, start: int, stop: int) -> None:
        """Add [start, stop), merging with what it touches; an empty range changes nothing."""
        if start >= stop:
            return
        starts, stops = self._starts, self._stops
        if starts and starts[-1] <= start <= stops[-1]:  # a file that grows chunk by chunk
            if stop > stops[-1]:
                stops[-1] = stop
            return
        first = bisect_left(stops, start)
        last = bisect_right(starts, stop)
        if first < last:
            start = min(start, starts[first])
            stop = max(stop, stops[last - 1])
        starts[first:last] = [start]
        stops[first:last] = [stop]

    def discard(self, start: int, stop: int) -> None:
        """Remove [start, stop) where present."""
        if start >= stop or not self._starts:
            return
        if start <= self._starts[0] and stop < self._stops[0]:  # a file that is sent chunk by chunk
            self._starts[0] = max(stop, self._starts[0])
            return
        first = bisect_right(self._stops, start)
        last = bisect_left(self._starts, stop)
        if first >= last:
            return
        left = self._starts[first]
        right = self._stops[last - 1]
        starts: list[int] = []
        stops: list[int] = []
        if left < start:
            starts.append(left)
            stops.append(start)
        if right > stop:
            starts.append(stop)
            stops.append(right)
        self._starts[first:last] = starts
        self._stops[first:last] = stops

    def covers(self, start: int, stop: int) -> bool:
        """Return whether every byte of [start, stop) is in the set (true for an empty range)."""
        if start >= stop:
            return True
        index = bisect_right(self._starts, start) - 1
        return index >= 0 and self._stops[index] >= stop

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the ranges of [start, stop) that are not in the set, ascending."""
        if not self._stops or start >= self._stops[-1]:
            return [(start, stop)] if start < stop else []
        gaps: list[tuple[int, int]] = []
        index = bisect_right(self._stops, start)
        while start < stop and index < len(self._starts) and self._starts[index] < stop:
            if start < self._starts[index]:
                gaps.append((start, self._starts[index]))
            start = self._stops[index]
            index += 1
        if start < stop:
            gaps.append((start, stop))
        return gaps

    def intersection(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) that are in the set, ascending."""
        parts: list[tuple[int, int]] = []
        index = bisect_right(self._stops, start)
        while index < len(self._starts) and self._starts[index] < stop:
            parts.append((max(start, self._starts[index]), min(stop, self._stops[index])))
            index += 1
        return parts

    def first(self) -> tuple[int, int] | None:
        """Return the lowest extent, or None."""
        return (self._starts[0], self._stops[0]) if self._starts else None
