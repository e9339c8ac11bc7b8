"""The window: the number of requests in flight, and their spacing. Layer: protocol; pure.

Theory. A window of W answered requests per round trip is a rate. Beyond what the path carries, more requests
only wait in a queue, and delay all others. So the window aims at what fills the path: its rate (the best
recent rate of answers) times its shortest round trip (of those seen lately), and a little more. Every few
rounds it asks for a quarter more, to find out when the path improves. Requests go out evenly, at hardly more
than that rate, so that a short queue takes them.

Radios lose frames. So loss alone does not narrow the window: it changes neither rate nor round trip. As many
more requests make up for it, but not in every round: in the others, losses cease that come from sending too
much. Loss while a queue stands (even the quickest answer of a round took long) is congestion, and narrows
the window. When nothing at all is heard for a retransmission timeout, two requests probe until an answer
comes. At first the window grows by one with every answer, which doubles it each round, until the rate stops
growing, a queue stands, or much is lost.

A serial port has a receive buffer of unknown size in front of a slow server. Bytes that overflow it are lost
silently. So at a serial port the window is 16 at most, and two requests go out at once, not three.

One token bucket in bytes holds back what goes out: its rate is the pace, at most the user's `bwlimit=`. A
request is charged with its own bytes and those of the reply that it expects.

ArduPilot queues five requests for all clients, and drops the rest silently, but it empties that queue every
few milliseconds (servers.md 3, 15). So reads may fill the path there, too, because they go out evenly, also
at the start. Writes stay within the queue, because their losses would leave holes for a while, and so does
everything beside another client, which sends as it likes.

A *round* is the time until a request that was sent after the round's start is answered. Beside this rule
stand `pauses`, for cards that pause."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf, sqrt

from mavftpfs.protocol.bucket import Bucket
from mavftpfs.protocol.pauses import KNOWN, Pauses
from mavftpfs.protocol.payload import MAX_DATA

# The table of constants: all that decide the window. Requests, unless a unit is given.

FIRST = 8
"""The window at first: as much as two packets of an ordinary TCP connection."""

LEAST = 4
"""The narrowest window: so few are no load, and with fewer a loss is noticed late."""

MOST, MOST_SERIAL = 2048, 16
"""The widest window: 1 MB/s over 500 ms. The second is for serial ports, whose receive buffers take fewer."""

PROBE, SILENT = 2, 3
"""The window while nothing is heard; so many transmissions without any answer are a silence."""

SLACK = 2
"""The window is wider than the path by so many, which keeps the slowest part busy between two answers."""

DEPTH, DEPTH_SERIAL = 3, 2
"""Requests that may go out at once (the second at a serial port), or as many as the path carries in TICK."""

ROUNDS = 10
"""The path's rate is the best one of so many rounds: enough to outlast a bad round, few enough to notice a
changed link. Each round has at least so many answers: the best of shorter rounds would be the luckiest
one."""

FLAT_ROUNDS = 3
"""The start ends after so many rounds in which the rate did not grow: a wider window takes two rounds to
show."""

CYCLE, STEP = 5, 0.25
"""One round in CYCLE, and each one after the rate grew, asks for a quarter (STEP) more than the path carries.
The round after the one in CYCLE makes up for no losses, so that losses of a queue that overflows cease. The
start goes on while the rate grows by a quarter."""

START = 4.0
"""At the start the window grows by one with each answer, to at most four times what fills the path as far as
it is known."""

START_PACE = 3.0
"""At the start requests go out at so many times the known rate to a server that queues few, because more at
once would overflow its queue."""

TICK = 0.005
"""Seconds: a shorter delay is no queue, and no round is shorter. Timers and batches on both ends are not more
precise."""

LITTLE = 0.05
"""Seconds by which an answer may be late before it counts as one that waited in a queue. The window counts by
the usual round trip, but at most by so much more than the shortest one, and at most by twice that. Where
answers come in bunches (Wi-Fi, a modem that gathers frames), the shortest one would leave it too narrow."""

LEAST_TRIP = 0.0005
"""Seconds: no round trip counts for less. Both ends of a fast path work in batches. The requests of so long a
time keep them busy; more would only wait, and cost them time."""

QUEUE_SHARE = 0.15
"""A queue stands if the quickest answer of a round took longer than the shortest round trip: by 15 % of that
(LITTLE at most), plus TICK, plus twice the jitter of the round, which is no queue."""

QUEUE = 0.1
"""Seconds of answers that wait in a link's queue on purpose where a server pauses: the link sends them
meanwhile."""

SMOOTHING = 0.2
"""The share that one round counts for in an average, at most."""

LOSS_MEMORY = 100
"""Requests over which the share of losses is averaged, at least."""

LOSS_RISE, MOST_LOSS = 0.1, 0.34
"""The share of losses that a wider window and a higher pace make up for rises more slowly than it falls, by
LOSS_RISE: losses of a link stay, those of an overflowing queue go. The share is at most MOST_LOSS: 19 % each
way. A round of the start that loses more ends the start."""

UNUSUAL = 3.0
"""A round lost more than usual if its loss is so many standard deviations above the usual one."""

BOLDER = 0.06
"""Only a share is used of what the window has beyond the path, and of the reserve for pauses. Each round adds
so much to the share. A round that lost more than usual takes a STEP of it away: a short queue overflowed."""

OVERHEAD, CHUNK_COST = 58, 58 + MAX_DATA
"""Bytes that a request and its answer take on the link besides the data that one of them carries."""


@dataclass(slots=True)
class Round:
    """The answers and losses since a round began.

    Attributes:
        began: when. end: the order of the first request that was sent after that.
        answered, lost: how many requests were. size: bytes of the answered ones and their answers.
        app_limited: there was room and nothing to send, so the rate of answers says little.
        least: the shortest round trip, in seconds. total: the sum of all. timed: how many there were.
    """

    began: float = 0.0
    end: int = -1
    answered: int = 0
    lost: int = 0
    size: int = 0
    app_limited: bool = False
    least: float = inf
    total: float = 0.0
    timed: int = 0

    def waited(self, shortest: float, times: float = 1.0, reserve: float = 0.0) -> bool:
        """Return whether even the quickest answer waited in a queue: `times` as long as what counts as a
        little. reserve: seconds that it waited for another reason."""
        if self.least == inf:
            return False
        little = min(QUEUE_SHARE * shortest, LITTLE) + TICK
        jitter = self.total / self.timed - self.least
        return self.least > shortest + times * little + 2.0 * jitter + reserve


class Flow:
    """The in-flight window.

    Args:
        serial: the way begins with a serial port.
        limit: the most requests that may ever be in flight, None for the default.
        bwlimit: bytes per second that requests and answers may take together, about.

    Attributes:
        window: requests that may be in flight, as far as the path decides.
        cap: how many may be in flight where the server's queue decides: of writes, and beside another client.
        loss: the share of requests that the link loses, 0..1: what overflows a queue, or the buffer of a
            server that pauses, does not count.
        sole_client: no other FTP client was heard lately.
        limited: the last `room` was less because of `bwlimit=`.
        sent_at: when requests went out last.
    """

    def __init__(
        self, *, serial: bool = False, limit: int | None = None, bwlimit: float | None = None
    ) -> None:
        self._bwlimit = inf if bwlimit is None else bwlimit
        self.sole_client = self.limited = False
        self.loss = 0.0
        self._limit = max(1, limit or (MOST_SERIAL if serial else MOST))
        self.cap = self._limit
        self.window = min(FIRST, self.cap)
        self._bucket = Bucket((DEPTH_SERIAL if serial else DEPTH) * CHUNK_COST, TICK)
        self._bucket.rate = self._bwlimit
        self._cost = float(CHUNK_COST)  # bytes that a usual request and its answer take on the link
        self._hurried, self._ready_at, self.sent_at = False, inf, -inf
        self._lacks = -inf  # bytes that the bucket has to hold before one more request goes out
        self._starting, self._flat = True, 0
        self._before_silence = 0
        # What is known of the path.
        self._rates: deque[float] = deque(maxlen=ROUNDS)
        self._rate = 0.0
        self._shortest, self._shortest_seen = inf, 0.0
        self._probing = 0  # rounds that are left of the search for the shortest round trip
        self._spread = 0.0
        self._per_answer = 1.0  # so many requests are to bring one answer
        self._bold = 1.0
        self._pauses = Pauses()
        self._rounds, self._round = 0, Round()

    @property
    def app_limited(self) -> bool:
        """Whether there was room and nothing to send, in this round."""
        return self._round.app_limited

    @property
    def pause(self) -> float:
        """Seconds without an answer that prove no loss, because the server pauses."""
        return self._pauses.length

    def set_queue_limit(self, limit: int | None) -> None:
        """Note how many requests the server queues, None if that is not known to be limited."""
        self.cap = self._limit if limit is None else max(1, min(limit, self._limit))
        if self._starting:
            self.window = min(self.window, self.cap)

    @property
    def _queues_few(self) -> bool:
        return self.cap < self._limit

    # --- what may go out

    def begin(self) -> None:
        """Begin to look at all operations: `room` is called for each that has something to send."""
        self._hurried = False
        self._ready_at = inf

    def room(self, in_flight: int, now: float, *, paced: bool, urgent: bool = False) -> int:
        """Return how many requests may go out now. paced: also more than the server queues, evenly spread."""
        self._lacks = -inf
        self.limited = False
        capped = self._queues_few and not (paced and self.sole_client)
        window = self.cap if capped and not self._before_silence else self.window
        room = window - in_flight
        if capped and self.sole_client and not self._hurried:
            room += 1  # one more fits a short queue that no other client fills (servers.md 3)
        if urgent:
            self._hurried = True
        elif self._hurried:  # an urgent answer should not queue behind the slack
            room -= min(SLACK + 1, window // 2)
        elif self.pause and not capped:
            room += self._beyond(now, self._reserve() if paced else 0.0)
        if urgent and self._queues_few and in_flight >= self.cap and self._rate > 0.0:
            # The queue, which is full of what was sent last, would drop it. Nothing else goes out before.
            due = self.sent_at + self.cap / self._rate
            if now < due:
                self._ready_at = due
                return 0
        if room > 0 and (not capped or self._bwlimit < inf):
            room = self._held_back(room, now, urgent)
        return room

    def _beyond(self, now: float, reserve: float) -> int:
        """Return for how many requests there is room beyond the window because a server pauses."""
        if self._pauses.grows(now, self._shortest):
            self._ready_at = min(self._ready_at, now + FIRST / self._rate)
        return int(self._pauses.beyond(now, self._shortest, reserve) * self._rate)

    def _held_back(self, room: int, now: float, urgent: bool) -> int:
        """Return for how many of so many requests there are tokens. What is urgent may overdraw: a little of
        it is no load."""
        cost, overdraft = (CHUNK_COST, DEPTH * CHUNK_COST) if urgent else (self._cost, 0)
        level = self._bucket.level(now) + overdraft
        if level >= room * cost:
            return room
        room = max(0, int(level / cost))
        self._lacks = cost - overdraft
        if not room:
            self._ready_at = min(self._ready_at, self._bucket.holds_at(self._lacks))
        self.limited = self._bucket.rate == self._bwlimit
        self._round.app_limited |= self.limited
        return room

    def _reserve(self) -> float:
        """Return for how many seconds answers should wait in the link's queue."""
        return 0.0 if self._probing else self._bold * QUEUE

    def next_room_at(self) -> float:
        """Return when there will be room without an answer; inf if that does not depend on time."""
        return self._ready_at

    # --- what happens

    def on_sent(self, count: int, size: int, now: float) -> None:
        """Note that so many requests, at least one, go out. There was room for them. size: bytes of data that
        they and their answers carry, at most."""
        self._bucket.charge(count * OVERHEAD + size)
        self.sent_at = now
        if self._bucket.level(now) < self._lacks:  # otherwise there was room for more, and nothing to send
            self._ready_at = min(self._ready_at, self._bucket.holds_at(self._lacks))

    def on_app_limited(self) -> None:
        """Note that there was room in the window and nothing to send: this round's rate says little."""
        self._round.app_limited = True
        self._pauses.on_app_limited()

    def on_replies(
        self,
        now: float,
        rtt: float | None,
        count: int,
        newest: int,
        next_order: int,
        size: int = MAX_DATA,
    ) -> None:
        """Note that `count` requests, which went out together, were answered together.

        rtt: None if it is not known which of their transmissions were. newest: the order of the last of
        those. next_order: the order that the next transmission will get. size: bytes of data that each of
        them, or its answer, carries.
        """
        this = self._round
        this.answered += count
        this.size += count * (OVERHEAD + size)
        self._pauses.on_answers(now, rtt, self._shortest, self._rate)
        if rtt is not None:
            this.least = min(this.least, rtt)
            if rtt <= self._shortest:
                self._shortest, self._shortest_seen = rtt, now
            this.total += rtt * count
            this.timed += count
        if self._before_silence:
            self.window, self._before_silence = min(self._limit, self._before_silence), 0
        elif self._starting and not this.app_limited:
            most = max(2 * FIRST, START * self._to_fill())
            self.window = max(self.window, min(self._limit, self.window + count, int(most)))
        over = newest >= this.end and (this.end < 0 or now >= this.began + TICK)
        enough = this.answered >= ROUNDS or self._starting or this.app_limited
        # At the start a queue grows fast: a few answers that waited in one are enough.
        if not (over and enough) and not (
            self._starting and this.timed >= FIRST and this.waited(self._shortest)
        ):
            return
        self._rounds += 1
        if this.end >= 0 and now > this.began:
            self._learn(this, now)
        pace = inf
        if not self._starting and self._rate > 0.0 and self._shortest >= LEAST_TRIP:
            pace = self._rate * (1.0 if self._rounds % CYCLE == 1 else (1.0 + STEP) * self._per_answer)
        elif self._starting and self._rate > 0.0 and self._queues_few:
            pace = START_PACE * self._rate
        self._bucket.rate = min(self._bwlimit, pace * self._cost)
        self._round = Round(now, next_order)

    def on_loss(self) -> None:
        """Note that a request was declared lost."""
        self._round.lost += 1

    def on_spurious(self) -> None:
        """Note that a request was answered after all that had been declared lost."""
        self._round.lost = max(0, self._round.lost - 1)

    def on_silence(self, unheard: int = SILENT) -> None:
        """Note that nothing at all was heard for a retransmission timeout, after so many transmissions."""
        if unheard < SILENT:
            return
        if not self._before_silence:
            self._before_silence = max(1, self.window // 2)
            self.window = min(PROBE, self.window)

    # --- rounds

    def _learn(self, this: Round, now: float) -> None:
        """Learn from a round that is over."""
        total = this.answered + this.lost
        # Requests that arrive while a server pauses overflow its buffer, and answers wait. That says nothing
        # of the link.
        paused = self.pause > 0.0 and self._pauses.touch(this.began, self._shortest)
        waits = self._reserve() if self.pause else 0.0
        congested = this.lost > 0 and not paused and this.waited(self._shortest, 1.0, waits)
        usual = self.loss * total
        lost_too_much = congested or (not paused and this.lost > usual + UNUSUAL * sqrt(usual + 1.0))
        self._learn_loss(this, losses=not (paused or this.waited(self._shortest)))
        self._learn_trips(this, now)
        if congested and not this.app_limited and this.waited(self._shortest, 2.0, waits):
            self._rates.clear()  # the path has the rate of this round
        rate, before = this.answered / (now - this.began), self._rate
        if rate > before or not this.app_limited:
            self._rates.append(rate)
        self._rate = max(self._rates, default=0.0)
        if this.app_limited:
            return
        self._cost = this.size / this.answered
        if not paused:
            self._bold = self._bold * (1.0 - STEP) if lost_too_much else min(1.0, self._bold + BOLDER)
        if self._starting:
            self._flat = 0 if rate > (1.0 + STEP) * before else self._flat + 1
            overflown = this.lost >= max(2 * FIRST, MOST_LOSS * total) or this.waited(self._shortest)
            self._starting = self._flat < FLAT_ROUNDS and (paused or not overflown)
        if self._starting:
            return
        to_fill = self._to_fill()  # the window is to fill the path, and a little more
        if self._probing > 1:
            window = max(1, int((1.0 - STEP) * to_fill))
        else:
            spread = min(self._rate * self._spread, to_fill)
            step = STEP * (to_fill + spread) if self._rounds % CYCLE == 0 or rate > before else 0.0
            window = max(LEAST, round(to_fill + SLACK + self._bold * (spread + step)))
        self.window = min(self._limit, window)

    def _learn_loss(self, this: Round, *, losses: bool) -> None:
        """Average the share of losses. losses: those of this round are the link's."""
        total = this.answered + this.lost
        loss, memory = this.lost / total, min(SMOOTHING, total / LOSS_MEMORY)
        if loss < self.loss or (losses and self._starting):
            self.loss += (loss - self.loss) * memory
        elif losses:
            self.loss += (loss - self.loss) * memory * LOSS_RISE
        plain = self._rounds % CYCLE == 1
        self._per_answer = 1.0 if plain else 1.0 / (1.0 - min(self.loss, MOST_LOSS))

    def _learn_trips(self, this: Round, now: float) -> None:
        """Learn from the round trips of a round, and look for the shortest one from time to time."""
        if this.least == inf:
            return
        if self._probing:
            self._probing -= 1
        elif now >= self._shortest_seen + KNOWN and not self._starting:
            self._probing = 3
        if self._probing == 1:
            self._shortest, self._shortest_seen = this.least, now
        spread = this.total / this.timed - self._shortest
        self._spread += (min(spread, LITTLE) - self._spread) * SMOOTHING

    def _to_fill(self) -> float:
        """Return how many requests fill the path, as far as is known."""
        if self._shortest == inf:
            return LEAST
        return self._rate * max(self._shortest, LEAST_TRIP) * self._per_answer
