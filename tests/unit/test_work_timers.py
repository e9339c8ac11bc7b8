"""How long a repetition waits for work of the server's (checksums, cuts), and for what is done at once."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import MANNERS, Request
from mavftpfs.protocol.timers import Timers

CRC = Opcode.CALC_FILE_CRC32


def work(server_time: float, *, sends: int = 1, opcode: Opcode = CRC) -> Request:
    (request,) = Simple(opcode, b"/f", server_time=server_time).next_requests(1, 0.0)
    request.sent_at, request.sends = 100.0, sends
    return request


def path(sends: int) -> Request:
    request = Request(Simple(Opcode.OPEN_FILE_RO), Opcode.OPEN_FILE_RO, MANNERS[Opcode.OPEN_FILE_RO], 0, 0, 0)
    request.sent_at, request.sends = 100.0, sends
    return request


def learned(*, rtt: float = 0.012, seen: tuple[float, float] | None = None, opcode: Opcode = CRC) -> Timers:
    """Timers that measured round trips; seen: (the slowest server's time, the time it really took)."""
    timers = Timers()
    for _ in range(20):
        timers.sample(path(1), 100.0 + rtt)
        timers.sample(work(0.06), 100.0 + rtt)
        rtt += 1e-6  # not in one batch
    if seen is not None:
        timers.sample(work(seen[0], opcode=opcode), 100.0 + seen[1])
    return timers


def test_a_small_file_s_checksum_is_asked_for_again_soon() -> None:
    timers = learned()
    assert timers.wait(work(0.06)) == pytest.approx(0.36, abs=0.01)
    assert sum(timers.wait(work(0.06, sends=sends)) for sends in (1, 2, 3)) < 1.5


@pytest.mark.holds("rule 14.38")
def test_a_server_not_seen_at_work_gets_the_slowest_one_s_time() -> None:
    timers = learned()
    assert timers.wait(work(10.0, sends=3)) > 10.0
    assert timers.wait(work(100.0, sends=5)) > 100.0
    assert timers.wait(work(10.0, opcode=Opcode.TRUNCATE_FILE)) > 10.0


def test_but_a_checksum_that_most_would_have_is_asked_for_twice_before() -> None:
    """Nothing of it is done again: the same seq has the answer replayed."""
    timers = learned()
    assert [timers.wait(work(6.0, sends=sends)) for sends in (1, 2)] == [pytest.approx(0.9)] * 2
    assert timers.wait(work(0.5)) == pytest.approx(0.4)
    assert timers.wait(work(0.0)) == pytest.approx(0.3)


def test_a_server_seen_at_work_gets_some_times_what_it_needed() -> None:
    timers = learned(seen=(10.0, 1.0))
    assert timers.wait(work(20.0)) == pytest.approx(0.3 + 8.0, abs=0.1)
    timers.sample(work(10.0), 105.0)
    assert timers.wait(work(20.0)) == pytest.approx(0.3 + 20.0, abs=0.1)


def test_one_slow_answer_is_not_forgotten_by_a_few_fast_ones() -> None:
    timers = learned(seen=(10.0, 2.0))
    for _ in range(3):
        timers.sample(work(10.0), 100.1)
    assert timers.wait(work(20.0)) > 4.0


def test_work_of_one_kind_tells_nothing_of_another() -> None:
    timers = learned(seen=(10.0, 0.1))
    assert timers.wait(work(20.0, opcode=Opcode.TRUNCATE_FILE)) > 20.0


def test_long_work_does_not_make_small_files_wait() -> None:
    timers = learned(seen=(100.0, 60.0))
    assert timers.wait(work(0.06)) < 0.5


def test_what_is_done_at_once_is_repeated_several_times_before_waits_double() -> None:
    timers = learned()
    waits = [timers.wait(path(sends)) for sends in range(1, 8)]
    assert waits[:4] == [waits[0]] * 4
    assert waits[4:] == [pytest.approx(waits[0] * factor) for factor in (2, 4, 8)]


def test_without_a_round_trip_known_waits_double_at_once() -> None:
    timers = Timers()
    assert [timers.wait(path(sends)) for sends in (1, 2, 3)] == [1.0, 2.0, 3.0]
