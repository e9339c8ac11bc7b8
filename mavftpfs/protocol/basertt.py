"""The round trip of the empty path. Layer: protocol; pure."""

from __future__ import annotations

from math import inf

_NARROW = 0.6


class BaseRtt:
    """Keeps the least round trip, until two rounds of a much narrower window prove that it is gone: most
    answers of the first are still to the wide one's requests."""

    __slots__ = ("_base", "_narrow", "_wide_least", "_wide_window")

    def __init__(self) -> None:
        self._base = inf
        self._wide_window = 0
        self._wide_least = inf
        self._narrow = False

    def learn(self, least: float, in_flight: int) -> float:
        """Return the base, in seconds, after a round whose least round trip was `least`."""
        was_narrow, self._narrow = self._narrow, in_flight <= _NARROW * self._wide_window
        if least <= 1.1 * self._base:
            self._base = min(least, self._base)
            self._wide_window = 0
        elif least == inf:
            return self._base
        elif in_flight > self._wide_window:
            self._wide_window, self._wide_least = in_flight, least
        elif self._narrow and was_narrow:
            # A queue of ours would have become shorter.
            if least > 0.9 * self._wide_least:
                self._base = least
            self._wide_window = 0
        return self._base
