"""Requests that left together, and what the row of their answers tells. Layer: protocol; pure.

While the window is far too small, all of it leaves in one go once a round, and its answers come at the pace
of the slowest part of the way. That is known as soon as the last of them is there, a whole round trip before
the round is over, and tells how many the way holds. A few answers may have come in a bunch; many that keep
the pace of the few before did not.
"""

from __future__ import annotations

from math import inf

_TELLING = 4
_MANY = 32
_STEADY = 0.8
_LEAP = 8
_NEVER = 1 << 62


class Flights:
    """Watches the requests that are on their way when a round begins.

    Attributes:
        rate: requests per second by the last row; infinite before the first.
        due: order of the transmission whose answer ends the row.
        measured: the row of this round has told the pace of the path.
    """

    __slots__ = ("_first", "due", "measured", "rate")

    def __init__(self) -> None:
        self.rate = inf
        self.due = _NEVER
        self.measured = False
        self._first = -1

    def begin(self, order: int, next_order: int, window: int) -> None:
        """The transmission numbered `order` was answered, the first of those below `next_order`."""
        self._first = order
        self.due = next_order - 1 - window // 8  # the last ones may be lost
        self.measured = False

    def end(self, order: int, took: float, base_rtt: float) -> float:
        """Return how many times as many requests may follow, now that the row is complete.

        took: seconds between its first and its last answer.
        """
        sent = order - self._first
        self.due = _NEVER
        together = took < base_rtt / 2 < inf
        if took <= 0.0 or sent < (_TELLING if together else _MANY):
            return 1.0
        before, self.rate = self.rate, sent / took
        self.measured = together
        return inf if sent >= _MANY and self.rate > _STEADY * before else _LEAP
