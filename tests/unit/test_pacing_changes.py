"""Pacing where the way, the link or what it loses changes, and over minutes."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.pacing import Pacer
from tests.unit.test_pacing import QUEUE, Server

pytestmark = pytest.mark.holds("fault overflow")

QUEUED = 5 / 0.010
"""Requests per second that the server's queue takes at most."""


def lost(server: Server, seconds: float) -> float:
    """Return which share of what is sent for so long finds the queue full or is lost on its way."""
    before = server.order
    return 1.0 - server.run(seconds) * seconds / (server.order - before)


def fall_silent(server: Server, seconds: float) -> None:
    """Have nothing come through for a while."""
    server.loss, usual = 1.0, server.loss
    for _ in range(int(seconds)):
        server.run(1.0)
        server.pacer.on_silence()
    server.loss = usual


@pytest.mark.parametrize("base", [0.03, 0.1, 0.3])
def test_no_queue_of_ours_grows_before_a_slow_link(base: float) -> None:
    """Each raise left one, which was then taken for the way: 0.2 s more after a minute and a half."""
    server = Server(base=base, slowest=376.0)
    server.run(300.0)
    filled = 376.0 * (base + 0.012)
    assert server.in_flight <= 1.4 * filled + QUEUE
    assert server.run(60.0) > 0.95 * 376.0


@pytest.mark.parametrize("base", [0.1, 0.3])
def test_a_link_that_begins_to_lose_much_is_used_on(base: float) -> None:
    """A third is no overflow if as much is lost of fewer: 33 a second were left of 400."""
    server = Server(base=base)
    server.run(30.0)
    server.loss = 0.3
    server.run(20.0)
    assert server.run(20.0) > 0.4 * QUEUED


@pytest.mark.parametrize("base", [0.1, 0.3])
def test_a_silence_teaches_nothing_about_what_is_usually_lost(base: float) -> None:
    """All that was lost in it was taken for usual, and from then on a sixth that found the queue full."""
    server = Server(base=base)
    server.run(30.0)
    fall_silent(server, 8.0)
    server.run(20.0)
    assert lost(server, 60.0) < 0.05


@pytest.mark.parametrize("base", [0.1, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_an_overflow_does_not_become_usual_where_much_is_lost(base: float, seed: int) -> None:
    """As many were answered at any rate beyond what the queue takes, so chance led further and further."""
    server = Server(base=base, loss=0.3)
    server.rng = random.Random(seed)
    server.run(120.0)
    assert lost(server, 60.0) < 0.45


@pytest.mark.parametrize("base", [0.1, 0.3])
def test_no_queue_stays_flooded_once_a_bad_link_is_a_good_one(base: float) -> None:
    server = Server(base=base, loss=0.4)
    server.run(60.0)
    server.loss = 0.0
    server.run(120.0)
    assert lost(server, 60.0) < 0.1


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


def taught(*trials: tuple[int, int]) -> Pacer:
    """Return who took these trials, of so many answered and lost, for usual."""
    pacer = Pacer(QUEUE, 2048)
    for answered, lost in trials:
        pacer._answered, pacer._lost = answered, lost
        pacer._learn(lost / (answered + lost))
    return pacer


def try_once(pacer: Pacer, answered: int, lost: int) -> bool:
    """Have a trial end like this; return whether it tells of a queue that overflowed."""
    pacer._answered, pacer._lost = answered, lost
    return pacer._is_overflow(lost / (answered + lost))


@pytest.mark.parametrize(
    ("usual", "trial", "overflow"),
    [
        ([(96, 0)], (77, 19), True),
        ([(96, 0)] * 10, (93, 3), False),
        ([(12, 0)], (78, 18), False),
        ([(12, 0)] * 2, (80, 16), False),
        ([(12, 2)], (85, 11), False),
        ([(78, 18)] * 10, (66, 30), True),
        ([(78, 18)] * 10, (70, 26), False),
        ([(66, 30)] * 10, (62, 34), False),
    ],
)
def test_chance_is_no_overflow(usual: list[tuple[int, int]], trial: tuple[int, int], overflow: bool) -> None:
    """The fewer were seen the less they tell; what was seen long ago counts less, but it does."""
    assert try_once(taught(*usual), *trial) is overflow


def test_the_first_trial_is_believed_whole_and_the_next_in_part() -> None:
    assert taught((9, 3))._base_loss == 0.25
    assert 0.0 < taught((9, 3), (24, 0))._base_loss < 0.25


def holding(rate: float = 400.0) -> Pacer:
    pacer = taught((96, 0))
    pacer.rate, pacer.window = rate, 50
    return pacer


@pytest.mark.parametrize(("answers", "loss"), [(200.0, 0.0), (240.0, 0.4)])
def test_one_odd_trial_is_chance_and_two_are_none(answers: float, loss: float) -> None:
    pacer = holding()
    pacer._watch(answers, loss)
    assert pacer.rate == 400.0
    pacer._watch(400.0, 0.0)
    pacer._watch(answers, loss)
    assert pacer.rate == 400.0, "there was a good one between them"
    pacer._watch(answers, loss)
    assert pacer.rate is None
    assert pacer.window == QUEUE


def test_a_little_fewer_answers_than_usual_are_borne() -> None:
    pacer = holding()
    for _ in range(20):
        pacer._watch(320.0, 0.0)
    assert pacer.rate == 400.0


def test_who_begins_again_knows_nothing_of_before() -> None:
    pacer = taught((24, 12))
    pacer.on_silence()
    pacer._answered, pacer._lost = 9, 3
    pacer._learn(0.25)
    assert pacer._base_loss == 0.25


def test_where_nothing_overflowed_the_next_raise_is_a_bold_one_and_soon() -> None:
    pacer = holding()
    pacer._raise = 1.25
    pacer._settle(400.0, 0.0, 10.0)
    pacer._judge(400.0, 0.0, 13.0)
    assert pacer.rate == 800.0


def test_a_way_that_became_longer_during_a_raise_is_not_too_short_for_good() -> None:
    """Then the few that the window let through were all that was expected: 6 a second from then on."""
    server = Server(base=0.6)
    server.run(30.0)
    server.pacer._base_rtt, server.pacer._best, server.pacer.rate = 0.02, 6.0, 6.0
    server.run(80.0)
    assert server.run(20.0) > 0.4 * QUEUED
