"""How many requests may be in flight. Layer: protocol; pure.

Theory. A window of W answered requests per round trip is a rate; beyond what the path carries, more of them
only wait in a queue, ours and everybody else's. So the window aims at what the path holds: bandwidth (the
best recent rate of answers) times base round trip (the least one seen), up to a quarter more to find out when
the path improves, and a few requests of slack: so few that a short queue in front of the slowest part holds
them. Bandwidth is at most what `trains` saw, or losses in such a queue would excuse the window that causes
them. Random loss does not shrink it, because loss alone changes neither product; loss *with* a standing queue
(the round's least round trip well over the base) is congestion, and brakes by a third at most once a round. A
silent time-out round falls back to a probe of two. Start: double each round while the rate grows by a
quarter; once the path's own pace is known, go to what it holds, at that pace. A round is the time until a
request sent after the round's start is answered.
"""

from __future__ import annotations

from collections import deque
from math import inf, sqrt

from mavftpfs.protocol.basertt import BaseRtt
from mavftpfs.protocol.brake import Brake
from mavftpfs.protocol.budget import Budget
from mavftpfs.protocol.easing import Easing
from mavftpfs.protocol.flights import Flights
from mavftpfs.protocol.overflow import Overflow
from mavftpfs.protocol.pacing import Pacer
from mavftpfs.protocol.stalls import Stalls
from mavftpfs.protocol.survival import Survival
from mavftpfs.protocol.trains import FASTEST_LINK, GAIN, Trains
from mavftpfs.protocol.widening import Widening

FIRST = 8
INITIAL = 4
DEFAULT_CAP = 2048
SERIAL_CAP = 16

_GAIN = 1.25
_SLACK = 3
_CURIOSITY = 6
_LEAP = 4
_FAST_PATH_SECONDS = 0.010
_FAST_PATH_WINDOW = 192
_MOST_RESERVE = 1024
_REFILL = 2.0
_OFTEN = 5
_MORE_LOSS = 0.15
_QUEUE_SECONDS = 0.005
_FULL = 0.8
_ROUNDS_REMEMBERED = 10
_PLATEAU_ROUNDS = 2
_TELLING_ROUND = 16
_TELLING_SILENCE = 3


class Flow:
    """The in-flight window, in requests. serial: small receive buffers are likely, so start at 1 and
    find out by `survival` what they hold. limit: the most that may ever be in flight, None for the
    default; cap: that may be now. budget: the user's. alone: no other client was heard lately. stalls: the
    server's pauses."""

    __slots__ = (
        "_app_limited",
        "_base",
        "_base_rtt",
        "_best_rate",
        "_brake",
        "_collapsed",
        "_easing",
        "_flights",
        "_goal",
        "_heard_at",
        "_hurried",
        "_limit",
        "_losses",
        "_overflow",
        "_pacer",
        "_plateau",
        "_rates",
        "_replies",
        "_round_end",
        "_round_least",
        "_round_start",
        "_starting",
        "_survival",
        "_trains",
        "_widening",
        "alone",
        "budget",
        "cap",
        "loss",
        "stalls",
        "window",
    )

    def __init__(
        self, *, serial: bool = False, limit: int | None = None, budget: Budget | None = None
    ) -> None:
        self.budget = budget
        self.alone = self._hurried = self._app_limited = False
        self._limit = max(1, limit or (SERIAL_CAP if serial else DEFAULT_CAP))
        self._survival = Survival(self._limit) if serial else None
        self.cap = self._limit
        self.window = min(1 if serial else FIRST, self.cap)
        self.loss = 0.0
        self._starting = not serial
        self._rates: deque[float] = deque(maxlen=_ROUNDS_REMEMBERED)
        self._best_rate = 0.0
        self._base = BaseRtt()
        self._base_rtt = inf
        self._easing, self._trains, self._widening = Easing(), Trains(), Widening()
        self._pacer: Pacer | None = None
        self.stalls = Stalls()
        self._heard_at = -inf
        self._brake = Brake()
        self._plateau = self._collapsed = 0
        self._round_end = -1
        self._round_start, self._round_least = 0.0, inf
        self._replies = self._losses = self._goal = 0
        self._flights, self._overflow = Flights(), Overflow()

    def set_queue_limit(self, limit: int | None) -> None:
        """Never have more in flight than the server queues; None if it is not known to be limited."""
        self.cap = self._limit if limit is None else max(1, min(limit, self._limit))
        self.window = min(self.window, self.cap)
        self._goal = min(self._goal, self.cap)
        if limit is None or self.cap == self._limit:
            self._pacer = None
        elif self._pacer is None or self._pacer.queue != self.cap:
            self._pacer = Pacer(self.cap, self._limit)

    def begin(self) -> None:
        """It is looked at anew who has something to send: `room` follows for each."""
        self._hurried = False
        self._trains.begin()
        self.stalls.wake = inf
        if self._pacer is not None:
            self._pacer.begin()
        if self.budget is not None:
            self.budget.begin()

    def room(self, in_flight: int, now: float, *, paced: bool, urgent: bool = False) -> int:
        """Return how many requests may go out now. paced: also beyond what the server queues, if evenly."""
        if urgent:
            self._hurried = True
            if in_flight > 0:
                self.stalls.reserve.on_others(now)
        elif self._hurried:  # an answer that somebody waits for should not queue behind our slack
            in_flight += min(_SLACK, self.window // 2)
        room = self._room(in_flight, now, paced, urgent)
        if self.budget is None or room <= 0:
            return room
        allowed = self.budget.room(now, urgent=urgent)
        self._app_limited |= allowed < room
        return min(allowed, room)

    @property
    def held(self) -> bool:
        """Whether somebody was only held back by the user's budget, so that waiting is no silence."""
        return self.budget is not None and self.budget.held

    @property
    def most_beside(self) -> int:
        """How many may be in flight if somebody waits: none more where a server holds but a few of them."""
        return self.cap if self._survival is None and self._pacer is None else 0

    @property
    def patience(self) -> float:
        """Seconds of silence that prove no loss: newer answers will, where more than a few are in flight."""
        return 0.0 if self._survival or self._pacer or self._app_limited else self.stalls.patience

    def _room(self, in_flight: int, now: float, paced: bool, urgent: bool) -> int:
        reserve = self._reserve(now, paced)
        room = self.window - in_flight + reserve
        if self._pacer is None:
            # What a pause took of a reserve must come back before the next one, but drowns a buffer at once.
            gain = _REFILL if room <= reserve else GAIN
            briefly = self.stalls.reserve.beside_others(now)
            return min(room, self._trains.room(now, gain, briefly=briefly)) if room > 0 else room
        room += self.alone and not self._hurried  # one more fits a short queue of our own (servers.md 3)
        self._pacer.blocked = False
        # How evenly others send is not ours to say: beside them the queue is all there is.
        beyond = self._pacer.room_for_urgent if urgent else self._pacer.room
        return beyond(in_flight, now) if paced and room <= 0 and self.alone else room

    def _reserve(self, now: float, paced: bool) -> int:
        """Return how many more bridge the pauses of a server; none where its buffers are small, or while
        somebody waits for an answer that would have to queue behind them."""
        if self._hurried or self._survival or self._pacer or self._best_rate > FASTEST_LINK:
            return 0
        seconds = self.stalls.to_bridge(now, self._best_rate, self._base_rtt, kept=paced)
        return self._bounded(seconds * self._best_rate)

    def _bounded(self, reserve: float) -> int:
        """Never beyond the limit; and on a fast path a pause is ours or a busy computer's, which requests
        cannot bridge: hundreds of them would only overflow the sockets at both ends."""
        most = _MOST_RESERVE if self._best_rate <= FASTEST_LINK else 0
        return int(max(0, min(reserve, most, min(self.cap, self._base.most) - self.window)))

    def next_room_at(self) -> float:
        """Return when there will be room without an answer; inf if that does not depend on time."""
        if self.budget is not None and self.budget.next_room_at() < inf:
            return self.budget.next_room_at()  # before that, nothing goes out in any case
        paced_at = self._trains.next_room_at() if self._pacer is None else self._pacer.next_at()
        return min(paced_at, self.stalls.wake)

    def on_sent(self, count: int, now: float) -> None:
        """So many requests, at least one, go out, which there was room for."""
        if self.budget is not None:
            self.budget.on_sent(count)
        self._trains.on_sent(count)
        if self._pacer is not None:
            self._pacer.on_sent(count, now)

    def on_starved(self) -> None:
        """There was room in the window and nothing to send: this round's rate says little."""
        self._app_limited = True
        self._heard_at = -inf
        self.stalls.interrupt()
        if self._pacer is not None:
            self._pacer.on_starved()

    def on_reply(self, now: float, rtt: float | None, order: int, next_order: int) -> None:
        """A request was answered. order: of its transmission; next_order: what the next one will get."""
        self._count(1, now, rtt)
        if self.window < self._goal:
            # Two new requests for each answer: doubling without a flood, which a known pace prevents.
            self.window = self._goal if self._trains.proven else self.window + 1
        if order < self._easing.until:
            self._easing.count(order, lost=False)
        if self._pacer is not None:
            self._pacer.on_reply(now, rtt, order, next_order)
        if self._collapsed:
            self.window, self._collapsed = min(self.cap, self._collapsed), 0
        if order >= self._round_end:
            self._end_round(now, order, next_order)
        elif self._starting and order >= self._flights.due:
            self._end_flight(now, order)

    def on_replies(self, now: float, rtt: float, orders: list[int], next_order: int) -> None:
        """As `on_reply`, of requests that went out together and were answered together."""
        closely = self._starting or self.window < self._goal or self._collapsed or self._pacer is not None
        closely = closely or min(orders) < self._easing.until
        plain = 0
        for order in orders:
            if closely or order >= self._round_end:
                self._count(plain, now, rtt)
                plain = 0
                self.on_reply(now, rtt, order, next_order)
            else:
                plain += 1
        self._count(plain, now, rtt)

    def _count(self, answers: int, now: float, rtt: float | None) -> None:
        if not answers:
            return
        self._replies += answers
        self._trains.on_replies(answers, now)
        if now != self._heard_at:  # what comes at once has no pauses
            self._heard_at = now
            full = not self._starting or _FULL * self._trains.rate < self._best_rate
            self.stalls.on_reply(now, self._best_rate if full else 0.0, self._base_rtt)
        if rtt is not None and rtt < self._round_least:
            self._round_least = rtt

    def on_loss(self, order: int, sends: int = 1) -> None:
        """The transmission numbered `order` is taken to be lost, the `sends`th of its request."""
        self._losses += 1
        self.stalls.on_loss(self._best_rate)
        if self._survival is not None and sends >= _OFTEN:
            self.window = 1  # it may always come second to a buffer for one: let it go alone
        self._easing.count(order, lost=True)
        if self._pacer is not None:
            self._pacer.on_loss(order)

    def on_spurious(self) -> None:
        """What was taken to be lost was answered after all."""
        self._losses = max(0, self._losses - 1)

    def on_silence(self, unheard: int = _TELLING_SILENCE) -> None:
        """Nothing at all was heard for a retransmission timeout, after so many transmissions: probe with two
        until something is. One or two are a lone request's bad luck."""
        if unheard < _TELLING_SILENCE:
            return
        if not self._collapsed:
            # What a small buffer survived it will survive again: there a silence is a few losses in a row.
            kept = self._survival or self.stalls.usual  # so is a pause of a server that makes them
            self._collapsed = self.window if kept else max(1, self.window // 2)
            self._goal = 0
            self.window = min(2, self.window)
        if self._pacer is not None:
            self._pacer.on_silence()

    def _end_flight(self, now: float, order: int) -> None:
        flights = self._flights
        leap = flights.end(order, now - self._round_start, self._base_rtt)
        if flights.measured:
            self._trains.learn(flights.rate)
            self._goal = int(min(self.cap, leap * self.window, self._filling(flights.rate)))
            self.window = max(self.window, self._goal)

    def _end_round(self, now: float, order: int, next_order: int) -> None:
        if self._round_end >= 0:
            self._learn(now, next_order)
        self._round_end = next_order
        self._flights.begin(order, next_order, self.window)
        self._round_start = now
        self._round_least = inf
        self._replies, self._losses, self._app_limited = 0, 0, False

    def _learn(self, now: float, next_order: int) -> None:
        answered, lost, survival = self._replies, self._losses, self._survival
        overflowed = self._overflow.judge(answered, lost)
        self.loss += (lost / (answered + lost) - self.loss) * 0.2
        waited = self._base.beyond(self._round_least, self.window * (1.0 - self.loss), self._best_rate)
        reserve = self._bounded(min(self.stalls.reserve.seconds, waited) * self._best_rate)
        self._base_rtt = self._base.learn(self._round_least, self.window + reserve)
        took = now - self._round_start
        rate = answered / took if took > 0 else 0.0
        # What the window was doubled for shows two rounds later.
        grown = len(self._rates) < 2 or rate > 1.25 * self._rates[-2]
        if rate > self._best_rate or not self._app_limited:
            self._rates.append(rate)
        self._best_rate = max(self._rates, default=0.0)
        if self._app_limited:
            if survival is not None:
                self.window = min(self.cap, survival.end_idle_round(next_order - self._round_end, lost))
            return
        self.stalls.reserve.on_round(now, waited)
        self._brake.end_round(congested=lost > 0 and self._queued(2.0))
        self._trains.end_round(answered, rate)
        self._widening.end_round(answered, lost, bunched=survival is None and self._bunched())
        if survival is not None:
            disturbed = self.stalls.reserve.others_at > self._round_start - took
            most = self._target() if self._queued(2.0) else inf
            window = survival.end_round(answered, lost, took, now, most=most, disturbed=disturbed)
            self.window = min(self.cap, window)
        elif self._starting and overflowed:
            self._starting, self._goal = False, 0
            self._easing.ceiling = max(INITIAL, self._held(self._best_rate))
            self._approach(self._easing.ceiling)
        elif self._starting and not self._leaves_start(grown):
            self._goal = self._next_goal() if grown and not self._flights.measured else 0
        else:
            self._goal = 0
            loss = self.loss
            if self._excused():
                loss, self._easing.ceiling = 0.0, inf
            self._approach(self._easing.next_window(self._target(), loss, next_order))
            if self._pacer is None:
                self.window = int(self._base.next_window(self.window, reserve))

    def _bunched(self) -> bool:
        if self._trains.rate < inf and (self._starting or self.stalls.usual):
            return False  # less comes than could for another reason
        return self._trains.bunched(self._best_rate / (1.0 - self.loss))

    def _excused(self) -> bool:
        """Whether pauses explain what was lost: it is no more than comes in them, and on a bad link."""
        return self.stalls.usual and self.loss < self.stalls.share + _MORE_LOSS

    def _queued(self, factor: float) -> bool:
        """Whether even the quickest answer of the round took `factor` times the base, and a little; an answer
        queues behind a reserve, too."""
        usual = factor * self._base_rtt + self.stalls.reserve.seconds + _QUEUE_SECONDS
        return usual < self._round_least < inf

    def _leaves_start(self, grown: bool) -> bool:
        few = self._replies + self._losses < _TELLING_ROUND and self.window + 1 < self._held(inf)
        self._plateau = 0 if grown or few else self._plateau + 1
        if self._plateau >= _PLATEAU_ROUNDS or self.window >= self.cap or self._queued(1.25):
            self._starting = False
        return not self._starting

    def _next_goal(self) -> int:
        if not self._trains.proven or self._flights.rate < self._trains.rate / 2:  # it was that of a bunch
            return min(self.cap, self.window * 2)
        return int(min(self.cap, self.window * _LEAP, self._held(inf)))

    def _held(self, rate: float) -> float:
        """Return how many requests fill the path, with some to find out whether it holds more.

        rate: of answers; infinite to go by their pace alone, as while the window may be too small.
        """
        answered = max(0.3, 1.0 - self.loss)
        return self._filling(min(rate / answered, self._trains.rate / sqrt(answered)))

    def _filling(self, rate: float) -> float:
        held = rate * self._base_rtt
        return held + min((_GAIN - 1.0) * held, _CURIOSITY) + _SLACK

    def _target(self) -> float:
        rate, base = self._best_rate, self._base_rtt
        if base == inf or rate == 0.0:
            return INITIAL
        held = self._widening.window(self._held(rate), rate)
        return self._brake.factor * max(held, min(rate * _FAST_PATH_SECONDS, _FAST_PATH_WINDOW))

    def _approach(self, target: float) -> None:
        # So few are no load, and fewer find losses slowly.
        self.window = min(self.cap, max(INITIAL, round(target)))
