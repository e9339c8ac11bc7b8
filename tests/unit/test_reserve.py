"""How many answers are kept in the link's queue for the pauses of a server."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mavftpfs.protocol.reserve import BESIDE_OTHERS, MOST, Reserve

RTT = 0.1
PERIOD = 2.0


class Path:
    """A server that pauses for a tenth of the time, unless a queue bridges it. holds: seconds of answers that
    wait somewhere, of so many."""

    def __init__(self, holds: Callable[[float], float], *, bridges: bool = True) -> None:
        self.reserve = Reserve()
        self.now = 0.0
        self.most = 0.0
        """Seconds that were tried at most."""
        self._holds = holds
        self._bridges = bridges

    def run(self, seconds: float, *, share: float = 0.1) -> None:
        reserve, end = self.reserve, self.now + seconds
        while self.now < end:
            if share and reserve.wanted == 0.0:
                reserve.want(self.now, RTT)
            for _ in range(int(PERIOD / RTT)):
                self.now += RTT
                reserve.on_round(self.now, self._holds(reserve.seconds))
                self.most = max(self.most, reserve.seconds)
            left = 0.0 if self._bridges and reserve.seconds > 0.2 else share
            reserve.end_period(self.now, RTT, PERIOD, left * PERIOD, costly=left > 0.0)


def test_what_is_seen_to_wait_is_whole_within_a_second() -> None:
    path = Path(lambda seconds: seconds)
    path.reserve.want(0.0, RTT)
    assert path.reserve.seconds == pytest.approx(0.05)
    for _ in range(4):
        path.reserve.on_round(0.1, path.reserve.seconds)
    assert path.reserve.seconds == pytest.approx(MOST + RTT)


def test_of_what_a_small_buffer_loses_no_more_is_tried() -> None:
    """Over USB the first 50 requests wait 25 ms in the server's buffer, and the rest is lost."""
    path = Path(lambda seconds: min(seconds, 0.025), bridges=False)
    path.run(PERIOD)
    assert path.reserve.seconds == 0.0
    path.run(300.0)
    assert path.most <= 0.06


def test_pauses_in_a_row_do_not_take_it_all() -> None:
    path = Path(lambda seconds: seconds)
    path.run(PERIOD)
    for _ in range(2):
        before = path.reserve.seconds
        for _ in range(20):
            path.reserve.on_round(path.now, 0.4 * before)
        assert path.reserve.seconds == pytest.approx(0.6 * before)
    path.run(4 * PERIOD)
    assert path.reserve.seconds > 0.2


def test_a_buffer_that_is_far_smaller_is_seen_at_once() -> None:
    path = Path(lambda seconds: seconds)
    path.run(PERIOD)
    for _ in range(20):
        path.reserve.on_round(path.now, 0.05)
    assert path.reserve.seconds == pytest.approx(0.05)


def test_no_more_than_a_short_queue_of_the_link_holds() -> None:
    path = Path(lambda seconds: min(seconds, 0.1), bridges=False)
    path.reserve._expected = 1e9  # it helps
    path.run(4.0)
    path.most = 0.0
    path.run(60.0)
    assert 0.08 < path.reserve.seconds < 0.16
    assert path.most < 0.16


def test_a_few_rounds_that_pauses_emptied_say_nothing() -> None:
    path = Path(lambda seconds: seconds)
    path.run(10.0)
    before = path.reserve.seconds
    assert before > MOST
    for _ in range(5):
        path.reserve.on_round(path.now, 0.0)
    assert path.reserve.seconds == before
    path.run(PERIOD)
    assert path.reserve.seconds > 0.9 * before


def test_a_server_that_holds_it_all_and_pauses_as_long_gets_none() -> None:
    """Its buffer is large; there is no queue in the link that would bridge anything."""
    path = Path(lambda seconds: seconds, bridges=False)
    kept = 0
    for _ in range(150):
        path.run(PERIOD)
        kept += path.reserve.seconds > 0.0
    assert kept < 0.25 * 150


def test_a_round_that_timed_nothing_says_nothing() -> None:
    reserve = Reserve()
    reserve.want(0.0, RTT)
    before = reserve.seconds
    for _ in range(20):
        reserve.on_round(1.0, float("inf"))
    assert reserve.seconds == before


def test_beside_others_there_is_less_of_it_and_for_a_while() -> None:
    """They waited for it, and for the next pause besides: a tenth of all longer than they may."""
    path = Path(lambda seconds: seconds, bridges=False)
    path.reserve._expected = 1e9  # it helps
    path.run(4.0)
    assert path.reserve.seconds > MOST
    path.reserve.on_others(path.now)
    assert path.reserve.seconds == BESIDE_OTHERS
    path.run(8.0)
    assert path.reserve.seconds == BESIDE_OTHERS
    path.run(6.0)
    assert path.reserve.seconds > MOST


def test_it_is_forgotten_when_the_pauses_end() -> None:
    path = Path(lambda seconds: seconds)
    path.run(20.0)
    path.run(400.0, share=0.0)
    assert path.reserve.seconds == 0.0
