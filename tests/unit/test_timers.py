"""The wait for an answer, and the loss of a request before its timer runs out."""

from __future__ import annotations

from itertools import pairwise

import pytest

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import READ_POLICY, RETRY_POLICIES, Request, RetryPolicy
from mavftpfs.protocol.timers import EIGHTH, FADE, LONGEST_BACK_OFF, MOST_LATE, RttEstimator, Timers

LIST, OPEN = RETRY_POLICIES[Opcode.LIST_DIRECTORY], RETRY_POLICIES[Opcode.OPEN_FILE_RO]


def request(policy: RetryPolicy, sent_at: float = 100.0) -> Request:
    request = Request(Simple(Opcode.NONE), Opcode.NONE, policy, 0, 0, 0)
    request.sent_at = sent_at
    return request


def learned(policy: RetryPolicy, rtt: float) -> Timers:
    timers = Timers()
    timers.sample(request(policy), 100.0 + rtt)
    return timers


def waits(timers: Timers, policy: RetryPolicy, count: int) -> list[float]:
    """Return how long each transmission waits of a request that nothing answers."""
    times = [0.0]
    for _ in range(count):
        times.append(times[-1] + timers.wait(policy, times[-1]))
    return [after - before for before, after in pairwise(times)]


def test_nor_are_listings_piled_up_where_nothing_is_known() -> None:
    assert waits(Timers(), LIST, 5) == [0.5, 0.5, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("rtt", "wait"), [(0.03, 0.1), (0.1, 0.3), (0.3, 0.9), (0.6, 1.8)])
def test_an_open_waits_as_long_as_listings_took_and_not_a_second(rtt: float, wait: float) -> None:
    timers = learned(LIST, rtt)
    assert timers.timeout(OPEN) == pytest.approx(wait)
    assert timers.timeout(READ_POLICY) == pytest.approx(3 * rtt)


def test_chunks_and_single_requests_have_round_trips_of_their_own() -> None:
    timers = learned(OPEN, 0.5)
    timers.sample(request(READ_POLICY), 100.03)
    assert timers.timeout(OPEN) == pytest.approx(1.5)
    assert timers.timeout(READ_POLICY) == pytest.approx(0.09)


@pytest.mark.holds("rule 14.38")
def test_variation_widens() -> None:
    timer = RttEstimator()
    for index in range(100):
        timer.sample(0.1 if index % 2 else 0.3)
    assert timer.rto > 0.5


@pytest.mark.parametrize("policy", [READ_POLICY, OPEN, LIST])
def test_waits_grow_with_the_time_without_an_answer_up_to_a_cap(policy: RetryPolicy) -> None:
    grown = waits(learned(policy, 0.1), policy, 40)
    assert grown[:2] == pytest.approx([0.3, 0.3])
    assert grown == sorted(grown)
    assert grown[-1] == LONGEST_BACK_OFF


def test_what_went_and_came_together_is_one_sample() -> None:
    one, three = learned(READ_POLICY, 0.2), learned(READ_POLICY, 0.2)
    for _ in range(2):
        three.sample(request(READ_POLICY), 100.2)
    assert three.bulk.rto == one.bulk.rto
    three.sample(request(READ_POLICY), 100.3)
    assert three.bulk.rto != one.bulk.rto


# --- lost, because a later request was answered


@pytest.mark.holds("fault duplicate")
def test_what_comes_late_and_not_at_all_widens_the_patience_which_fades() -> None:
    timers = learned(READ_POLICY, 0.1)
    assert timers.passed_wait(0.1, 100.0) == pytest.approx(0.1125)
    timers.reordering.on_late(100.0)
    assert timers.passed_wait(0.1, 100.0) == pytest.approx(0.125)
    for _ in range(20):
        timers.reordering.on_late(100.0)
    assert timers.passed_wait(0.1, 100.0) == pytest.approx(0.1 * (1.0 + MOST_LATE))
    assert timers.passed_wait(0.1, 100.0 + 2 * FADE) == pytest.approx(0.1 * (1.0 + MOST_LATE - 2 * EIGHTH))
    assert timers.passed_wait(0.1, 200.0) == pytest.approx(0.1125)


# --- work of the server: checksums, cuts; and what is done at once

CRC = Opcode.CALC_FILE_CRC32


def work(server_time: float, opcode: Opcode = CRC) -> RetryPolicy:
    (one,) = Simple(opcode, b"/f", server_time=server_time).next_requests(1, 0.0)
    return one.policy


@pytest.mark.holds("rule 14.38")
def test_a_server_at_work_gets_the_slowest_one_s_time() -> None:
    timers = learned(OPEN, 0.012)
    assert waits(timers, work(10.0), 6)[-1] > 10.0
    assert timers.wait(work(10.0, Opcode.TRUNCATE_FILE), 0.0) > 10.0


def test_but_a_checksum_that_most_would_have_is_asked_for_before() -> None:
    """The server does no work again: it replays its answer to the same seq."""
    timers = learned(OPEN, 0.012)
    assert waits(timers, work(6.0), 3) == pytest.approx([0.9, 1.35, 3.375])
    assert timers.wait(work(0.0), 0.0) == pytest.approx(0.3)


def test_long_work_does_not_make_small_files_wait() -> None:
    timers = learned(OPEN, 0.012)
    timers.sample(request(work(100.0)), 160.0)
    assert timers.wait(work(0.06), 0.0) < 0.5
