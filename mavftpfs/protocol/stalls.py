"""A server that stops for a moment, and what bridges that. Layer: protocol; pure.

Where a slow link is what bounds a copy, answers that wait in its queue do (see `reserve`).

Writes need no answers in a queue, and what waits in front of a small buffer would be lost. But what arrives
while the card pauses is lost as well, and if nothing is sent either because no answers come, the server has
nothing to do a round trip later, for as long again. So while answers pause, requests go on at their pace,
for at most 0.4 s; so do reads once their reserve is used up. What is lost of these stays in flight until a
later answer proves it, and often the next pause comes before: they are bridges until then, and for a round
trip at most.

While the server pauses its silence proves nothing: what is asked again it executes twice.
"""

from __future__ import annotations

from collections import deque
from math import inf

from mavftpfs.protocol.reserve import Reserve

_LEAST_PAUSE = 0.020
_INTERVALS = 8
_PERIOD = 2.0
_COSTLY = 0.01
_BRIDGED = 0.4
_SHORT_WAY = 0.03
"""Seconds for which a small buffer has work for the server; who goes on in a pause there only floods it."""

_LONGEST = 0.5
"""Seconds; a longer silence is the link's."""

_SHORTENED = 0.98
_CALM = 10
"""Periods without costly pauses after which none are expected."""

_SMOOTHING = 0.5


class Stalls:
    """Watches the gaps between answers.

    Attributes:
        reserve: the answers to keep in the link's queue.
        share: of the time lately that pauses took.
        bridging: requests go on while answers pause. wake: when there are more of them without an answer.
    """

    __slots__ = (
        "_bridges",
        "_calm",
        "_last",
        "_longest",
        "_paused",
        "_watched",
        "bridging",
        "reserve",
        "share",
        "wake",
    )

    def __init__(self) -> None:
        self.reserve = Reserve()
        self.share = 0.0
        self.bridging = False
        self.wake = inf
        self._calm = _CALM
        self._longest = 0.0
        self._bridges: deque[tuple[float, float]] = deque(maxlen=8)  # their ends, and seconds
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
            self._longest = max(self._longest, min(gap, _LONGEST))
            self._bridges.append((now, min(gap, _BRIDGED)))
            if self.reserve.wanted == 0.0:
                self.reserve.want(now, rtt)
        if self._watched > _PERIOD:
            self._end_period(now, rtt)

    @property
    def usual(self) -> bool:
        """Whether there were pauses lately that cost something."""
        return self._calm < _CALM

    @property
    def patience(self) -> float:
        """For how many seconds a silence is no sign of losses."""
        return self._longest if self.usual else 0.0

    def to_bridge(self, now: float, rate: float, rtt: float, *, kept: bool) -> float:
        """Return for how many seconds of pauses there may be more on the way than a window holds.

        kept: answers may be in reserve for them, too.
        """
        self.bridging = rtt > _SHORT_WAY
        return (self.reserve.seconds if kept else 0.0) + (
            self._silence(now, rate, rtt) if self.bridging else 0.0
        )

    def _silence(self, now: float, rate: float, rtt: float) -> float:
        """Return the seconds of those that were seen, one that may be now included."""
        last = self._last
        if last is None or not self.usual:
            return 0.0
        silence = now - last
        if silence < _BRIDGED and rate > 0.0:
            self.wake = now + _INTERVALS / rate
        bridges = self._bridges
        while bridges and last >= bridges[0][0] + rtt:
            bridges.popleft()
        return min(min(silence, _BRIDGED) + sum(seconds for _, seconds in bridges), 2 * _BRIDGED)

    def on_loss(self, rate: float) -> None:
        """A request was lost, of the oldest pause as it seems. rate: as for `on_reply`."""
        if self._bridges and rate > 0.0:
            end, seconds = self._bridges.popleft()
            if seconds > 1.0 / rate:
                self._bridges.appendleft((end, seconds - 1.0 / rate))

    def interrupt(self) -> None:
        """Too little was asked for: the gap before the next answer means nothing."""
        self._last = None

    def _end_period(self, now: float, rtt: float) -> None:
        seconds, paused = self._watched, self._paused
        self._watched = self._paused = 0.0
        self.share += (paused / seconds - self.share) * _SMOOTHING
        costly = paused > _COSTLY * seconds
        self._calm = 0 if costly else self._calm + 1
        self._longest *= _SHORTENED
        self.reserve.end_period(now, rtt, seconds, paused, costly=costly)
