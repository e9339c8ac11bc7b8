"""More requests on their way than the server queues. Layer: protocol; pure.

Theory. ArduPilot queues five requests for all clients, and drops the rest silently, but it empties that queue
every few milliseconds (servers.md 3, 15). So only few requests may arrive between two looks at the queue, but
many may be on their way. Requests that are spread evenly in time can fill a long way. Four at a time leave it
empty for most of each round trip.

How often the server looks is not known, so the rate is raised while that helps: each *trial* compares the
answers per second with those of the trial before. If a raise brings next to nothing, the server or the link
is the limit. If more was lost than before, it was the queue, and a fifth of the rate is left to others.
Random loss does not matter, because it takes the same share of both trials.

The window is what is on its way at that rate, by the shortest round trip that was seen, and hardly more: what
a raise leaves in a link's queue must not pass for the way. If the way becomes longer, the link slower or the
loss much larger, all begins again with as few requests as at first. Those make no queue that would falsify
the measurement.
"""

from __future__ import annotations

from math import inf, sqrt

_BOLD, _CAREFUL = 2.0, 1.25
"""The rate is doubled while that helps. Then it is raised by a quarter, to find the limit more exactly."""

_FEW, _MANY = 24, 96
"""Answers that make a trial: few tell what a doubling does, a small raise needs many."""

_WORTH = 0.5
"""The share of a raise that must show in the answers for the raise to be kept."""

_SHARE_TAKEN = 0.8
"""The share of the rate that is used after the queue overflowed."""

_UNUSUAL_LOSS = 0.04
_UNLIKELY = 1.5
"""Standard deviations beyond that: a queue that a raise of a quarter overflows loses a fifth more."""

_ALARMING_LOSS = 0.2
"""A share of losses that is by so much larger than the usual one begins all again."""

_SMOOTHING = 0.3
"""The weight of one trial in the usual share of losses."""

_SHORT = 0.7
"""Share of what should be answered below which the link is slower than it was, or the way longer."""

_HOLD, _SHORT_HOLD = 20.0, 2.0
"""Seconds for which the rate is kept: after a limit was found, and after raises that failed without one."""

_STANDING = 1.3
"""How much longer than the shortest round trip even the quickest of a trial takes where a queue stands."""

_DEPTH = 2.0
"""Requests that may go out at once, if none went out before."""

_SPREAD = 1.1
"""The window is by so much wider than what is on its way at the rate."""


class Pacer:
    """Allows requests beyond a server's queue of `queue`, one by one, up to `limit` in all.

    Attributes:
        rate: requests per second that seem to be survived; None while nothing is known.
        window: the most that may be in flight.
        urgent_at: when an urgent request that waits may go out; -inf if none waits.
    """

    def __init__(self, queue: int, limit: int) -> None:
        self.queue = queue
        self._limit = limit
        self.rate: float | None = None
        self.window = queue
        self.blocked = False
        self._sent_at = -inf
        self.urgent_at = -inf
        self._raise = _BOLD
        self._best = 0.0  # answers per second of the last trial that was worth it
        self._usual_loss = 0.0
        self._seen = 0.0  # how many requests that average stands for
        self._shortest_rtt = inf
        self._least_rtt = inf
        self._hold_until = -inf
        self._failed_once = False
        self._longer = 1.0  # the quickest answer of the last trial, in shortest round trips
        self._tokens = 0.0
        self._tokens_at = 0.0
        self._from = 0  # the trial: of transmissions from here on, timed from the first answer
        self._since: float | None = None
        self._answered = 0
        self._lost = 0
        self._starved = False
        self._limited = False

    # --- sending

    def begin(self) -> None:
        """See Flow.begin."""
        self.blocked, self.urgent_at = False, -inf

    def room(self, in_flight: int, now: float) -> int:
        """Return how many requests may go out now although the server's queue may be full."""
        if self.rate is None or in_flight >= self.window:
            return 0
        self._refill(self.rate, now)
        tokens = max(0, int(self._tokens))
        self.blocked = in_flight + tokens < self.window
        self._limited = self._limited or self.blocked
        return min(tokens, self.window - in_flight)

    def room_for_urgent(self, in_flight: int, now: float) -> int:
        """Return 1 if an urgent request may go out now, else 0. It goes out a little later than what was sent
        last: the queue, which is full of that, would drop it. Until then nothing else goes out."""
        if self.rate is None or in_flight >= self.window:
            return 0
        due = self._sent_at + self.queue / self._best
        self.urgent_at = due if now < due else -inf
        return int(now >= due)

    def next_at(self) -> float:
        """Return when there will be room for one that has to wait for its time; inf if none has to."""
        if self.urgent_at > -inf:
            return self.urgent_at
        if self.rate is None or not self.blocked:
            return inf
        return self._tokens_at + (1.0 - self._tokens) / self.rate + 1e-6

    def on_sent(self, count: int, now: float) -> None:
        """Any requests go out."""
        self._sent_at = now
        if self.rate is not None:
            self._refill(self.rate, now)
            self._tokens = max(-float(self.queue), self._tokens - count)

    def _refill(self, rate: float, now: float) -> None:
        self._tokens = min(_DEPTH, self._tokens + (now - self._tokens_at) * rate)
        self._tokens_at = now

    # --- news

    def on_replies(self, now: float, rtt: float | None, count: int, newest: int, next_order: int) -> None:
        """See Flow.on_replies."""
        if rtt is not None and rtt < self._least_rtt:
            self._least_rtt = rtt
        if newest < self._from:
            return
        if self._starved:
            self._begin(next_order)
        elif self._since is None:
            self._since = now  # the first answers begin the measurement and are none of it
        else:
            self._answered += count
            if self._answered >= self._enough() and now > self._since:
                self._end_trial(now, self._since, next_order)

    def on_loss(self, order: int) -> None:
        """The transmission numbered `order` is taken to be lost."""
        if order >= self._from:
            self._lost += 1

    def on_starved(self) -> None:
        """There was room and nothing to send: a trial says little then, and begins anew."""
        self._starved = True
        self.blocked = False

    def on_silence(self) -> None:
        """Nothing was heard for a time-out."""
        self._begin_again()

    def _begin_again(self) -> None:
        self.rate, self.window, self.blocked = None, self.queue, False
        self._raise = _BOLD
        self._hold_until = -inf
        # The usual loss may have changed, and the few requests that are sent now find no queue of ours.
        self._usual_loss = self._seen = 0.0
        self._shortest_rtt = self._least_rtt = inf
        self._starved = True

    # --- trials

    def _begin(self, order: int) -> None:
        self._from = order
        self._since = None
        self._answered = self._lost = 0
        self._starved = self._limited = False

    def _enough(self) -> int:
        """Return how many answers tell something: few of a doubling, many of a small raise."""
        if self.rate is None:
            return 3 * self.queue
        return _FEW if self._raise == _BOLD else _MANY

    def _end_trial(self, now: float, since: float, next_order: int) -> None:
        answers = self._answered / (now - since)
        loss = self._lost / (self._answered + self._lost)
        self._shortest_rtt = min(self._least_rtt, self._shortest_rtt)
        self._longer = self._least_rtt / self._shortest_rtt if self._shortest_rtt > 0.0 else 1.0
        self._least_rtt = inf
        if self._shortest_rtt < inf:
            self._judge(answers, loss, now)
            self._widen(loss)
        self._begin(next_order)

    def _judge(self, answers: float, loss: float, now: float) -> None:
        if self.rate is None:
            self._tokens, self._tokens_at = 0.0, now
            self._accept(answers, loss)
            self.rate = answers / (1.0 - loss) * self._raise
        elif now < self._hold_until:
            self._watch(answers, loss)
        elif self._hold_until > -inf and self._longer > self.queue + 2:
            self._begin_again()  # so few make no such queue, even at the slowest link: the way is longer
        elif self._hold_until > -inf:
            self._hold_until = -inf  # the last trial of a hold is what the next raise is compared with
            self._accept(answers, loss)
            self.rate *= self._raise
        elif answers >= (1.0 + _WORTH * (self._raise - 1.0)) * self._best:
            self._accept(answers, loss)
            if self._limited:
                self.rate *= self._raise
        elif not self._failed_once:
            self._failed_once = True  # so few answers may mislead: once more
        elif self._raise == _BOLD:
            self.rate *= _CAREFUL / _BOLD
            self._raise, self._failed_once = _CAREFUL, False
        else:
            self._hold_rate(answers, loss, now)

    def _accept(self, answers: float, loss: float) -> None:
        self._best, self._failed_once = answers, False
        self._learn(loss)

    def _learn(self, loss: float) -> None:
        """Average a loss into the usual one."""
        new = _SMOOTHING if self._seen else 1.0
        self._usual_loss += (loss - self._usual_loss) * new
        before = (1.0 - new) ** 2 / self._seen if self._seen else 0.0
        self._seen = 1.0 / (before + new**2 / (self._answered + self._lost))

    def _scatter(self, loss: float) -> float:
        """Return by how much a trial's loss may exceed the usual one by mere chance (one standard
        deviation)."""
        return sqrt(loss * (1.0 - loss) * (1.0 / (self._answered + self._lost) + 1.0 / self._seen))

    def _is_overflow(self, loss: float) -> bool:
        return loss - self._usual_loss > _UNUSUAL_LOSS + _UNLIKELY * self._scatter(loss)

    def _hold_rate(self, answers: float, loss: float, now: float) -> None:
        """Hold the best rate for a while, because the last raise brought nothing."""
        best = max(answers, self._best)
        overflowed = self._is_overflow(loss)
        self.rate = best / (1.0 - self._usual_loss) * (_SHARE_TAKEN if overflowed else 1.0)
        self._failed_once = False
        if overflowed or self._longer > _STANDING:
            self._hold_until = now + _HOLD
        else:  # nothing shows a limit: it may have been chance
            self._hold_until = now + _SHORT_HOLD
            self._raise = _BOLD

    def _watch(self, answers: float, loss: float) -> None:
        """While the rate is held, begin again if too few answers come. Another sender may have come, the
        server or the link may be slower, or the way longer. Only a start with few requests tells which."""
        expected = (self.rate or 0.0) * (1.0 - loss)
        if loss <= self._usual_loss + _ALARMING_LOSS and answers >= _SHORT * expected:
            self._failed_once = False
            self._learn(loss)
        elif not self._failed_once:
            self._failed_once = True
        else:
            self._begin_again()

    def _widen(self, loss: float) -> None:
        if self.rate is not None:
            on_way = _SPREAD * self.rate * self._shortest_rtt / max(0.3, 1.0 - loss)
            self.window = min(self._limit, max(self.queue, round(on_way) + 2))
