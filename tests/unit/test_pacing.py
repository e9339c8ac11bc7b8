"""More requests on their way than a server queues, where it is known when the server looks."""

from __future__ import annotations

import random
from math import inf

import pytest

from mavftpfs.protocol.pacing import Pacer

pytestmark = pytest.mark.holds("fault overflow")

QUEUE = 4


class Server:
    """A queue of five that is emptied every `look` seconds at the end of a way of `base` seconds there and
    back, with random loss; the client asks whenever it may."""

    def __init__(self, *, base: float, look: float = 0.010, loss: float = 0.0, slowest: float = inf) -> None:
        self.pacer = Pacer(QUEUE, 2048)
        self.rng = random.Random(3)
        self.base, self.look, self.loss, self.slowest = base, look, loss, slowest
        self.now = 0.0
        self.order = 0
        self.in_flight = 0
        self.busiest = 0
        self.answered = 0
        self._events: list[tuple[float, int, float | None]] = []  # when, order, round trip or None: lost
        self._free_at = 0.0
        self._look_at, self._queued = 0.0, 0

    def run(self, seconds: float) -> float:
        """Return answers per second."""
        end, before, began = self.now + seconds, self.answered, self.now
        while self.now < end:
            self._ask()
            times = [event[0] for event in self._events[:1]] + [self.pacer.next_at()]
            self.now = max(self.now, min(times))
            while self._events and self._events[0][0] <= self.now:
                self._tell(*self._events.pop(0)[1:])
        return (self.answered - before) / (self.now - began)

    def _ask(self) -> None:
        self.pacer.blocked = False
        while self.in_flight < QUEUE or self.pacer.room(self.in_flight, self.now) > 0:
            self.pacer.on_sent(1, self.now)
            self.in_flight += 1
            self.busiest = max(self.busiest, self.in_flight)
            self._travel(self.order)
            self.order += 1
            self._events.sort()

    def _travel(self, order: int) -> None:
        there = self.now + self.base / 2
        if there > self._look_at:  # the first into an empty queue is answered `look` later, with the others
            self._look_at, self._queued = there + self.look, 0
        self._queued += 1
        lost = self._queued > 5 or self.rng.random() < self.loss
        self._free_at = max(self._free_at, self._look_at) + 1 / self.slowest
        back = self._free_at + self.base / 2
        self._events.append((back, order, None if lost else back - self.now))

    def _tell(self, order: int, rtt: float | None) -> None:
        self.in_flight -= 1
        if rtt is None:
            self.pacer.on_loss(order)
        else:
            self.answered += 1
            self.pacer.on_replies(self.now, rtt, 1, order, self.order)


QUEUED = 5 / 0.010
"""Requests per second that the server's queue takes at most."""


def lost(server: Server, seconds: float) -> float:
    """Return which share of what is sent for so long finds the queue full or is lost on its way."""
    before = server.order
    return 1.0 - server.run(seconds) * seconds / (server.order - before)


@pytest.mark.parametrize("base", [0.1, 0.3])
def test_a_link_that_begins_to_lose_much_is_used_on(base: float) -> None:
    """A third is no overflow if as much is lost of fewer: 33 a second were left of 400."""
    server = Server(base=base)
    server.run(30.0)
    server.loss = 0.3
    server.run(20.0)
    assert server.run(20.0) > 0.4 * QUEUED


@pytest.mark.parametrize(("base", "seed"), [(0.1, 1), (0.3, 2)])
def test_an_overflow_does_not_become_usual_where_much_is_lost(base: float, seed: int) -> None:
    """As many were answered at any rate beyond what the queue takes, so chance led further and further."""
    server = Server(base=base, loss=0.3)
    server.rng = random.Random(seed)
    server.run(120.0)
    assert lost(server, 60.0) < 0.45


@pytest.mark.parametrize(("before", "base"), [(0.03, 0.2), (0.1, 0.3)])
def test_a_way_that_becomes_longer_is_filled(before: float, base: float) -> None:
    server = Server(base=before, slowest=376.0)
    server.run(30.0)
    server.base = base
    server.run(10.0)
    assert server.run(20.0) > 0.9 * 376.0


def test_no_queue_stands_before_a_link_that_becomes_slower() -> None:
    server = Server(base=0.1, slowest=376.0)
    server.run(30.0)
    server.slowest = 75.0
    server.run(20.0)
    assert server.in_flight <= 1.4 * 75.0 * 0.112 + QUEUE
    assert server.run(20.0) > 0.95 * 75.0
    server.slowest = 376.0
    server.run(40.0)
    assert server.run(20.0) > 0.9 * 376.0
