"""How much of a link writing uses, from open to close, and what it leaves to others, on virtual time.

The targets are those of docs/benchmarks.md; scripts/bench measures all of them.
"""

from __future__ import annotations

from statistics import mean

import pytest
from trio.testing import MockClock

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import LinkSettings
from tests.bench.cases import Case
from tests.bench.goodput import measure
from tests.support.sources import MemorySource
from tests.support.takingturns import taking_turns
from tests.support.worlds import World

PROFILES = ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk"]
SHORT_QUEUE = 4096


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.05, 0.1])
@pytest.mark.parametrize("profile", taking_turns(PROFILES))
def test_writing_uses_a_radio(profile: str, loss: float) -> None:
    case = Case(profile, 5760.0, 0.1, loss, "write")
    assert case.target is not None
    assert measure(case, 60.0).share >= case.target


@pytest.mark.parametrize(("rtt", "loss"), [(0.01, 0.05), (0.1, 0.0)])
@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk"])
def test_writing_uses_a_faster_link(profile: str, rtt: float, loss: float) -> None:
    case = Case(profile, 100_000.0, rtt, loss, "write")
    assert case.target is not None
    assert measure(case, 20.0).share >= case.target


@pytest.mark.parametrize(
    ("rtt", "seconds", "share"),
    [
        (0.3, 60.0, 0.86),
        pytest.param(0.1, 60.0, 0.9, marks=pytest.mark.soak),
    ],
)
def test_the_pauses_of_a_card_cost_their_time_once(rtt: float, seconds: float, share: float) -> None:
    """Else the server has nothing to do a round trip after a pause, for as long again: 0.8."""
    assert measure(Case("px4-nuttx", 100_000.0, rtt, 0.0, "write"), seconds).share >= share


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.parametrize(
    ("rate", "rtt", "seconds", "telemetry"), [(5760.0, 0.3, 60.0, 400.0), (100_000.0, 0.1, 10.0, 4000.0)]
)
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
def test_a_short_queue_does_not_overflow_and_telemetry_gets_through(
    profile: str, rate: float, rtt: float, seconds: float, telemetry: float, loss: float
) -> None:
    case = Case(profile, rate, rtt, loss, "write")
    result = measure(case, seconds, queue=SHORT_QUEUE, telemetry=telemetry)
    assert result.dropped <= 0.1 * case.limit * seconds / MAX_DATA
    assert result.share > 0.7


@pytest.mark.soak
def test_what_a_short_queue_loses_is_not_put_down_to_the_pauses_of_a_card() -> None:
    """All was, where the server answers faster than the link brings requests: the more was lost, the more
    went out, in some runs two thirds in vain, until the upload was given up."""
    case = Case("px4-nuttx", 100_000.0, 0.3, 0.0, "write")
    results = [measure(case, 60.0, queue=SHORT_QUEUE, seed=seed) for seed in range(1, 3)]
    assert mean(result.share for result in results) >= 0.85
    assert mean(result.requests for result in results) <= 1.6


@pytest.mark.holds("rule 14.24")
@pytest.mark.parametrize("profile", ["ardupilot", "ardupilot5", "littlefs"])
async def test_never_more_than_a_short_queue_holds(profile: str, autojump_clock: MockClock) -> None:
    here = World(profile, LinkSettings(rate=1e6, delay=0.005))
    here.tree.add_directory(b"/d")
    source = MemorySource(bytes(range(256)) * 400)
    async with here.connection() as connection:
        upload = await connection.store.open_upload(b"/d/f", source)
        await upload.finish()
        await upload.abort()
    assert here.tree.data(b"/d/f") == source.content
    assert here.vehicle.server.firmware.dropped_requests == 0
    assert connection.engine.stats.retransmissions == 0


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
def test_few_requests_are_sent_in_vain(profile: str) -> None:
    clean = measure(Case(profile, 5760.0, 0.1, 0.0, "write"), 60.0)
    assert clean.requests <= 1.02
    lossy = measure(Case(profile, 5760.0, 0.1, 0.1, "write"), 60.0)
    assert lossy.requests <= 1.05 / (1 - 0.1) ** 2
