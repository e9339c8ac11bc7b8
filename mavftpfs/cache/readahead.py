"""When to fetch bytes that no program has asked for yet. Layer: cache; pure: the time is an argument.

One `Readahead` per open handle watches its reads. Reads that follow each other open a window ahead of the
reader, which doubles as it is used up; a seek closes it. A small file is wanted whole at once. On a slow link
the window is a few seconds at most, so that `head` of a log does not fetch a megabyte.
"""

from __future__ import annotations

from dataclasses import dataclass

FIRST_WINDOW = 128 * 1024
MAX_WINDOW = 8 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Plan:
    """The bytes to ask for besides the read itself: [start, stop), empty if start == stop.

    seeked: the reader went elsewhere, so earlier readahead is useless.
    """

    start: int = 0
    stop: int = 0
    seeked: bool = False


NOTHING = Plan()


class Readahead:
    """The read pattern of one handle on a file of `size` bytes."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._next = 0  # where a sequential reader would go on
        self._last_start = 0
        self._window = 0
        self._used = 0  # bytes read since the window last doubled
        self._asked = 0  # all below was asked for

    def on_read(self, start: int, stop: int, *, limit: int, small: int) -> Plan:
        """Note a read of [start, stop) and return what to ask for.

        limit: the largest window now; small: files up to this size are wanted whole, both in bytes.
        """
        if stop == self._last_start:  # the kernel has two requests under way; the earlier one came late
            return NOTHING
        gap = start - self._next
        follows = 0 <= gap <= stop - start if self._next else gap == 0
        self._last_start, self._next = start, stop
        if not follows:
            had_window = self._window > 0
            self._window = self._used = self._asked = 0
            return Plan(seeked=had_window)
        if start == 0:
            if self._size <= small:
                self._asked = self._size
                return Plan(min(stop, self._size), self._size)
            if stop < FIRST_WINDOW:  # a program that begins with more at once reads on
                return NOTHING
        self._used += stop - start
        if self._window == 0:
            self._window = FIRST_WINDOW
        elif self._used >= self._window:
            self._window, self._used = self._window * 2, 0
        self._window = min(self._window, max(limit, 0))
        first = max(self._asked, stop)
        goal = min(stop + self._window, self._size)
        if goal <= first or (goal - first < self._window // 2 and goal != self._size):
            return NOTHING
        self._asked = goal
        return Plan(first, goal)
