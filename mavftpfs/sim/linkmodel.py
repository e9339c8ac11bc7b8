"""A bad link, as a pure and seeded model of both directions. Layer: sim; pure.

Each direction has a drop-tail queue before a transmitter with a fixed rate. In half duplex there is one
transmitter. It takes frames from the two queues in turn, much as a time-division radio does. The
model loses, doubles, damages or delays a sent frame with the given probabilities. Otherwise the frame arrives
in order, `delay` plus up to `jitter` after its last byte was sent. A frame is also lost if the link is cut
when its last byte leaves or when it would arrive.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from dataclasses import dataclass
from enum import Enum, IntEnum

_BURST_LENGTH = 8.0


class Direction(IntEnum):
    """The direction of a frame."""

    TO_VEHICLE = 0
    TO_CLIENT = 1


class Duplex(Enum):
    """Whether the directions share the airtime."""

    HALF = "half"
    FULL = "full"


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """The properties of a link, the same in both directions.

    rate: bytes per second, None = no limit and no queue. queue: bytes that may wait for the transmitter.
    delay, jitter: seconds one way. loss, duplicate, reorder, corrupt: probabilities per frame.
    hold: a reordered frame is late by so many seconds and three of its airtimes.
    mtu: bytes of the longest frame that ever arrives, None = any.
    burst_loss: share of frames lost in runs of 8 on average.
    """

    rate: float | None = None
    queue: int = 65_536
    duplex: Duplex = Duplex.FULL
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    mtu: int | None = None
    burst_loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    hold: float = 0.020
    corrupt: float = 0.0


class _Lane:
    """One direction."""

    __slots__ = ("arrivals", "bad", "free_at", "last_arrival", "on_air", "queue", "queued")

    def __init__(self) -> None:
        self.queue: deque[tuple[float, bytes]] = deque()
        self.queued = 0
        self.on_air = 0
        self.free_at = float("-inf")
        self.arrivals: list[tuple[float, int, float, bytes]] = []
        self.last_arrival = float("-inf")
        self.bad = False


class LinkModel:
    """Both directions of one link. `now` must not go back.

    dropped: number of frames that found a queue full.
    """

    def __init__(self, rng: random.Random, settings: LinkSettings | None = None) -> None:
        self.settings = settings if settings is not None else LinkSettings()
        self._rng = rng
        self._lanes = (_Lane(), _Lane())
        self._cuts: list[tuple[float, float]] = []
        self._turn = 0
        self._serial = 0
        self._now = float("-inf")
        self.dropped = 0

    # -- the ends ----------------------------------------------------------------------------

    def push(self, direction: Direction, frame: bytes, now: float) -> bool:
        """Append a frame to the transmitter's queue; return False if the queue is full, which drops it."""
        self._advance(now)
        lane = self._lanes[direction]
        if self.settings.rate is not None and len(frame) > self.room(direction):
            self.dropped += 1
            return False
        lane.queue.append((now, frame))
        lane.queued += len(frame)
        self._advance(now)
        return True

    def pop(self, direction: Direction, now: float) -> list[bytes]:
        """Return the frames that arrived by `now`, in order of arrival."""
        self._advance(now)
        lane = self._lanes[direction]
        frames: list[bytes] = []
        while lane.arrivals and lane.arrivals[0][0] <= now:
            arrival, _, sent, frame = heapq.heappop(lane.arrivals)
            if not (self.is_cut(sent) or self.is_cut(arrival)):
                frames.append(frame)
        return frames

    def next_deadline(self) -> float | None:
        """Return when a frame may arrive next, at times too early and never too late; None if none will."""
        times = [lane.arrivals[0][0] for lane in self._lanes if lane.arrivals]
        for lane in self._lanes:
            if lane.queue:
                times.append(lane.free_at + self._airtime(lane.queue[0][1]) + self.settings.delay)
        return min(times, default=None)

    def room(self, direction: Direction) -> int:
        """Return the bytes that fit the queue at the last push or pop. A frame counts until it is sent."""
        lane = self._lanes[direction]
        on_air = lane.on_air if lane.free_at > self._now else 0
        return max(0, self.settings.queue - lane.queued - on_air)

    # -- cuts --------------------------------------------------------------------------------

    def cut(self, now: float) -> None:
        """Cut the link from `now` on."""
        self._advance(now)
        if not self.is_cut(now):
            self._cuts.append((now, float("inf")))

    def restore(self, now: float) -> None:
        """End a cut."""
        self._advance(now)
        self._cuts = [(start, min(stop, now) if start <= now else stop) for start, stop in self._cuts]

    def is_cut(self, when: float) -> bool:
        """Return whether the link is cut at that time."""
        return any(start <= when < stop for start, stop in self._cuts)

    # -- the middle --------------------------------------------------------------------------

    def _airtime(self, frame: bytes) -> float:
        return len(frame) / self.settings.rate if self.settings.rate else 0.0

    def _advance(self, now: float) -> None:
        """Start every transmission that is due by `now`."""
        self._now = now
        if self.settings.duplex is Duplex.HALF and self.settings.rate is not None:
            while (lane := self._next_in_turn(now)) is not None:
                for other in self._lanes:
                    other.on_air = 0
                self._transmit(lane)
                for other in self._lanes:
                    other.free_at = lane.free_at
            return
        for lane in self._lanes:
            while lane.queue and max(lane.free_at, lane.queue[0][0]) <= now:
                self._transmit(lane)

    def _next_in_turn(self, now: float) -> _Lane | None:
        waiting = [lane for lane in self._lanes if lane.queue]
        if not waiting:
            return None
        start = max(waiting[0].free_at, min(lane.queue[0][0] for lane in waiting))
        if start > now:
            return None
        ready = [i for i, lane in enumerate(self._lanes) if lane.queue and lane.queue[0][0] <= start]
        index = self._turn if self._turn in ready else ready[0]
        self._turn = 1 - index
        return self._lanes[index]

    def _transmit(self, lane: _Lane) -> None:
        pushed_at, frame = lane.queue.popleft()
        lane.queued -= len(frame)
        lane.on_air = len(frame)
        sent = max(lane.free_at, pushed_at) + self._airtime(frame)
        lane.free_at = sent
        if self._is_lost(lane, len(frame)):
            return
        self._schedule(lane, sent, self._maybe_corrupt(frame))
        if self._chance(self.settings.duplicate):
            self._schedule(lane, sent, frame)

    def _schedule(self, lane: _Lane, sent: float, frame: bytes) -> None:
        arrival = sent + self.settings.delay
        if self.settings.jitter:
            arrival += self._rng.random() * self.settings.jitter
        if self._chance(self.settings.reorder):
            arrival += self.settings.hold + 3 * self._airtime(frame)
        else:
            arrival = lane.last_arrival = max(arrival, lane.last_arrival)
        self._serial += 1
        heapq.heappush(lane.arrivals, (arrival, self._serial, sent, frame))

    def _is_lost(self, lane: _Lane, size: int) -> bool:
        share = self.settings.burst_loss
        if share:
            # Two states (Gilbert): in the bad one every frame is lost, and `share` is lost in the long run.
            leave = 1 / _BURST_LENGTH
            enter = min(1.0, leave * share / (1 - share)) if share < 1 else 1.0
            lane.bad = not self._chance(leave) if lane.bad else self._chance(enter)
        too_long = self.settings.mtu is not None and size > self.settings.mtu
        return too_long or (lane.bad and bool(share)) or self._chance(self.settings.loss)

    def _maybe_corrupt(self, frame: bytes) -> bytes:
        if not frame or not self._chance(self.settings.corrupt):
            return frame
        damaged = bytearray(frame)
        for at in self._rng.sample(range(len(damaged)), min(len(damaged), self._rng.randint(1, 3))):
            damaged[at] ^= self._rng.randint(1, 255)
        return bytes(damaged)

    def _chance(self, probability: float) -> bool:
        return probability > 0 and self._rng.random() < probability
