"""Timers of the families of opcodes: what one learns serves the others until they know better."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.ledger import Ghost
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import MANNERS, READ_MANNER, Request
from mavftpfs.protocol.timers import INITIAL_RTO, LONGEST_BACK_OFF, RttEstimator, Timers


def answered(timers: Timers, opcode: Opcode, rtt: float) -> None:
    timers.sample(sent(opcode), 100.0 + rtt)


def sent(opcode: Opcode) -> Request:
    request = Request(Simple(opcode), opcode, MANNERS[opcode], 0, 0, 0)
    request.sent_at = 100.0
    request.sends = 1
    return request


def test_nothing_known() -> None:
    assert Timers().wait(sent(Opcode.OPEN_FILE_RO)) == INITIAL_RTO


def test_a_lost_first_listing_does_not_cost_a_second() -> None:
    assert Timers().wait(sent(Opcode.LIST_DIRECTORY_WITH_TIME)) == 0.5


def test_nor_are_listings_piled_up_where_nothing_is_known() -> None:
    request, waits = sent(Opcode.LIST_DIRECTORY), []
    for request.sends in range(1, 6):
        waits.append(Timers().wait(request))
    assert waits == [0.5, 1.0, 2.0, 3.0, 3.0]


def test_a_first_listing_that_takes_longer_is_not_waited_for_less_than_it_takes() -> None:
    timers = Timers()
    answered(timers, Opcode.LIST_DIRECTORY, 0.8)
    assert timers.wait(sent(Opcode.LIST_DIRECTORY)) == pytest.approx(2.4)


@pytest.mark.parametrize(("rtt", "wait"), [(0.03, 0.1), (0.1, 0.3), (0.3, 0.9), (0.6, 1.0)])
def test_an_open_waits_as_long_as_listings_took_and_not_a_second(rtt: float, wait: float) -> None:
    timers = Timers()
    answered(timers, Opcode.LIST_DIRECTORY, rtt)
    assert timers.wait(sent(Opcode.OPEN_FILE_RO)) == pytest.approx(wait)
    assert timers.wait(sent(Opcode.READ_FILE)) == pytest.approx(min(3 * rtt, 1.0))


def test_what_is_slow_by_nature_keeps_its_patience() -> None:
    timers = Timers()
    answered(timers, Opcode.LIST_DIRECTORY, 0.03)
    assert timers.wait(sent(Opcode.CALC_FILE_CRC32)) == 10.0


def test_a_family_with_round_trips_of_its_own_borrows_nothing() -> None:
    timers = Timers()
    answered(timers, Opcode.OPEN_FILE_RO, 0.5)
    answered(timers, Opcode.LIST_DIRECTORY, 0.03)
    assert timers.wait(sent(Opcode.OPEN_FILE_RO)) == pytest.approx(1.5)


def test_first_sample_allows_three_times() -> None:
    timer = RttEstimator(0.03)
    timer.sample(0.1)
    assert timer.samples
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
    listing = Request(Ghost(), 3, MANNERS[3], 0, 0, 1)
    listing.sent_at = 1.0
    timers.sample(listing, 1.3)
    assert timers.of["list"].samples == 1
