"""Retransmission timers."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.ledger import Ghost
from mavftpfs.protocol.requests import READ_MANNER, Request, manner_of
from mavftpfs.protocol.timers import INITIAL_RTO, LONGEST_BACK_OFF, RttEstimator, Timers


def test_before_the_first_sample() -> None:
    timer = RttEstimator(0.03)
    assert timer.samples == 0
    assert timer.rto == INITIAL_RTO
    assert RttEstimator(10.0).rto == 10.0


def test_first_sample_allows_three_times() -> None:
    timer = RttEstimator(0.03)
    timer.sample(0.1)
    assert timer.samples
    assert timer.rto == pytest.approx(0.3)


def test_steady_round_trips_leave_half_as_slack() -> None:
    timer = RttEstimator(0.03)
    for _ in range(100):
        timer.sample(0.2)
    assert timer.smoothed == pytest.approx(0.2)
    assert timer.rto == pytest.approx(0.3)


@pytest.mark.holds("rule 14.38")
def test_variation_widens() -> None:
    timer = RttEstimator(0.03)
    for index in range(100):
        timer.sample(0.1 if index % 2 else 0.3)
    assert timer.rto > 0.5


def test_floor() -> None:
    timer = RttEstimator(0.03)
    timer.sample(0.0001)
    assert timer.rto == 0.03


def test_back_off_from_the_third_silence_on_up_to_a_cap_and_until_a_sample() -> None:
    timer = RttEstimator(0.03)
    timer.sample(0.1)
    waits = []
    for _ in range(12):
        timer.on_silence()
        waits.append(timer.rto)
    assert waits[:4] == pytest.approx([0.3, 0.3, 0.6, 1.2])
    assert waits[-1] == LONGEST_BACK_OFF
    timer.sample(0.1)
    assert timer.rto < 0.3


def test_a_slow_family_keeps_its_floor_above_the_cap() -> None:
    timer = RttEstimator(10.0)
    for _ in range(9):
        timer.on_silence()
    assert timer.rto == 10.0


def test_what_went_and_came_together_is_one_sample() -> None:
    timers = Timers()
    requests = [Request(Ghost(), 5, READ_MANNER, 0, offset, 1) for offset in range(3)]
    for request in requests:
        request.sent_at = 1.0
        assert timers.sample(request, 1.2) == pytest.approx(0.2)
    assert timers.of["data"].samples == 1
    assert timers.sample(requests[0], 1.3) == pytest.approx(0.3)
    assert timers.of["data"].samples == 2
    listing = Request(Ghost(), 3, manner_of(3), 0, 0, 1)
    listing.sent_at = 1.0
    timers.sample(listing, 1.3)
    assert timers.of["list"].samples == 1
