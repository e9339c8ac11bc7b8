"""Reading uses what a link carries: representative cases of the table that scripts/bench prints.

Virtual time, bytes compared; the whole table takes minutes, these take seconds (a slow link is cheap).
"""

from __future__ import annotations

import pytest

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.profiles import PROFILES
from tests.bench.cases import Case, Direction
from tests.bench.goodput import measure
from tests.support.takingturns import taking_turns

LONG = 60.0
SHORT = 20.0
START = 0.06
"""What the start of a short run may cost of its share."""


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize("loss", [0.0, 0.01, 0.05, 0.1])
@pytest.mark.parametrize("rtt", [0.01, 0.1, 0.3])
@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
def test_a_radio_of_57600_baud(profile: str, rtt: float, loss: float) -> None:
    case = Case(profile, 5760.0, rtt, loss)
    target = case.target
    assert target is not None
    assert measure(case, LONG).share >= target


@pytest.mark.parametrize(
    ("rtt", "loss"),
    [(0.1, 0.05), (0.3, 0.1), pytest.param(0.01, 0.0, marks=pytest.mark.soak)],
)
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot", "mavsdk"])
def test_a_hundred_kilobytes_per_second(profile: str, rtt: float, loss: float) -> None:
    case = Case(profile, 100_000.0, rtt, loss)
    target = case.target
    assert target is not None
    assert measure(case, SHORT).share >= target - START


@pytest.mark.parametrize(
    "rtt", [0.1, pytest.param(0.01, marks=pytest.mark.soak), pytest.param(0.3, marks=pytest.mark.soak)]
)
def test_the_pauses_of_a_card_hardly_cost_a_reader_anything(rtt: float) -> None:
    """Without answers in reserve the link is idle in a third of all pauses."""
    assert measure(Case("px4-nuttx", 100_000.0, rtt, 0.0), LONG).share >= 0.93


@pytest.mark.parametrize(
    ("rate", "rtt", "share", "requests"),
    [
        pytest.param(1_000_000.0, 0.01, 0.94, 1.9, marks=pytest.mark.soak),
        pytest.param(1_000_000.0, 0.1, 0.85, 2.2, marks=pytest.mark.soak),
        (250_000.0, 0.1, 0.77, 1.6),
    ],
)
def test_a_card_that_pauses_is_kept_busy(rate: float, rtt: float, share: float, requests: float) -> None:
    result = measure(Case("px4-nuttx", rate, rtt, 0.0), SHORT)
    assert result.share >= share
    assert result.requests <= requests


@pytest.mark.parametrize("queue", [10_000, 4096])
def test_a_reserve_keeps_to_what_the_links_queue_holds(queue: int) -> None:
    """0.25 s would be 25 kB: most of it was lost, and asked for again, twice for each chunk."""
    result = measure(Case("px4-nuttx", 100_000.0, 0.01, 0.0), SHORT, queue=queue)
    assert result.share >= 0.8
    assert result.requests <= 1.4


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize("direction", ["read", "write"])
@pytest.mark.parametrize(
    ("rate", "rtt", "jitter", "loss"),
    [
        pytest.param(625_000.0, 0.03, 0.005, 0.0, marks=pytest.mark.soak),
        pytest.param(625_000.0, 0.03, 0.015, 0.03, marks=pytest.mark.soak),
        pytest.param(1e6, 0.01, 0.01, 0.0, marks=pytest.mark.soak),
        (100_000.0, 0.05, 0.02, 0.0),
    ],
)
def test_a_link_that_holds_each_packet_up_is_filled_too(
    rate: float, rtt: float, jitter: float, loss: float, direction: Direction
) -> None:
    """By the least round trip the window was far too narrow, and as little came back as it asked for: a third
    of what Wi-Fi carries."""
    result = measure(Case("px4", rate, rtt, loss, direction), SHORT, jitter=jitter)
    assert result.share >= (0.9 if direction == "write" else 0.95) - 4 * loss
    assert result.requests <= 1.1


@pytest.mark.parametrize("direction", ["read", "write"])
@pytest.mark.soak
@pytest.mark.parametrize(("reorder", "share", "requests"), [(0.1, 0.9, 1.1), (0.5, 0.65, 1.3)])
def test_so_is_one_that_mixes_packets(
    reorder: float, share: float, requests: float, direction: Direction
) -> None:
    """Those that are held back by 20 ms make the usual round trip longer than the least: half was reached."""
    result = measure(Case("px4", 625_000.0, 0.03, 0.0, direction), SHORT, reorder=reorder)
    assert result.share >= share
    assert result.requests <= requests


@pytest.mark.parametrize("direction", ["read", "write"])
@pytest.mark.parametrize("rate", [625_000.0, pytest.param(1e6, marks=pytest.mark.soak)])
def test_nor_does_that_flood_a_short_queue(rate: float, direction: Direction) -> None:
    """A window three times as wide lost 60 % of what it asked for, and everybody else's packets with it."""
    queue = int(rate * 0.014)
    result = measure(Case("px4", rate, 0.03, 0.0, direction), SHORT, jitter=0.01, queue=queue)
    assert result.share >= 0.9
    assert result.requests <= 1.35


@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.parametrize(
    ("rate", "rtt", "seconds", "telemetry"), [(5760.0, 0.3, LONG, 400.0), (100_000.0, 0.1, 10.0, 4000.0)]
)
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
def test_telemetry_gets_through_beside_a_copy(
    profile: str, rate: float, rtt: float, seconds: float, telemetry: float, loss: float
) -> None:
    """It shares a short queue with the answers, which must not fill it for long."""
    case = Case(profile, rate, rtt, loss)
    target = case.target
    assert target is not None
    result = measure(case, seconds, queue=4096, telemetry=telemetry)
    assert result.dropped <= 0.1 * case.limit * seconds / MAX_DATA
    assert result.share >= target - START


def test_a_short_shared_queue_does_not_empty_a_long_way() -> None:
    """ArduPilot, 300 ms away: five at a time would be 3.9 kB/s, its bursts 30; evenly asked it is more."""
    case = Case("ardupilot", 100_000.0, 0.3, 0.0)
    assert measure(case, LONG).share * case.limit > 50_000.0
