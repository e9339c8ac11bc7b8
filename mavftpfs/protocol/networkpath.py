"""The network path, as far as it is known: rate, round trip, losses. Layer: protocol; pure.

The path is all that lies between a request and its answer: link, server and card. Its slowest part, the
bottleneck, answers so many requests per second; more of them wait in a queue before it, or are lost. What may
go out is `flow.py`'s question. This module learns from the answers:

- `rate`: the bottleneck's, in answers per second. The best of the last ten rounds counts, because what the
  path carried lately it can carry.
- `shortest`: the minimum round trip, which no queue made longer. A path may become longer, too. So if no
  answer was as quick for half a minute, a search begins (`probing`): the window is narrow for two rounds, so
  that queues drain, and the quickest answer of the third round is the new minimum.
- `spread`: by how much the usual round trip is longer, because some answers come in bunches.
- `loss`: the share of requests that the link loses. Losses while a queue stands, or while the server pauses,
  do not count, because a buffer overflows then.
- `tolerance`: how much of what goes out beyond rate times round trip the path takes. It falls with each round
  that loses more than usual, and rises with each other one.

Losses while a queue stands are *congestion*. If that queue is long, all rates of earlier rounds are
forgotten.

At the *start* the path was never full, so it may carry much more than `rate`. The start ends when the rate
stops growing, a queue stands, or much is lost.

A *round* is the time until a request that was sent after the round's start is answered. The shortest round
trip is learned at once, all else at the end of a round. A round is *app-limited* if there was room and
nothing to send, or if `bwlimit=` held requests back. Its rate counts only if it is the best one.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf, sqrt

from mavftpfs.protocol.pauses import Pauses
from mavftpfs.protocol.payload import MAX_DATA

# --- rounds

ROUNDS = 10
"""The rate is the best one of so many rounds: enough to outlast a bad round, few enough to notice a changed
link. Each round has at least so many answers: the best of shorter rounds would be the luckiest one."""

TICK = 0.005
"""Seconds: a shorter delay is no queue, and no round is shorter. Timers and batches on both ends are not more
precise."""

SMOOTHING = 0.2
"""The share that one round counts for in an average, at most."""

STEP = 0.25
"""A quarter. The start goes on while the rate grows by so much. By so much more the window and the pace ask
for a higher rate, by so much less the window lets queues drain, and the tolerance falls."""

FLAT_ROUNDS = 3
"""The start ends after so many rounds in which the rate did not grow: a wider window takes two rounds to
show."""

FEW = 8
"""Answers: at the start a queue grows fast, so that a round ends as soon as so many of them waited in one.
Fewer losses than twice so many do not end the start."""

# --- round trips and queues

SEARCH = 30.0
"""Seconds without an answer as quick as the shortest round trip, after which that is searched anew."""

LEAST_TRIP = 0.0005
"""Seconds: no round trip counts for less. Both ends of a fast path work in batches. The requests of so long a
time keep them busy; more would only wait, and cost them time."""

LITTLE = 0.05
"""Seconds by which an answer may be late before it counts as one that waited in a queue, at most. The spread
is at most so much, too."""

QUEUE_SHARE = 0.15
"""A queue stands if the quickest answer of a round took longer than the shortest round trip: by 15 % of that
(LITTLE at most), plus TICK, plus twice the jitter of the round, which is no queue."""

QUEUE = 0.1
"""Seconds of answers that wait in a link's queue on purpose where a server pauses, so that the link sends
them meanwhile."""

# --- losses

LOSS_MEMORY = 100
"""Requests over which the share of losses is averaged, at least."""

LOSS_RISE, MOST_LOSS = 0.1, 0.34
"""The share of losses rises more slowly than it falls, by LOSS_RISE: losses of a link stay, those of an
overflowing queue go. At most MOST_LOSS, 19 % each way, is made up for. A round of the start that loses more
ends the start."""

UNUSUAL = 3.0
"""A round lost more than usual if its loss is so many standard deviations above the usual one."""

TOLERANCE_RISE = 0.06
"""Each round adds so much to the tolerance. A round that lost more than usual takes a STEP of it away,
because a short queue overflowed."""

OVERHEAD, CHUNK_COST = 58, 58 + MAX_DATA
"""Bytes that a request and its answer take on the link: besides the data that one of them carries, and with a
whole chunk of data."""


@dataclass(slots=True)
class Round:
    """The answers and losses since a round began.

    Attributes:
        began: when; -inf before the first answer.
        end: the order of the first request that was sent after that.
        answered, lost: how many requests were. size: bytes of the answered ones and their answers.
        least: the shortest round trip, in seconds. total: the sum of all. timed: how many there were.
    """

    began: float = -inf
    end: int = -1
    answered: int = 0
    lost: int = 0
    size: int = 0
    least: float = inf
    total: float = 0.0
    timed: int = 0

    def waited(self, shortest: float, times: float = 1.0, reserve: float = 0.0) -> bool:
        """Return whether even the quickest answer waited in a queue: `times` as long as what counts as a
        little. reserve: seconds that it waited on purpose."""
        if self.least == inf:
            return False
        little = min(QUEUE_SHARE * shortest, LITTLE) + TICK
        jitter = self.total / self.timed - self.least
        return self.least > shortest + times * little + 2.0 * jitter + reserve


class NetworkPath:
    """A model of the path: what its answers and losses show.

    Attributes:
        rate: answers per second that the path carries, 0 before the first round is over.
        shortest: the shortest round trip in seconds, inf before the first.
        spread: seconds by which the usual round trip is longer.
        probing: rounds that are left of the search for the shortest round trip, 0 without one. The window is
            narrow until it is 1.
        loss: the share of requests that the link loses, 0..1.
        tolerance: the share, 0..1, of what goes out beyond rate times round trip that the path takes.
        cost: bytes that a usual request and its answer take on the link.
        rounds: so many are over.
        app_limited: this round is app-limited.
        pauses: the server's.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self._rates: deque[float] = deque(maxlen=ROUNDS)
        self.shortest, self._shortest_seen = inf, 0.0
        self.spread = 0.0
        self.probing = 0
        self.loss = 0.0
        self.tolerance = 1.0
        self.cost = float(CHUNK_COST)
        self.rounds = 0
        self.app_limited = False
        self.pauses = Pauses()
        self._flat = 0  # rounds of the start, one after the other, in which the rate did not grow
        self._round = Round()

    @property
    def starting(self) -> bool:
        """Whether the path was never full, as far as is known."""
        return self._flat < FLAT_ROUNDS

    @property
    def per_answer(self) -> float:
        """So many requests bring one answer, on average."""
        return 1.0 / (1.0 - min(self.loss, MOST_LOSS))

    @property
    def reserve(self) -> float:
        """Seconds of answers that are to wait in the link's queue, because the server pauses."""
        return self.tolerance * QUEUE if self.pauses.length and not self.probing else 0.0

    # --- what happens

    def on_answers(self, now: float, rtt: float | None, count: int, size: int) -> None:
        """Note that `count` requests were answered together. rtt: None if it is not known. size: bytes of
        data that each of them, or its answer, carries."""
        this = self._round
        this.answered += count
        this.size += count * (OVERHEAD + size)
        self.pauses.on_answers(now, rtt, self.shortest, self.rate)
        if rtt is not None:
            this.least = min(this.least, rtt)
            if rtt <= self.shortest:
                self.shortest, self._shortest_seen = rtt, now
            this.total += rtt * count
            this.timed += count

    def on_loss(self) -> None:
        """Note that a request was declared lost."""
        self._round.lost += 1

    def on_late(self) -> None:
        """Note that a request that had been declared lost was answered after all."""
        self._round.lost = max(0, self._round.lost - 1)

    def on_app_limited(self) -> None:
        """Note that there was room and nothing to send."""
        self.app_limited = True
        self.pauses.on_app_limited()

    def end_round(self, newest: int, next_order: int, now: float) -> bool:
        """Return whether the round is over; if so, learn from it and begin the next one. newest: the order of
        the last transmission that was answered. next_order: the order that the next one will get."""
        this = self._round
        if not self._is_over(this, newest, now):
            return False
        self.rounds += 1
        if -inf < this.began < now:
            self._learn(this, now)
        self._round, self.app_limited = Round(now, next_order), False
        return True

    # --- rounds

    def _is_over(self, this: Round, newest: int, now: float) -> bool:
        """Return whether a round is over, and long enough to learn from it."""
        if newest >= this.end and now >= this.began + TICK:
            return this.answered >= ROUNDS or self.starting or self.app_limited
        return self.starting and this.timed >= FEW and this.waited(self.shortest)

    def _learn(self, this: Round, now: float) -> None:
        """Learn from a round that is over."""
        total, before, reserve = this.answered + this.lost, self.rate, self.reserve
        queued = this.waited(self.shortest)
        # Requests that arrive while a server pauses overflow its buffer, and answers wait. That says nothing
        # of the link.
        paused = self.pauses.touch(this.began, self.shortest)
        congested = this.lost > 0 and not paused and this.waited(self.shortest, 1.0, reserve)
        usual = self.loss * total
        lost_too_much = congested or this.lost > usual + UNUSUAL * sqrt(usual + 1.0)
        self._learn_loss(this, losses=not (paused or queued))
        self._learn_trips(this, now)
        if congested and not self.app_limited and this.waited(self.shortest, 2.0, reserve):
            self._rates.clear()  # the path has the rate of this round
        rate = this.answered / (now - this.began)
        if rate > before or not self.app_limited:
            self._rates.append(rate)
        self.rate = max(self._rates, default=0.0)
        if self.app_limited:
            return  # it did not fill the path
        self.cost = this.size / this.answered
        if self.starting:
            self._flat = 0 if rate > (1.0 + STEP) * before else self._flat + 1
        if paused:
            return
        if lost_too_much:
            self.tolerance *= 1.0 - STEP
        else:
            self.tolerance = min(1.0, self.tolerance + TOLERANCE_RISE)
        if queued or this.lost >= max(2 * FEW, MOST_LOSS * total):
            self._flat = FLAT_ROUNDS

    def _learn_loss(self, this: Round, *, losses: bool) -> None:
        """Average the share of losses. losses: those of this round are the link's."""
        total = this.answered + this.lost
        loss, memory = this.lost / total, min(SMOOTHING, total / LOSS_MEMORY)
        if loss < self.loss or (losses and self.starting):
            self.loss += (loss - self.loss) * memory
        elif losses:
            self.loss += (loss - self.loss) * memory * LOSS_RISE

    def _learn_trips(self, this: Round, now: float) -> None:
        """Learn from the round trips of a round, and search the shortest one from time to time."""
        if this.least == inf:
            return
        if self.probing:
            self.probing -= 1
        elif now >= self._shortest_seen + SEARCH and not self.starting:
            self.probing = 3
        if self.probing == 1:
            self.shortest, self._shortest_seen = this.least, now
        spread = this.total / this.timed - self.shortest
        self.spread += (min(spread, LITTLE) - self.spread) * SMOOTHING
