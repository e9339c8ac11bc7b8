"""A server that stops for a moment, and how much on the way bridges that. Layer: protocol; pure.

A card that is busy for a tenth of a second (PX4 on NuttX) leaves a slow link idle for as long, unless
answers wait in the link's queue. So once such a pause cost more than it should, some more requests are
kept on the way, up to 0.25 s and half a round trip worth, which is what others then wait for the link at
most; fewer while others are about, and fewer again when pauses have become rare. Where the server and not
the link is the slowest part, no answers wait in a link, and more requests only overflow the server's buffer:
so if pauses take as long with a reserve as they did without, there is none for a while. Chance decides that
at times, so the while is short at first, and adds to what is known of pauses without a reserve.

Writes need no answers in a queue, and what waits in front of a small buffer would be lost. But what arrives
while the card pauses is lost as well, and if nothing is sent either because no answers come, the server has
nothing to do a round trip later, for as long again. So while answers pause, writes go on at their pace for
at most 0.4 s; what is lost of them makes room by itself. Reads do the same where no reserve is kept.
"""

from __future__ import annotations

from math import inf

MOST = 0.25
_MOST_ON_A_LONG_WAY = 0.4
BESIDE_OTHERS = 0.1
_LATELY = 10.0
"""Seconds for which others are expected to come again."""

_LEAST_PAUSE = 0.020
_INTERVALS = 8
_PERIOD = 2.0
_COSTLY = 0.01
_BRIDGED = 0.4
_CALM = 10
"""Periods without costly pauses after which none are expected."""

_SMOOTHING = 0.5
_FADE = 0.98
_FADED = 0.05
_MEMORY = 0.9
_TELLING = 1.0
"""Seconds of pauses to expect before it is judged whether a reserve shortens them."""

_USELESS = 0.75
_BEARABLE = 0.05
"""The share of the time that pauses are expected to take at least: few were seen, perhaps by chance."""

_FIRST_HOLD = 8.0
_SLOWLY = 0.2
_MUCH_LOSS = 0.3
_MANY_ROUNDS = 4
_BEYOND_DOUBT = 1.5
"""Seconds of such rounds."""

_SURE_HOLD = 120.0
_LONGEST_HOLD = 960.0


class Stalls:
    """Watches the gaps between answers.

    Attributes:
        reserve: seconds of answers to keep in the link's queue.
        share: of the time lately that pauses took.
        wake: when `silence` grows without an answer.
    """

    __slots__ = (
        "_bare_loss",
        "_bare_paused",
        "_bare_seconds",
        "_calm",
        "_drowned",
        "_dry_at",
        "_expected",
        "_hold",
        "_last",
        "_others_at",
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
        self._bare_loss = self._bare_paused = 0.0  # without a reserve, lately
        self._bare_seconds = 1.0
        self._dry_at = -inf  # the last round that lost no more than without a reserve
        self._drowned = 0  # rounds since then
        self._expected = self._seen = 0.0  # seconds of pauses with it: as without it, and really
        self._others_at = -inf
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
        waits = not self.reserve and now >= self._until  # for the first pause
        if self._watched > _PERIOD or (waits and self._paused):
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

    def on_others(self, now: float) -> None:
        """Somebody waits for an answer beside a transfer, and may again soon."""
        self._others_at = now
        self.reserve = min(self.reserve, BESIDE_OTHERS)

    def _end_period(self, now: float, rtt: float) -> None:
        seconds, paused = self._watched, self._paused
        self._watched = self._paused = 0.0
        self.share += (paused / seconds - self.share) * _SMOOTHING
        costly = paused > _COSTLY * seconds
        self._calm = 0 if costly else self._calm + 1
        if self.reserve == 0.0:
            self._bare_seconds = _MEMORY * self._bare_seconds + seconds
            self._bare_paused = _MEMORY * self._bare_paused + paused
            if not costly or now < self._until:
                return
            self._expected = self._seen = 0.0
        elif self._is_useless(seconds, paused):
            self._give_up(now)
            return
        if costly:
            alone = now >= self._others_at + _LATELY
            self.reserve = min(MOST + rtt / 2, _MOST_ON_A_LONG_WAY) if alone else BESIDE_OTHERS
        else:
            self.reserve *= _FADE
            if self.reserve < _FADED:
                self.reserve = 0.0

    def _is_useless(self, seconds: float, paused: float) -> bool:
        """Whether pauses take as long as without a reserve; asked until it is known."""
        if self._expected >= _TELLING:
            return False
        self._expected += max(_BEARABLE, self._bare_paused / self._bare_seconds) * seconds
        self._seen += paused
        return self._expected >= _TELLING and self._seen > _USELESS * self._expected

    def on_round(self, now: float, lost: float) -> None:
        """Of the requests of a round that is over this share was lost. Pauses cost some of many rounds; who
        loses many in each overflows a buffer."""
        if self.reserve == 0.0:
            self._bare_loss += (lost - self._bare_loss) * _SLOWLY
        if self.reserve == 0.0 or lost < self._bare_loss + _MUCH_LOSS:
            self._dry_at, self._drowned = now, 0
            return
        self._drowned += 1
        if self._drowned >= _MANY_ROUNDS and now > self._dry_at + _BEYOND_DOUBT:
            self._hold = max(_SURE_HOLD, self._hold)
            self._give_up(now)

    def _give_up(self, now: float) -> None:
        self.reserve = 0.0
        self._until, self._hold = now + self._hold, min(_LONGEST_HOLD, 2 * self._hold)
