"""A server that stops for a moment, and how much on the way bridges that. Layer: protocol; pure.

A card that is busy for a tenth of a second (PX4 on NuttX) leaves a slow link idle for as long, unless
answers wait in the link's queue. So while such pauses cost more than they should, some more requests are
kept on the way, up to 0.15 s worth, which is what others then wait for the link at most; and fewer again
when pauses have become rare.
"""

from __future__ import annotations

MOST = 0.15
_LEAST_PAUSE = 0.020
_INTERVALS = 8
_PERIOD = 2.0
_COSTLY = 0.01
_STEP = 0.05
_FADE = 0.98


class Stalls:
    """Watches the gaps between answers. reserve: seconds of answers to keep in the link's queue."""

    __slots__ = ("_began", "_last", "_paused", "reserve")

    def __init__(self) -> None:
        self.reserve = 0.0
        self._last: float | None = None
        self._began = 0.0
        self._paused = 0.0

    def on_reply(self, now: float, rate: float) -> None:
        """A request was answered. rate: answers per second at best, 0 if unknown."""
        last, self._last = self._last, now
        if last is None:
            self._began = now
        elif rate > 0.0 and now - last > _LEAST_PAUSE + _INTERVALS / rate:
            self._paused += now - last
        if now - self._began > _PERIOD:
            self._end_period(now)

    def interrupt(self) -> None:
        """Too little was asked for: the gap before the next answer means nothing."""
        self._last = None
        self._paused = 0.0

    def _end_period(self, now: float) -> None:
        if self._paused > _COSTLY * (now - self._began):
            self.reserve = min(MOST, self.reserve + _STEP)
        else:
            self.reserve *= _FADE
        self._began = now
        self._paused = 0.0
