"""The speed of a transfer, for people. Layer: shared; pure."""

from __future__ import annotations

from collections import deque
from math import inf


class Speed:
    """The mean over the last SPAN seconds, pauses included; None before it is known.

    The first bytes of a transfer, and those after a pause, do not count, because they arrive at the speed of
    the buffers on the way. All times in seconds of one clock.
    """

    SPAN = 10.0
    KNOWN = 2.0
    """Seconds with bytes before a speed is reported."""
    SETTLING = 1.0
    """Seconds from the first byte until they count."""
    PAUSE = 5.0
    """Seconds without a byte after which the measurement starts again."""
    _STEP = 0.25

    def __init__(self) -> None:
        self._moved = 0
        self._last = self._settled = -inf
        self._samples: deque[tuple[float, int]] = deque()

    def on_bytes(self, count: int, now: float) -> None:
        """Note that `count` bytes moved."""
        if now - self._last > self.PAUSE:
            self._samples.clear()
            self._settled = now + self.SETTLING
        self._last = now
        self._moved += count
        samples = self._samples
        if now >= self._settled and (not samples or now - samples[-1][0] >= self._STEP):
            samples.append((now, self._moved))
            while now - samples[0][0] > self.SPAN:
                samples.popleft()

    def at(self, now: float) -> float | None:
        """Return bytes per second, None while unknown."""
        if not self._samples or now - self._last > self.PAUSE:
            return None
        began, before = self._samples[0]
        return (self._moved - before) / (now - began) if now - began >= self.KNOWN else None
