"""A server that stops for a moment, and what bridges that. Layer: protocol; pure.

Where a slow link is what bounds a copy, answers that wait in its queue do (see `reserve`).

Writes need no answers in a queue, and what waits in front of a small buffer would be lost. But what arrives
while the card pauses is lost as well, and if nothing is sent either because no answers come, the server has
nothing to do a round trip later, for as long again. So while answers pause, writes go on at their pace for
at most 0.4 s; what is lost of them makes room by itself. Reads do the same where no reserve is kept.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.reserve import Reserve

_LEAST_PAUSE = 0.020
_INTERVALS = 8
_PERIOD = 2.0
_COSTLY = 0.01
_BRIDGED = 0.4
_CALM = 10
"""Periods without costly pauses after which none are expected."""

_SMOOTHING = 0.5


class Stalls:
    """Watches the gaps between answers.

    Attributes:
        reserve: the answers to keep in the link's queue.
        share: of the time lately that pauses took.
        wake: when `silence` grows without an answer.
    """

    __slots__ = ("_calm", "_last", "_paused", "_watched", "reserve", "share", "wake")

    def __init__(self) -> None:
        self.reserve = Reserve()
        self.share = 0.0
        self.wake = inf
        self._calm = _CALM
        self._last: float | None = None
        self._watched = 0.0
        self._paused = 0.0

    def on_reply(self, now: float, rate: float, rtt: float = 0.0) -> None:
        """A request was answered. rate: answers per second at best, 0 if unknown. rtt: least round trip."""
        last, self._last = self._last, now
        if last is None:
            return
        gap = now - last
        self._watched += gap
        if rate > 0.0 and gap > _LEAST_PAUSE + _INTERVALS / rate:
            self._paused += gap
            if self.reserve.wanted == 0.0:
                self.reserve.want(now, rtt)
        if self._watched > _PERIOD:
            self._end_period(now, rtt)

    @property
    def usual(self) -> bool:
        """Whether there were pauses lately that cost something."""
        return self._calm < _CALM

    def silence(self, now: float, rate: float) -> float:
        """Return for how many seconds of a pause writes go on at their pace (see above)."""
        if self._last is None or not self.usual:
            return 0.0
        seconds = now - self._last
        if seconds < _BRIDGED and rate > 0.0:
            self.wake = now + _INTERVALS / rate
        return min(seconds, _BRIDGED)

    def interrupt(self) -> None:
        """Too little was asked for: the gap before the next answer means nothing."""
        self._last = None

    def _end_period(self, now: float, rtt: float) -> None:
        seconds, paused = self._watched, self._paused
        self._watched = self._paused = 0.0
        self.share += (paused / seconds - self.share) * _SMOOTHING
        costly = paused > _COSTLY * seconds
        self._calm = 0 if costly else self._calm + 1
        self.reserve.end_period(now, rtt, seconds, paused, costly=costly)
