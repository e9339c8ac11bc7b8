"""Timers of the families of opcodes: what one learns serves the others until they know better."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.ledger import Ghost
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import MANNERS, READ_MANNER, Request
from mavftpfs.protocol.timers import LONGEST_BACK_OFF, RttEstimator, Timers


def answered(timers: Timers, opcode: Opcode, rtt: float) -> None:
    timers.sample(sent(opcode), 100.0 + rtt)


def sent(opcode: Opcode) -> Request:
    request = Request(Simple(opcode), opcode, MANNERS[opcode], 0, 0, 0)
    request.sent_at = 100.0
    request.sends = 1
    return request


def test_nor_are_listings_piled_up_where_nothing_is_known() -> None:
    request, waits = sent(Opcode.LIST_DIRECTORY), []
    for request.sends in range(1, 6):
        waits.append(Timers().wait(request))
    assert waits == [0.5, 1.0, 2.0, 3.0, 3.0]


@pytest.mark.parametrize(("rtt", "wait"), [(0.03, 0.1), (0.1, 0.3), (0.3, 0.9), (0.6, 1.0)])
def test_an_open_waits_as_long_as_listings_took_and_not_a_second(rtt: float, wait: float) -> None:
    timers = Timers()
    answered(timers, Opcode.LIST_DIRECTORY, rtt)
    assert timers.wait(sent(Opcode.OPEN_FILE_RO)) == pytest.approx(wait)
    assert timers.wait(sent(Opcode.READ_FILE)) == pytest.approx(min(3 * rtt, 1.0))


def test_a_family_with_round_trips_of_its_own_borrows_nothing() -> None:
    timers = Timers()
    answered(timers, Opcode.OPEN_FILE_RO, 0.5)
    answered(timers, Opcode.LIST_DIRECTORY, 0.03)
    assert timers.wait(sent(Opcode.OPEN_FILE_RO)) == pytest.approx(1.5)


@pytest.mark.holds("rule 14.38")
def test_variation_widens() -> None:
    timer = RttEstimator(0.03)
    for index in range(100):
        timer.sample(0.1 if index % 2 else 0.3)
    assert timer.rto > 0.5


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


# --- work of the server: checksums, cuts; and what is done at once

CRC = Opcode.CALC_FILE_CRC32


def work(server_time: float, *, sends: int = 1, opcode: Opcode = CRC) -> Request:
    (request,) = Simple(opcode, b"/f", server_time=server_time).next_requests(1, 0.0)
    request.sent_at, request.sends = 100.0, sends
    return request


def path(sends: int) -> Request:
    request = Request(Simple(Opcode.OPEN_FILE_RO), Opcode.OPEN_FILE_RO, MANNERS[Opcode.OPEN_FILE_RO], 0, 0, 0)
    request.sent_at, request.sends = 100.0, sends
    return request


def learned(*, rtt: float = 0.012, seen: tuple[float, float] | None = None) -> Timers:
    """Timers that measured round trips; seen: work (the slowest server's time, the time it really took)."""
    timers = Timers()
    for _ in range(20):
        timers.sample(path(1), 100.0 + rtt)
        timers.sample(work(0.06), 100.0 + rtt)
        rtt += 1e-6  # not in one batch
    if seen is not None:
        timers.sample(work(seen[0]), 100.0 + seen[1])
    return timers


@pytest.mark.holds("rule 14.38")
def test_a_server_at_work_gets_the_slowest_one_s_time() -> None:
    timers = learned()
    assert timers.wait(work(10.0, sends=4)) > 10.0
    assert timers.wait(work(100.0, sends=5)) > 100.0
    assert timers.wait(work(10.0, opcode=Opcode.TRUNCATE_FILE)) > 10.0


def test_but_a_checksum_that_most_would_have_is_asked_for_three_times_before() -> None:
    """Nothing of it is done again: the same seq has the answer replayed."""
    timers = learned()
    assert [timers.wait(work(6.0, sends=sends)) for sends in (1, 2, 3)] == pytest.approx([0.9, 0.9, 1.8])
    assert timers.wait(work(0.5)) == pytest.approx(0.4)
    assert timers.wait(work(0.0)) == pytest.approx(0.3)


def test_long_work_does_not_make_small_files_wait() -> None:
    timers = learned(seen=(100.0, 60.0))
    assert timers.wait(work(0.06)) < 0.5


def test_the_round_trip_is_that_of_what_moved_last() -> None:
    """A link may become slow while a program only writes."""
    timers = Timers()
    for opcode, rtt in ((Opcode.READ_FILE, 0.001), (Opcode.WRITE_FILE, 0.1), (Opcode.LIST_DIRECTORY, 9.0)):
        answered(timers, opcode, rtt)
    assert timers.moving.smoothed == pytest.approx(0.1)
    answered(timers, Opcode.READ_FILE, 0.001)
    assert timers.moving.smoothed == pytest.approx(0.001)
