"""A token bucket for the bytes that may be sent. Layer: protocol; pure."""

from __future__ import annotations

from math import inf


class Bucket:
    """A token bucket: bytes accrue at a rate, a few of them are kept, and sent bytes are charged.

    Args:
        depth: bytes that are kept at least, and the most that may be sent at once after a pause.
        tick: seconds; the bytes of a tick are kept, too, because timers are not more precise.

    Attributes:
        rate: bytes per second, inf for no limit.
    """

    def __init__(self, depth: float, tick: float) -> None:
        self.rate = inf
        self._depth, self._tick = depth, tick
        self._level, self._at = depth, 0.0

    def level(self, now: float) -> float:
        """Return the bytes that may be sent now; inf for no limit, negative after an overdraft."""
        if self.rate == inf:
            return inf
        self._level = min(
            max(self._depth, self.rate * self._tick), self._level + (now - self._at) * self.rate
        )
        self._at = now
        return self._level

    def charge(self, size: float) -> None:
        """Note that so many bytes go out."""
        self._level = max(-self._depth, self._level - size)

    def holds_at(self, size: float) -> float:
        """Return when so many bytes may be sent, if nothing is sent before."""
        return self._at + (size - self._level) / self.rate + 1e-6
