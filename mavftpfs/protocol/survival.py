"""The largest window that a small receive buffer survives. Layer: protocol; pure.

Theory. PX4 takes requests from a serial port by a receiver thread that also executes them, so what arrives
meanwhile must fit a small buffer, and what does not is lost without a word (servers.md 3). Such losses look
like those of a bad radio, but they grow with the window and bring nothing: where the buffer holds n, n + 1
in flight are answered no faster than n. So the window grows by half a round, at least by one, until something
is lost; from then on neighbouring windows are *compared*: each is kept for some rounds, and the wider one has
to bring at least half of the answers per second that it promises, or a little where no more is lost. How many
requests tell that depends on how many are lost anyhow. Random loss takes the same share of both, so it moves
the window nowhere; and where the link and not the buffer is the limit, a wider window brings nothing either
but a queue in which others wait: what fills the way is the most.
"""

from __future__ import annotations

from math import inf

_WORTH = 0.5
"""The share of a step's promise that must show in the answers for the wider window to be kept."""

_WORTH_INNOCENT = 0.15
"""The same where no more is lost: the link may be nearly full, but it is the link."""

_HARMLESS = 0.25
"""The share of what an overflow would lose, below which no more is lost."""

_NOTICEABLE = 0.03
_SUDDEN = 0.2
_SECOND_THOUGHT = 2.5
_REMEMBERED = 60.0
_GROWN = 1.1
_OVERSHOT = 2
"""At the first loss it goes back so far, or by what it grew in a round: it grew while the loss was not known.
To go back further costs a long way many seconds: it comes back by comparing."""

_SETTLING = 2
_WATCHED = 40
_FEWEST = 8
_MOST = 600
_CERTAINTY = 6.0
_MOST_LOSS = 0.8
_SHORTEST_HOLD = 2.0
_LONGEST_HOLD = 16.0


class _Sample:
    """What became of the requests of some rounds with one window."""

    __slots__ = ("answered", "lost", "queued", "seconds")

    def __init__(self) -> None:
        self.answered = 0
        self.lost = 0
        self.seconds = self.queued = 0.0

    def add(self, answered: int, lost: int, seconds: float, *, queued: bool) -> None:
        self.answered += answered
        self.lost += lost
        self.seconds += seconds
        self.queued += seconds * queued

    @property
    def total(self) -> int:
        return self.answered + self.lost

    @property
    def loss(self) -> float:
        return self.lost / self.total if self.total else 0.0

    @property
    def rate(self) -> float:
        return self.answered / self.seconds if self.seconds > 0 else 0.0


class Survival:
    """Finds a small window, growing from 1 to `cap` at most. window: the one in use."""

    __slots__ = (
        "_before",
        "_best_rate",
        "_cap",
        "_careful",
        "_doubted",
        "_first",
        "_held",
        "_high",
        "_hold",
        "_hold_until",
        "_loss",
        "_low",
        "_most",
        "_sample",
        "_second",
        "_settled",
        "_settling",
        "_usual_loss",
        "window",
    )

    def __init__(self, cap: int) -> None:
        self.window = 1
        self._cap = cap
        self._most = inf  # so many fill the way
        self._before = 1  # the window of the round before, while nothing is lost
        self._careful = False
        self._settled = 1  # the best one so far
        self._held = 0  # the last one that was held
        self._low = self._high = 0  # the pair that is compared; 0: none is, the window is held
        self._first: _Sample | None = None  # of the narrower one, while the wider one is measured
        self._second = _Sample()  # of the wider one so far, while the narrower one is measured
        self._sample = _Sample()
        self._settling = 0
        self._doubted = False
        self._usual_loss = 0.0
        self._loss = 0.0
        self._best_rate = 0.0  # while nothing is lost
        self._hold = _SHORTEST_HOLD
        self._hold_until = 0.0

    def end_round(
        self,
        answered: int,
        lost: int,
        seconds: float,
        now: float,
        *,
        most: float = inf,
        disturbed: bool = False,
    ) -> int:
        """Return the window for the next round.

        answered, lost, seconds: of the round that ended, in which there was always something to send.
        most: if even the quickest answer had to wait, so that a wider window would only lengthen a queue: so
        many fill the way, if the quickest answers ever tell its length; else infinite.
        disturbed: others waited for an answer, to whom the window gave way.
        """
        if disturbed and self._careful:
            return self.window  # that compares with nothing
        if queued := most < inf:
            self._most = most
        total = answered + lost
        self._loss += (lost / total - self._loss) * min(1.0, total / _REMEMBERED)
        if not self._careful:
            self._grow(answered / seconds if seconds > 0 else 0.0, lost, most, now)
        elif self._settling:
            self._settling -= 1
        else:
            self._sample.add(answered, lost, seconds, queued=queued)
            if self._sample.total >= self._enough():
                self._judge(now)
        return self.window

    def end_idle_round(self, sent: int, lost: int) -> int:
        """Return the window after a round in which there was not always something to send. sent: so many were
        on their way at its end, which tells as much if it is all that the window allows."""
        if sent >= self.window and not lost and not self._careful:
            self._grow(0.0, 0, inf, 0.0)
        return self.window

    def _grow(self, rate: float, lost: int, most: float, now: float) -> None:
        """Nothing was lost so far."""
        self._careful = lost > 0 and self._cap > 1
        if self._careful:
            self._settled = low = max(1, min(self.window - _OVERSHOT, self._before))
            self._compare(low, low + 1)
        elif most == inf or rate > _GROWN * self._best_rate:
            self._before = self.window
            self.window = self._settled = min(self.window + max(1, self.window // 2), self._cap)
        elif self.window > most:
            self._careful = True
            self._keep(max(1, int(most)), _Sample(), now)
        self._best_rate = max(rate, self._best_rate)

    def _enough(self) -> int:
        """Return how many requests tell the pair apart at the present loss."""
        # Not by the sample's own: chance would end the lucky ones early.
        loss = min(_MOST_LOSS, self._loss)
        if not self._low:
            return _WATCHED
        parts = self._high / (self._high - self._low)
        enough = max(_FEWEST, 3 * self.window, _CERTAINTY * parts * parts * loss / (1.0 - loss))
        return int(min(_MOST, enough * (_SECOND_THOUGHT if self._doubted else 1.0)))

    # --- comparing two windows

    def _compare(self, low: int, high: int, first: _Sample | None = None) -> None:
        """Begin to compare two windows; first: what is known of the narrower one."""
        self._low, self._high, self._first = low, min(high, self._cap), first
        self._second, self._doubted = _Sample(), False
        self._use(low if first is None else self._high, _Sample())

    def _use(self, window: int, sample: _Sample) -> None:
        self.window, self._sample = window, sample
        self._settling = _SETTLING

    def _judge(self, now: float) -> None:
        first = self._first
        if not self._low:
            self._watch(now)
        elif first is None:
            self._first = self._sample
            self._use(self._high, self._second)
        elif self._is_better(self._sample, first):
            self._widen(self._sample, now)
        elif not self._doubted:
            self._doubted = True  # so few may mislead: some more of both
            self._second, self._first = self._sample, None
            self._use(self._low, first)
        else:
            self._narrow(first, now)

    def _is_better(self, wide: _Sample, narrow: _Sample) -> bool:
        step = self._high / self._low - 1.0
        # What an overflow loses is what goes out beyond what the narrower window did.
        innocent = wide.loss <= narrow.loss + _HARMLESS * (1.0 - narrow.loss) * step / (1.0 + step)
        return wide.rate >= (1.0 + (_WORTH_INNOCENT if innocent else _WORTH) * step) * narrow.rate

    def _widen(self, wide: _Sample, now: float) -> None:
        """The wider one is better: go on, by larger steps, if it is wider than what was settled for."""
        step, window = self._high - self._low, self._high
        if self._settled < window < self._cap and not self._only_queues(wide, window + 1):
            self._settled = window
            self._compare(window, window + max(1, min(2 * step, window // 2)), wide)
        else:
            self._keep(window, wide, now)

    def _narrow(self, narrow: _Sample, now: float) -> None:
        """The wider one brings nothing: look nearer by, or whether the narrower one is too wide as well."""
        step = self._high - self._low
        if step > 1:
            self._compare(self._low, self._low + step // 2, narrow)
        elif self._low > 1 and narrow.loss > _NOTICEABLE:
            self._settled = self._low
            self._compare(self._low - 1, self._low)
        else:
            self._keep(self._low, narrow, now)

    def _keep(self, window: int, sample: _Sample, now: float) -> None:
        failed = window == self._held == self._low  # the wider one, again
        self._hold = min(_LONGEST_HOLD, 2 * self._hold) if failed else _SHORTEST_HOLD
        self._settled = self._held = window
        self._usual_loss = sample.loss
        self._low, self._doubted = 0, False
        self._use(window, _Sample())
        self._hold_until = now + self._hold

    # --- holding

    def _watch(self, now: float) -> None:
        """Look again when it is time, when much more is lost than before (writes are larger), or where a
        queue stands in which others wait: perhaps fewer bring as much."""
        sample, window = self._sample, self.window
        suspect = sample.loss > self._usual_loss + _SUDDEN or self._only_queues(sample, window)
        if suspect and window > 1:
            self._compare(window - 1, window)
        elif now >= self._hold_until and window < self._cap and not self._only_queues(sample, window + 1):
            self._compare(window, window + 1, sample)
        else:
            self._sample = _Sample()

    def _only_queues(self, sample: _Sample, window: int) -> bool:
        """Whether a queue stood most of the time, which so wide a window would only lengthen."""
        return window > self._most and sample.queued > sample.seconds / 2
