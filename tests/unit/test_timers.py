"""Timers of the families of opcodes: what one learns serves the others until they know better."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import Request, manner_of
from mavftpfs.protocol.timers import INITIAL_RTO, Timers


def answered(timers: Timers, opcode: Opcode, rtt: float) -> None:
    timers.sample(sent(opcode), 100.0 + rtt)


def sent(opcode: Opcode) -> Request:
    request = Request(Simple(opcode), opcode, manner_of(opcode), 0, 0, 0)
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
    assert waits == [0.5, 1.0, 2.0, 4.0, 5.0]


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
