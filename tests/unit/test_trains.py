"""The pace of a path, learnt from rows of answers, and keeping it."""

from __future__ import annotations

from math import inf

import pytest

from mavftpfs.protocol.trains import Trains

RATE = 400.0
RTT = 0.3


def answer(trains: Trains, began: float, count: int, spacing: float) -> None:
    """Let `count` answers come, so many seconds apart, and end a round of RTT."""
    for index in range(count):
        trains.on_reply(began + index * spacing)
    trains.end_round(count, count / RTT)


def known() -> Trains:
    """A dense row was seen: the pace is RATE."""
    trains = Trains()
    answer(trains, 0.0, 8, 1 / RATE)
    return trains


def test_a_dense_row_in_a_long_round_is_the_paths_pace() -> None:
    trains = known()
    assert trains.proven
    assert abs(trains.rate - RATE) < 1.0


def test_few_answers_tell_nothing() -> None:
    trains = Trains()
    answer(trains, 0.0, 7, 1 / RATE)
    assert not trains.proven
    assert trains.rate == inf


def test_answers_in_one_bunch_tell_nothing_and_hold_nothing_back() -> None:
    trains = Trains()
    for round_ in range(5):
        answer(trains, RTT * round_, 64, 0.0)
    assert not trains.proven
    assert trains.rate == inf
    assert trains.room(2.0) > 1000


def test_answers_spread_as_we_sent_prove_a_pace_only_when_more_brings_no_more() -> None:
    trains = Trains()
    for round_, count in enumerate((10, 20, 40, 40)):
        assert not trains.proven
        answer(trains, RTT * round_, count, RTT / count)
    assert trains.proven
    assert abs(trains.rate - 40 / RTT) < 15.0


def test_an_old_pace_is_forgotten() -> None:
    trains = known()
    for round_ in range(1, 12):
        answer(trains, RTT * round_, 8, 4 / RATE)
    assert abs(trains.rate - RATE / 4) < 1.0


def test_a_way_that_became_short_and_fast_is_noticed() -> None:
    """At the old pace each round has one answer, and a round that short tells nothing by itself."""
    trains = Trains()
    answer(trains, 0.0, 8, 0.02)
    assert trains.proven
    now = 10.0
    while now < 20.0:
        trains.begin()
        for _ in range(min(4, trains.room(now))):
            trains.on_sent(1)
            now += 0.001
            trains.on_reply(now)
            trains.end_round(1, 1 / 0.001)
        now = min(trains.next_room_at(), now + 0.01)
    assert not trains.proven or trains.rate > 500.0


def test_no_more_goes_out_than_the_path_takes() -> None:
    trains = known()
    now, sends = 10.0, []
    while now < 12.0:
        trains.begin()
        room = trains.room(now)
        assert room <= 4
        for _ in range(room):
            trains.on_sent(1)
            sends.append(now)
        assert now < trains.next_room_at() < now + 3 / RATE
        now = trains.next_room_at()
    assert 1.05 * 2.0 * RATE < len(sends) < 1.15 * 2.0 * RATE


def test_what_leaves_in_one_go_takes_no_slow_path_for_long_beside_others() -> None:
    """Four frames of a radio of 57600 baud are 0.18 s, which whoever came next waited for."""
    trains = Trains()
    answer(trains, 0.0, 8, 0.046)
    trains.rate, trains.proven = 1 / 0.046, True
    assert trains.room(10.0) == 4
    assert trains.room(10.0, briefly=True) == 2
    trains.on_sent(2)
    assert trains.room(10.0, briefly=True) == 0
    assert trains.next_room_at() < 10.046


def test_who_was_not_held_back_need_not_be_woken() -> None:
    trains = known()
    trains.begin()
    assert trains.room(10.0) >= 1
    assert trains.next_room_at() == inf
    while trains.room(10.0):
        trains.on_sent(1)
    assert trains.next_room_at() < 10.1
    trains.begin()
    assert trains.next_room_at() == inf


def test_a_higher_pace_is_kept_as_well() -> None:
    trains = known()
    trains.room(0.0)
    trains.on_sent(100)
    trains.begin()
    assert trains.room(1.0, 2.0) == 4
    trains.on_sent(4)
    assert trains.room(1.0, 2.0) == 0
    assert trains.next_room_at() == pytest.approx(1.0 + 1.0 / (2.0 * RATE), rel=0.01)
