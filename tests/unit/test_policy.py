"""The session layer's decisions, as tables."""

from __future__ import annotations

import pytest

from mavftpfs.session.policy import (
    MAX_QUANTUM,
    MIN_QUANTUM,
    RELIEF,
    STARVING,
    USE_MEMORY,
    Service,
    quantum,
    should_switch,
)


def test_quantum_grows_with_the_round_trip_within_bounds() -> None:
    assert quantum(None) == quantum(0.001) == MIN_QUANTUM
    assert quantum(0.2) == pytest.approx(2.0)
    assert quantum(5.0) == MAX_QUANTUM


def test_service_fades() -> None:
    service = Service()
    service.add(2.0, now=100.0)
    assert service.recent(100.0) == 2.0
    assert service.recent(100.0 + USE_MEMORY / 2) == pytest.approx(1.0)
    assert service.recent(100.0 + 2 * USE_MEMORY) == 0.0
    service.add(1.0, now=100.0 + USE_MEMORY / 2)
    assert service.seconds == pytest.approx(2.0)


def test_who_waited_long_keeps_the_session_for_a_while() -> None:
    def switch(waited: float, slice_: float) -> bool:
        return should_switch(
            current_has_demand=True,
            current_slice=slice_,
            current_use=5.0,
            waiting_use=0.0,
            rtt=0.02,
            current_waited=waited,
        )

    assert switch(waited=STARVING - 0.1, slice_=0.1)
    assert not switch(waited=STARVING, slice_=0.1)
    assert switch(waited=STARVING, slice_=RELIEF)


@pytest.mark.parametrize(
    ("demand", "slice_", "use", "waiting", "switch"),
    [
        (False, 0.0, 0.0, 9.0, True),  # readahead yields to any demand
        (True, 0.0, 5.0, 0.0, True),  # an editor beside a bulk copy goes first
        (True, 0.1, 0.0, 0.0, False),  # two newcomers do not thrash
        (True, 0.4, 0.0, 0.0, True),
        (True, 0.5, 5.0, 5.0, False),  # two bulk copies alternate
        (True, 1.1, 5.0, 5.0, True),
    ],
)
def test_who_gets_the_session(demand: bool, slice_: float, use: float, waiting: float, switch: bool) -> None:
    assert (
        should_switch(
            current_has_demand=demand,
            current_slice=slice_,
            current_use=use,
            waiting_use=waiting,
            rtt=0.02,
        )
        is switch
    )
