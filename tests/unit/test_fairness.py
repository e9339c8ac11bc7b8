"""Who goes first when several want the session, as tables."""

from __future__ import annotations

import pytest

from mavftpfs.session.fairness import LONG_WAIT, MAX_TURN, MIN_TURN, RELIEF, USE_MEMORY, Share


def heavy(seconds: float = 5.0) -> Share:
    share = Share()
    share.on_turn(100.0 - seconds, 100.0)
    return share


def test_use_fades_but_not_while_it_waits() -> None:
    share = heavy(2.0)
    assert share.used(100.0) == 2.0
    assert share.used(100.0 + USE_MEMORY / 2) == pytest.approx(1.0)
    assert share.used(100.0 + 2 * USE_MEMORY) == 0.0
    share.ask(100.0)
    assert share.used(100.0 + USE_MEMORY / 2) == 2.0
    share.on_turn(130.0, 131.0)
    share.asked_at = None
    assert share.used(131.0) == 3.0


def test_who_used_little_goes_first_until_another_waited_long() -> None:
    busy, light = heavy(), Share()
    busy.ask(100.0)
    light.ask(101.0)
    assert light.rank(101.0, 0.02) < busy.rank(101.0, 0.02)
    late = 100.0 + LONG_WAIT
    assert busy.rank(late, 0.02) < light.rank(late, 0.02)
    assert light.rank(late, 1.0) < busy.rank(late, 1.0)


def test_who_waited_long_keeps_the_session_for_a_while() -> None:
    share = heavy()
    share.ask(100.0)
    began = 100.0 + LONG_WAIT
    assert share.gives_way(0.0, began - 0.1, began, 0.02)
    assert not share.gives_way(0.0, began, began + 0.1, 0.02)
    assert share.gives_way(0.0, began, began + RELIEF, 0.02)


@pytest.mark.parametrize(
    ("slice_", "use", "rival", "rtt", "gives_way"),
    [
        (0.0, 5.0, 0.0, 0.02, True),  # an editor beside a copy goes first
        (0.1, 0.0, 0.0, 0.02, False),  # two newcomers do not alternate all the time
        (0.4, 0.0, 0.0, 0.02, True),
        (0.9 * MIN_TURN, 5.0, 5.0, None, False),  # two copies alternate
        (1.1 * MIN_TURN, 5.0, 5.0, None, True),
        (1.1 * MIN_TURN, 5.0, 5.0, 0.2, False),
        (2.1, 5.0, 5.0, 0.2, True),
        (1.1 * MAX_TURN, 5.0, 5.0, 5.0, True),
    ],
)
def test_when_a_turn_ends(
    slice_: float, use: float, rival: float, rtt: float | None, gives_way: bool
) -> None:
    assert heavy(use).gives_way(rival, 100.0, 100.0 + slice_, rtt) is gives_way
