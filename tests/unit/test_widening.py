"""How much is added to a window where answers come in bunches."""

from __future__ import annotations

from mavftpfs.protocol.trains import FASTEST_LINK
from mavftpfs.protocol.widening import MOST, SECONDS, Widening

SENT = 100


def after(rounds: int, lost: int, widening: Widening, *, bunched: bool = True) -> float:
    for _ in range(rounds):
        widening.end_round(SENT - lost, lost, bunched=bunched)
    return widening.share


def test_nothing_is_added_where_answers_come_evenly() -> None:
    widening = Widening()
    assert after(20, 0, widening, bunched=False) == 0.0
    assert widening.window(30.0, 1000.0) == 30.0


def test_in_bunches_it_grows_step_by_step_up_to_three_times_the_window() -> None:
    widening = Widening()
    assert 0.0 < after(1, 0, widening) < after(1, 0, widening) < 1.0
    assert after(20, 0, widening) == 1.0
    assert widening.window(30.0, 1.01 * FASTEST_LINK) == 30.0
    assert widening.window(30.0, FASTEST_LINK) == 30.0 * (1.0 + MOST)


def test_what_is_added_waits_for_a_moment_at_most() -> None:
    widening = Widening()
    after(20, 0, widening)
    assert widening.window(300.0, 1000.0) == 300.0 + 1000.0 * SECONDS


def test_it_gives_way_where_more_is_lost_than_before() -> None:
    widening = Widening()
    after(20, 2, widening)
    assert after(20, 30, widening) < 0.1


def test_losses_that_are_always_there_are_not_its_own() -> None:
    assert after(20, 20, Widening()) == 1.0


def test_losses_that_stay_without_it_are_not_its_own() -> None:
    widening = Widening()
    after(20, 0, widening)
    assert after(20, 20, widening) < 0.1
    assert after(60, 20, widening) == 1.0


def test_it_ends_with_the_bunches() -> None:
    """What stayed on a slow link took long to go: `ls` waited 0.95 s of 0.61 for it beside an upload."""
    widening = Widening()
    after(20, 0, widening)
    assert after(1, 0, widening, bunched=False) == 0.0
