"""Since when a user of the session made no progress, and when it tries again."""

from __future__ import annotations

from math import inf

import pytest

from mavftpfs.session.tries import LEAST_PAUSE, Tries
from mavftpfs.shared.errors import FtpNak, RequestTimeout, SessionLost

LOST = SessionLost("no answer")
LIMIT = 30.0


def lost_at(tries: Tries, *times: float) -> list[float]:
    """Lose the session in turns that begin and end at these times; return the pauses after them."""
    pauses = []
    for now in times:
        tries.on_turn(now)
        tries.on_lost(LOST, now, LIMIT)
        pauses.append(max(0.0, tries.retry_at - now))
    return pauses


def test_the_clock_begins_with_the_first_turn_without_progress() -> None:
    tries = Tries()
    assert tries.barren_for(100.0) == 0.0
    tries.on_turn(100.0)
    tries.on_turn(110.0)
    assert tries.barren_for(115.0) == 15.0
    assert tries.failure(129.9, LIMIT) is None
    assert isinstance(tries.failure(130.0, LIMIT), RequestTimeout)
    tries.begin_anew()
    assert tries.failure(130.0, LIMIT) is None


def test_after_a_loss_it_tries_at_once_then_after_pauses_that_double() -> None:
    assert lost_at(Tries(), 100.0, 102.0, 104.0, 108.0, 116.0) == [0.0, 2.0, 4.0, 8.0, 14.0]
    assert lost_at(Tries(), 100.0, 100.0, 100.0) == pytest.approx([0.0, LEAST_PAUSE, LEAST_PAUSE])


def test_so_it_does_after_the_first_loss_since_progress() -> None:
    """Also if the turn began before that progress."""
    tries = Tries()
    assert lost_at(tries, 100.0, 102.0) == [0.0, 2.0]
    tries.on_turn(104.0)
    tries.begin_anew()
    tries.on_lost(LOST, 105.0, LIMIT)
    assert tries.retry_at <= 105.0
    assert lost_at(tries, 107.0) == [2.0]


def test_its_failure_is_what_it_lost_the_session_by() -> None:
    tries, nak = Tries(), FtpNak(7, 1)
    lost = SessionLost("refused", by_server=True)
    lost.__cause__ = nak
    lost_at(tries, 100.0)
    assert tries.failure(130.0, LIMIT) is LOST
    tries.on_lost(lost, 101.0, LIMIT)
    assert tries.failure(130.0, LIMIT) is nak


def test_it_may_be_put_off() -> None:
    tries = Tries()
    tries.begin_anew(inf)
    assert tries.retry_at == inf
    tries.begin_anew()
    assert tries.retry_at == -inf
