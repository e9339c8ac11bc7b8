"""The user's ceiling on what we cause on the link."""

from __future__ import annotations

from math import inf

import pytest

from mavftpfs.protocol.budget import FRAME_OVERHEAD, Budget
from mavftpfs.protocol.payload import Opcode

COST = 266


def wire(opcode: int, *, size: int = 0, req_opcode: int = 0, data: bytes = b"") -> bytes:
    """Return 251 bytes."""
    return bytes((1, 0, 0, opcode, size, req_opcode, 0, 0, 0, 0, 0, 0)) + data.ljust(239, b"\0")


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


def test_a_read_pays_for_its_reply_when_it_goes_out() -> None:
    budget = Budget(1000.0)
    budget.room(0.0, urgent=False)
    budget.on_request(wire(Opcode.READ_FILE, size=239), 0.0)
    budget.on_reply(wire(Opcode.ACK, size=239, req_opcode=Opcode.READ_FILE, data=bytes([7]) * 239), 0.0)
    budget.room(0.0, urgent=False)
    request = FRAME_OVERHEAD + 5  # what follows the size is zeros, which MAVLink 2 cuts
    reply = FRAME_OVERHEAD + 12 + 239
    assert budget.next_room_at() == pytest.approx((request + reply) / 1000.0, abs=1e-3)


def test_other_replies_are_paid_for_when_they_come() -> None:
    budget = Budget(1000.0)
    budget.room(0.0, urgent=False)
    budget.on_reply(wire(Opcode.ACK, size=4, req_opcode=Opcode.WRITE_FILE, data=b"\xef"), 0.0)
    budget.on_reply(wire(Opcode.NAK, size=1, req_opcode=Opcode.READ_FILE, data=b"\x06"), 0.0)
    budget.room(0.0, urgent=False)
    assert budget.next_room_at() == pytest.approx(2 * (FRAME_OVERHEAD + 13) / 1000.0, abs=1e-3)
