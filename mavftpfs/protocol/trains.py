"""The pace of the slowest part of the way, and keeping it. Layer: protocol; pure.

Requests that leave in one go pass the slowest part at its own pace, and so do their answers: a few of them
tell the rate of the path long before the window fills it, and whatever is lost besides. Who sends no faster
than that fills no queue, however short it is, while the window grows to what the path holds.

Where answers come in bunches (a slow reader, a modem that gathers) they seem infinitely close: then
nothing is known, and nothing is held back.
"""

from __future__ import annotations

from collections import deque
from math import inf

_LENGTH = 6
_TELLING_ROUND = _LENGTH + 2
_ROUNDS_REMEMBERED = 10
_DENSE = 1.5
_SAME = 1.1
GAIN = 1.1
_DEPTH = 4.0
_FEWEST = 2.0
_LONGEST_ROW = 0.1
"""Seconds of the path that more than _FEWEST may take which leave in one go: others wait behind them."""

_DEPTH_SECONDS = 0.004
_PLENTY = 1 << 16
_SCANT = 0.75

FASTEST_LINK = 6000.0
"""Answers per second (1.4 MB/s) beyond which no radio is on the way."""


class Trains:
    """Watches answers, paces requests.

    Attributes:
        rate: answers per second in the densest row of them lately; infinite before the first long round, and
            where bunches tell nothing.
        proven: it is the path's own, and not just how we sent.
    """

    __slots__ = (
        "_answers",
        "_blocked",
        "_densest",
        "_gain",
        "_rounds",
        "_seconds",
        "_times",
        "_tokens",
        "_tokens_at",
        "proven",
        "rate",
    )

    def __init__(self) -> None:
        self.rate = inf
        self.proven = False
        self._densest = inf
        self._answers = 0
        self._seconds = 0.0  # that they took
        self._times = deque([-inf] * _LENGTH, maxlen=_LENGTH)
        self._rounds: deque[float] = deque(maxlen=_ROUNDS_REMEMBERED)
        self._blocked = False
        self._gain = GAIN
        self._tokens = 0.0
        self._tokens_at = 0.0

    # --- watching

    def on_reply(self, now: float) -> None:
        """A request was answered."""
        times = self._times
        took = now - times[0]
        if took < self._densest:
            self._densest = took
        times.append(now)

    def learn(self, rate: float) -> None:
        """Requests that left together were answered at this pace (per second); the round is not over yet."""
        if not self._rounds:
            self.rate = rate
            self.proven = True

    def on_replies(self, count: int, now: float) -> None:
        """So many requests were answered at once."""
        for _ in range(min(count, _LENGTH + 1)):  # more of the same instant say nothing new
            self.on_reply(now)

    def end_round(self, answers: int, average: float) -> None:
        """A round in which there was always something to send is over; average: its answers per second.

        Who keeps a pace never sees many answers in a round once the way has become short: there several
        rounds count as one, or the pace of a slow link would be kept for ever.
        """
        if self.proven and average > 0.0:
            self._seconds += answers / average
            answers = self._answers = self._answers + answers
            if answers < _TELLING_ROUND:
                return
            average = answers / self._seconds
        if answers >= _TELLING_ROUND:
            before = self.rate
            self._rounds.append(_LENGTH / self._densest if self._densest > 0 else inf)
            self.rate = max(self._rounds)
            dense = self.rate > _DENSE * average
            self.proven = self.rate < inf and (dense or self.rate <= _SAME * before < inf)
        self._answers, self._seconds = 0, 0.0
        self._densest = inf

    def bunched(self, rate: float) -> bool:
        """Whether answers come in much denser rows than so many per second, which were got at best."""
        return rate < _SCANT * self.rate

    # --- pacing

    def begin(self) -> None:
        """It is looked at anew who wants to send: nobody was held back yet."""
        self._blocked = False

    def room(self, now: float, gain: float = GAIN, *, briefly: bool = False) -> int:
        """Return how many requests may go out now. gain: so many times the pace that was seen. briefly: what
        goes out together must not take long, since others may come."""
        if not self.proven:
            return _PLENTY
        self._gain = gain
        pace = gain * self.rate
        deepest = max(_DEPTH, pace * _DEPTH_SECONDS)
        if briefly:
            deepest = max(_FEWEST, min(deepest, pace * _LONGEST_ROW))
        self._tokens = min(deepest, self._tokens + (now - self._tokens_at) * pace)
        self._tokens_at = now
        room = int(self._tokens)
        self._blocked = room == 0
        return room

    def next_room_at(self) -> float:
        """Return when there will be room for one more, if there is none now; else infinite."""
        if not self._blocked or not self.proven:
            return inf
        return self._tokens_at + (1.0 - self._tokens) / (self._gain * self.rate) + 1e-6

    def on_sent(self, count: int) -> None:
        """So many requests go out."""
        self._tokens = max(-_DEPTH, self._tokens - count)
        self._blocked = self._tokens < 1.0
