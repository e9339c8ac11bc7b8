"""The user's ceiling on what we cause on the link."""

from __future__ import annotations

from math import inf

import pytest

from mavftpfs.protocol.budget import Budget

COST = 266


def spend_all(budget: Budget, start: float, stop: float, *, urgent: bool = False) -> list[float]:
    """Send whenever it is allowed; return the times."""
    now, sends = start, []
    while now < stop:
        budget.begin()
        for _ in range(budget.room(now, urgent=urgent)):
            budget.on_sent(1)
            budget.spend(COST, now)
            sends.append(now)
        now = budget.next_room_at()
        assert now < inf
    return sends


@pytest.mark.parametrize("rate", [100.0, 5760.0, 1e6])
def test_the_rate_is_kept_over_any_time_and_used(rate: float) -> None:
    sends = spend_all(Budget(rate), 10.0, 10.0 + 100 * COST / rate)
    assert 99 <= len(sends) <= 102
    for first, at in enumerate(sends):
        within = sum(COST for other in sends[first:] if other < at + 1.0)
        assert within <= rate * 1.01 + COST


def test_nothing_is_saved_up() -> None:
    budget = Budget(10_000.0)
    spend_all(budget, 0.0, 1.0)
    assert len(spend_all(budget, 100.0, 100.5)) <= 0.5 * 10_000 / COST + 2


def test_small_answers_go_ahead_and_bulk_pays() -> None:
    budget = Budget(5760.0)
    spend_all(budget, 0.0, 1.0)
    budget.begin()
    assert budget.room(1.0, urgent=False) == 0
    assert budget.exhausted
    assert budget.room(1.0, urgent=True) >= 1
    ahead = spend_all(budget, 1.0, 1.001, urgent=True)
    assert 1 <= len(ahead) <= 4
    budget.begin()
    assert budget.room(1.05, urgent=False) == 0
    assert budget.next_room_at() > 1.05 + 0.05


def test_who_has_nothing_to_send_is_not_woken() -> None:
    budget = Budget(1e6)
    budget.begin()
    assert budget.next_room_at() == inf
    assert budget.room(5.0, urgent=False) >= 1
    assert budget.next_room_at() == inf
    assert not budget.exhausted
