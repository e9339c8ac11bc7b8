"""The round trip of the empty path. Layer: protocol; pure.

It is the least that was seen, which a way that has become longer for good never shows again. The answers to
what was sent under a much narrower window tell: a queue of ours would have become shorter. Where the window
does not become so narrow by itself, as a small one does not, it is narrowed for one round once some in a row
were much longer; later and later while the queue proves to be ours.
"""

from __future__ import annotations

from math import inf

_NARROW = 0.6
_LONGER = 1.1
_MUCH_LONGER = 1.5
_SHORTER = 0.9

_FIRST_AFTER = 8
_LAST_AFTER = 256
_NEWS = 1.25
"""So much longer than with a queue of ours: that was not the reason this time."""


class BaseRtt:
    """Keeps the least round trip until it is proven to be gone.

    Attributes:
        most: so many may be in flight until the round is over, infinite if that does not matter.
    """

    __slots__ = ("_after", "_base", "_longer", "_narrow", "_ours", "_wide_least", "_wide_window", "most")

    def __init__(self) -> None:
        self.most = inf
        self._base = inf
        self._wide_window = 0
        self._wide_least = inf
        self._narrow = False
        self._longer = 0  # rounds in a row
        self._after = _FIRST_AFTER  # so many of them the window is narrowed
        self._ours = 0.0  # the longest round trip that was due to a queue of ours

    def learn(self, least: float, in_flight: int) -> float:
        """Return the base, in seconds, after a round whose least round trip was `least`."""
        was_narrow, self._narrow = self._narrow, in_flight <= _NARROW * self._wide_window
        if least <= _LONGER * self._base:
            self._base = min(least, self._base)
            self._settle()
        elif least == inf:
            return self._base
        elif was_narrow and (self._narrow or self._longer > self._after):
            # Most answers of a first narrow round are still to the wide one's requests.
            if least > _SHORTER * self._wide_least:
                self._base, self._after, self._longer = least, _FIRST_AFTER, 0
            self._settle()
        elif in_flight > self._wide_window or least > _NEWS * self._wide_least:
            self._wide_window, self._wide_least = in_flight, least
        return self._base

    def beyond(self, least: float, window: float, rate: float) -> float:
        """Return for how many seconds the quickest answer of a round waited, other than behind a window that
        is answered at this rate; infinite if none was timed."""
        if least == inf or rate == 0.0:
            return inf
        return max(0.0, least - max(self._base, window / rate))

    def next_window(self, target: float, beside: int) -> float:
        """Return the window for the next round, which wants to be `target`; called after rounds in which
        there was always something to send. beside: requests that are in flight besides."""
        self.most = inf
        if not self._wide_window or self._wide_least < _MUCH_LONGER * self._base:
            return target
        if self._after > _FIRST_AFTER and self._wide_least > _NEWS * self._ours:
            self._after, self._longer = _FIRST_AFTER, 0
        self._longer += 1
        if self._longer == self._after + 1:
            self.most = _NARROW * self._wide_window
            return min(target, max(1.0, self.most - beside))
        if self._longer > self._after + 2:
            self._settle()  # nothing was learned
        return target

    def _settle(self) -> None:
        """It is known why rounds were longer; if the window was narrowed for it, in vain."""
        if self._longer > self._after:
            self._ours = max(self._ours, self._wide_least)
            self._after = min(_LAST_AFTER, 2 * self._after)
        self._wide_window = self._longer = 0
