"""A server that stops for a moment, and how much on the way bridges that. Layer: protocol; pure.

A card that is busy for a tenth of a second (PX4 on NuttX) leaves a slow link idle for as long, unless
answers wait in the link's queue. So while such pauses cost more than they should, some more requests are
kept on the way, up to 0.15 s and half a round trip worth, which is what others then wait for the link at
most; and fewer again when pauses have become rare. Where the server and not the link is the slowest part, no
answers wait in a link, and more requests only overflow the server's buffer: so if pauses are as long with a
reserve as they were without, there is none for a while.

Writes need no answers in a queue, and what waits in front of a small buffer would be lost. But what arrives
while the card pauses is lost as well, and if nothing is sent either because no answers come, the server has
nothing to do a round trip later, for as long again. So while answers pause, writes go on at their pace for
at most 0.4 s; what is lost of them makes room by itself. Reads do the same where no reserve is kept.
"""

from __future__ import annotations

from math import inf

MOST = 0.15
_MOST_ON_A_LONG_WAY = 0.3
_LEAST_PAUSE = 0.020
_INTERVALS = 8
_PERIOD = 2.0
_COSTLY = 0.01
_STEP = 0.05
_BRIDGED = 0.4
_CALM = 10
"""Periods without costly pauses after which none are expected."""

_SMOOTHING = 0.5
_FADE = 0.98
_FADED = 0.02
_TELLING = 0.5
"""Seconds of pauses to expect before it is judged whether a reserve shortens them."""

_USELESS = 0.75
_FIRST_HOLD = 120.0
_LONGEST_HOLD = 960.0


class Stalls:
    """Watches the gaps between answers.

    Attributes:
        reserve: seconds of answers to keep in the link's queue.
        share: of the time lately that pauses took.
        wake: when `silence` grows without an answer.
    """

    __slots__ = (
        "_before",
        "_calm",
        "_expected",
        "_hold",
        "_last",
        "_paused",
        "_seen",
        "_until",
        "_watched",
        "reserve",
        "share",
        "wake",
    )

    def __init__(self) -> None:
        self.reserve = 0.0
        self.share = 0.0
        self.wake = inf
        self._calm = _CALM
        self._last: float | None = None
        self._watched = 0.0
        self._paused = 0.0
        self._before = 0.0  # share of the time that pauses took without a reserve; 0: it was seen to help
        self._expected = self._seen = 0.0  # seconds of pauses with it: as without it, and really
        self._until = -inf  # there is no reserve before
        self._hold = _FIRST_HOLD

    def on_reply(self, now: float, rate: float, rtt: float = 0.0) -> None:
        """A request was answered. rate: answers per second at best, 0 if unknown. rtt: least round trip."""
        last, self._last = self._last, now
        if last is None:
            return
        gap = now - last
        self._watched += gap
        if rate > 0.0 and gap > _LEAST_PAUSE + _INTERVALS / rate:
            self._paused += gap
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
        if self.reserve == 0.0:
            if costly and now >= self._until:
                self.reserve = _STEP
                self._before, self._expected, self._seen = paused / seconds, 0.0, 0.0
        elif self._before and self._is_useless(now, seconds, paused):
            self.reserve = 0.0
        elif costly:
            most = min(MOST + rtt / 2, _MOST_ON_A_LONG_WAY)
            self.reserve = min(most, self.reserve + _STEP)
        else:
            self.reserve *= _FADE
            if self.reserve < _FADED:
                self.reserve = 0.0

    def _is_useless(self, now: float, seconds: float, paused: float) -> bool:
        """Whether pauses take as long as without a reserve; asked until it is known."""
        self._expected += self._before * seconds
        self._seen += paused
        if self._expected < _TELLING:
            return False
        self._before = 0.0
        if self._seen <= _USELESS * self._expected:
            return False
        self._until, self._hold = now + self._hold, min(_LONGEST_HOLD, 2 * self._hold)
        return True
