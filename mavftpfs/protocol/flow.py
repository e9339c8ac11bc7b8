"""The window of requests in flight, and their pace: how much may go out now. Layer: protocol; pure.

Theory. A window of W answered requests per round trip is a rate. Beyond what the path carries, more requests
only wait in a queue, and delay all others. So the window aims at what fills the path, its rate times its
shortest round trip (the bandwidth-delay product), and a little more. `networkpath.py` knows both. Every few
rounds the window asks for a quarter more, to find out when the path improves. Requests go out evenly, at
hardly more than that rate, so that a short queue takes them.

Radios lose frames. So loss alone does not narrow the window: it changes neither rate nor round trip. As many
more requests make up for it, except in rounds that *drain*, in which losses cease that come from sending too
much (`CYCLE`). Loss while a queue stands is congestion, and narrows the window.

At the start nothing holds back the first eight requests. Then the window grows by one with every answer,
which doubles it each round. In a *silence* (`SILENT`) two requests probe until an answer comes. Then the
window is half of what it was, until the end of a round shows what the path carries.

A serial port has a receive buffer of unknown size in front of a slow server. Bytes that overflow it are lost
silently. So at a serial port the window is 16 at most, and where there is a pace, two requests go out at
once, not three.

One token bucket in bytes holds back what goes out: its rate is the pace, at most the user's `bwlimit=`. A
request is charged with its own bytes and those of the reply that it expects. The pace is set at the end of
each round. There is none at the start (except at an ArduPilot), nor on a path within a computer.

ArduPilot queues five requests for all clients, and drops the rest silently, but it empties that queue every
few milliseconds (servers.md 3, 15). So reads may fill the path there, too, because they go out evenly, even
at the start. Writes stay within the queue (`cap`), because their losses would leave holes for a while, and so
does everything beside another client, which sends as it likes. What stays within the queue needs no pace.

Where a server's card pauses, more goes out than the window (`pauses.py`)."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.bucket import Bucket
from mavftpfs.protocol.networkpath import CHUNK_COST, LEAST_TRIP, OVERHEAD, STEP, TICK, NetworkPath
from mavftpfs.protocol.payload import MAX_DATA

# Requests, unless a unit is given.

FIRST = 8
"""The window at first: as much as two packets of an ordinary TCP connection."""

LEAST = 4
"""The narrowest window that is fitted to a path, except in a search for its shortest round trip: so few are
no load, and with fewer a loss is noticed late."""

MOST, MOST_SERIAL = 2048, 16
"""The widest window: 1 MB/s over 500 ms. The second is for serial ports, whose receive buffers take fewer."""

SILENCE_WINDOW, SILENT = 2, 3
"""The window in a silence. A silence begins when the timers of so many requests run out at one moment, and
nothing was heard since these went out. The timers of paced requests run out one by one, so on most paths the
window stays wide until the session ends the transfer."""

SLACK = 2
"""The window is wider than the path by so many, which keeps the slowest part busy between two answers."""

DEPTH, DEPTH_SERIAL = 3, 2
"""Requests that may go out at once where there is a pace (the second at a serial port), or as many as the
path carries in TICK."""

CYCLE = 5
"""One round in CYCLE, and each one after the rate grew, has a window that is wider by a quarter (STEP). The
round after the one in CYCLE drains: requests go out at the path's rate, while the pace of other rounds is a
quarter higher, and do not make up for losses, so that losses of a queue that overflows cease."""

START = 4.0
"""At the start the window grows by one with each answer, to at most four times what fills the path as far as
it is known."""

START_PACE = 3.0
"""At the start requests go out at so many times the known rate to a server that queues few, because more at
once would overflow its queue."""


class Flow:
    """The in-flight window, and the pace.

    Args:
        serial: the path begins with a serial port.
        limit: the most requests that may ever be in flight, None for the default.
        bwlimit: bytes per second that requests and answers may take together, about.

    Attributes:
        path: what is known of it.
        window: requests that may be in flight, as far as the path decides.
        cap: how many may be in flight where the server's queue decides: of writes, and beside another client.
            At an ArduPilot, four of the five that it queues.
        sole_client: no other FTP client was heard lately.
        sent_at: when requests went out last.
    """

    def __init__(
        self, *, serial: bool = False, limit: int | None = None, bwlimit: float | None = None
    ) -> None:
        self.path = NetworkPath()
        self.sole_client = False
        self.sent_at = -inf
        self._limit = max(1, limit or (MOST_SERIAL if serial else MOST))
        self.cap = self._limit
        self.window = min(FIRST, self.cap)
        self._after_silence = 0  # the window when something is heard again, 0 if there is no silence
        self._bwlimit = inf if bwlimit is None else bwlimit
        self._bucket = Bucket((DEPTH_SERIAL if serial else DEPTH) * CHUNK_COST, TICK)
        self._bucket.rate = self._bwlimit
        # What is known since `begin`.
        self._beside_urgent = False  # something urgent was looked at
        self._ready_at = inf  # when there will be room without an answer
        self._needed = -inf  # bytes that the bucket has to hold for one more request, if it held some back

    def set_queue_limit(self, limit: int | None) -> None:
        """Note how many requests the server queues, None if that is not known to be limited."""
        self.cap = self._limit if limit is None else max(1, min(limit, self._limit))
        if self.path.starting:
            self.window = min(self.window, self.cap)

    @property
    def _queues_few(self) -> bool:
        return self.cap < self._limit

    # --- what may go out

    def begin(self) -> None:
        """Begin to look at all operations: `room` is called for each that has something to send."""
        self._beside_urgent = False
        self._ready_at = inf

    def room(self, in_flight: int, now: float, *, paced: bool, urgent: bool = False) -> int:
        """Return how many requests may go out now.

        paced: they may be more than the server queues, if no other client is heard. All but writes may.
        urgent: all but transfers of bytes. They come first.
        """
        self._needed = -inf
        capped = self._queues_few and not (paced and self.sole_client)
        window = self.cap if capped and not self._after_silence else self.window  # in a silence, narrower
        room = window - in_flight
        if capped and self.sole_client and not self._beside_urgent:
            room += 1  # one more fits a short queue that no other client fills (servers.md 3)
        if urgent:
            self._beside_urgent = True
        elif self._beside_urgent:  # an urgent answer should not queue behind the slack
            room -= min(SLACK + 1, window // 2)
        elif self.path.pauses.length and not capped:
            room += self._beyond(now, self.path.reserve if paced else 0.0)
        if urgent and self._queues_few and in_flight >= self.cap and self.path.rate > 0.0:
            # The queue is full of what was sent last, and would drop an urgent request. Nothing else goes out
            # before this one, because the engine asks urgent operations first.
            due = self.sent_at + self.cap / self.path.rate
            if now < due:
                self._ready_at = due
                return 0
        if room > 0 and (not capped or self._bwlimit < inf):
            room = self._held_back(room, now, urgent)
        return room

    def _beyond(self, now: float, reserve: float) -> int:
        """Return for how many requests there is room beyond the window because a server pauses."""
        path = self.path
        if path.pauses.grows(now, path.shortest):
            self._ready_at = min(self._ready_at, now + FIRST / path.rate)
        return int(path.pauses.beyond(now, path.shortest, reserve) * path.rate)

    def _held_back(self, room: int, now: float, urgent: bool) -> int:
        """Return for how many of so many requests there are tokens. What is urgent may overdraw: a little of
        it is no load."""
        cost, overdraft = (CHUNK_COST, DEPTH * CHUNK_COST) if urgent else (self.path.cost, 0)
        level = self._bucket.level(now) + overdraft
        if level >= room * cost:
            return room
        room = max(0, int(level / cost))
        self._needed = cost - overdraft
        if not room:
            self._ready_at = min(self._ready_at, self._bucket.holds_at(self._needed))
        self.path.app_limited |= self.limited
        return room

    @property
    def limited(self) -> bool:
        """Whether the `room` that was just returned was less because of `bwlimit=`."""
        return self._needed > -inf and self._bucket.rate == self._bwlimit

    def next_room_at(self) -> float:
        """Return when there will be room without an answer; inf if that does not depend on time."""
        return self._ready_at

    # --- what happens

    def on_sent(self, count: int, size: int, now: float) -> None:
        """Note that so many requests, at least one, go out. There was room for them. size: bytes of data that
        they and their answers carry, at most."""
        self._bucket.charge(count * OVERHEAD + size)
        self.sent_at = now
        if self._bucket.level(now) < self._needed:  # otherwise there was room for more, and nothing to send
            self._ready_at = min(self._ready_at, self._bucket.holds_at(self._needed))

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
        path = self.path
        path.on_answers(now, rtt, count, size)
        app_limited, rate = path.app_limited, path.rate
        if self._after_silence:
            self.window, self._after_silence = min(self._limit, self._after_silence), 0
        elif path.starting and not app_limited:
            most = max(2 * FIRST, START * self._to_fill())
            self.window = max(self.window, min(self._limit, self.window + count, int(most)))
        if path.end_round(newest, next_order, now):
            if not (path.starting or app_limited):
                self._fit(grew=path.rate > rate)
            self._bucket.rate = min(self._bwlimit, self._pace() * path.cost)

    def on_silence(self, unheard: int) -> None:
        """Note that the timers of so many requests ran out, and nothing was heard since they went out."""
        if unheard >= SILENT and not self._after_silence:
            self._after_silence = max(1, self.window // 2)
            self.window = min(SILENCE_WINDOW, self.window)

    # --- window and pace of the next round

    def _fit(self, *, grew: bool) -> None:
        """Fit the window to the path. grew: the path's rate did."""
        path, to_fill = self.path, self._to_fill()
        if path.probing > 1:
            window = max(1, int((1.0 - STEP) * to_fill))
        else:
            # Where answers come in bunches (Wi-Fi, a modem that gathers frames), a window for the shortest
            # round trip would be too narrow.
            spread = min(path.rate * path.spread, to_fill)
            step = STEP * (to_fill + spread) if path.rounds % CYCLE == 0 or grew else 0.0
            window = max(LEAST, round(to_fill + SLACK + path.tolerance * (spread + step)))
        self.window = min(self._limit, window)

    def _pace(self) -> float:
        """Return how many requests per second may go out, inf if the window alone decides."""
        path = self.path
        if path.rate == 0.0:
            return inf
        if path.starting:
            return START_PACE * path.rate if self._queues_few else inf
        if path.shortest < LEAST_TRIP:
            return inf
        return path.rate * (1.0 if self._drains else (1.0 + STEP) * path.per_answer)

    def _to_fill(self) -> float:
        """Return how many requests in flight fill the path, as far as is known."""
        path = self.path
        if path.shortest == inf:
            return LEAST
        return path.rate * max(path.shortest, LEAST_TRIP) * (1.0 if self._drains else path.per_answer)

    @property
    def _drains(self) -> bool:
        return self.path.rounds % CYCLE == 1
