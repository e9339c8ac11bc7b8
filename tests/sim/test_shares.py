"""Reading and writing use what a link carries, and leave room for others: a cell for each regime and server.

Virtual time, bytes compared. The targets are those of docs/benchmarks.md; scripts/bench measures all cells.
"""

from __future__ import annotations

from statistics import mean

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import LinkSettings
from tests.bench.cases import FRAME, Case, Direction
from tests.bench.goodput import measure
from tests.support.rigs import Rig, read_file, write_file
from tests.support.transfers import MemorySource, begin_to_read, content

LONG = 60.0
SHORT = 10.0
START = 0.06
"""The part of its share that a short run may lose at its start."""

SHORT_QUEUE = 4096
BOTH = pytest.mark.parametrize("direction", ["read", "write"])
HARDER = pytest.mark.parametrize("direction", [pytest.param("read", marks=pytest.mark.soak), "write"])
"""The two directions, but reading, which is the easier one here, in the soak only."""


def target(case: Case) -> float:
    assert case.target is not None
    return case.target


# --- radios


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize(
    ("profile", "rtt", "loss"),
    [
        pytest.param("px4", 0.01, 0.0, marks=pytest.mark.soak),
        pytest.param("px4", 0.1, 0.05, marks=pytest.mark.soak),
        ("px4", 0.3, 0.1),
        ("px4-nuttx", 0.3, 0.1),
        ("ardupilot", 0.01, 0.0),
        ("ardupilot", 0.1, 0.05),
        ("mavsdk", 0.1, 0.05),
    ],
)
def test_a_radio_of_57600_baud_is_read(profile: str, rtt: float, loss: float) -> None:
    case = Case(profile, 5760.0, rtt, loss)
    assert measure(case, LONG).share >= target(case)


@pytest.mark.parametrize(
    ("profile", "loss"),
    [("px4", 0.0), ("px4", 0.1), ("px4-nuttx", 0.1), ("ardupilot", 0.1), ("mavsdk", 0.1)],
)
def test_a_radio_of_57600_baud_is_written_and_little_in_vain(profile: str, loss: float) -> None:
    case = Case(profile, 5760.0, 0.1, loss, "write")
    result = measure(case, LONG)
    assert result.share >= target(case)
    if profile != "px4-nuttx":  # whose card pauses
        assert result.requests <= 1.05 / (1 - loss) ** 2


def serial_share(case: Case, seed: int) -> float:
    """Return the share of the limit that one run through the caches reaches on a serial port."""
    link = LinkSettings(rate=case.rate, delay=case.rtt / 2, loss=case.loss, queue=SHORT_QUEUE)
    here = Rig(case.profile, link=link, seed=seed, serial=True)
    here.put_directory(b"/d")
    data = content(int(case.limit * LONG), 1)
    if case.direction == "read":
        here.put(b"/d/log.bin", data)

    async def run() -> float:
        async with here.mounted(b"/d", verify_max=0) as tree:
            began = trio.current_time()
            if case.direction == "write":
                await write_file(tree, b"/d/log.bin", data)
            else:
                assert await read_file(tree, b"/d/log.bin") == data
            return trio.current_time() - began

    took = trio.run(run, clock=MockClock(autojump_threshold=0))
    assert here.data(b"/d/log.bin") == data
    return len(data) / took / case.limit_beside(here.vehicle.server.firmware.pauses)


@BOTH
@pytest.mark.parametrize(("rtt", "loss"), [(0.01, 0.0), (0.3, 0.05)], ids=["a cable", "a radio"])
def test_a_slow_serial_port_is_used(rtt: float, loss: float, direction: Direction) -> None:
    """Short answers come sooner than full ones there: that is no queue. Losses take luck: so the mean of
    several runs counts where some are lost."""
    case = Case("px4-nuttx", 5760.0, rtt, loss, direction)
    assert mean(serial_share(case, seed) for seed in range(1, 4 if loss else 2)) >= target(case)


# --- faster links


@pytest.mark.parametrize(
    ("profile", "direction", "rtt", "loss"),
    [
        ("px4", "read", 0.3, 0.1),
        pytest.param("px4-nuttx", "read", 0.1, 0.05, marks=pytest.mark.soak),
        ("ardupilot", "read", 0.3, 0.1),
        ("ardupilot", "write", 0.01, 0.05),
        ("mavsdk", "write", 0.1, 0.0),
    ],
)
def test_a_hundred_kilobytes_per_second(profile: str, direction: Direction, rtt: float, loss: float) -> None:
    case = Case(profile, 100_000.0, rtt, loss, direction)
    assert measure(case, SHORT).share >= target(case) - (START if direction == "read" else 0.0)


@pytest.mark.parametrize(
    ("direction", "rate", "rtt", "share", "requests"),
    [
        ("read", 100_000.0, 0.1, 0.94, 1.1),
        ("write", 100_000.0, 0.1, 0.88, 1.2),
        pytest.param("read", 250_000.0, 0.1, 0.77, 1.3, marks=pytest.mark.soak),
        pytest.param("read", 1_000_000.0, 0.01, 0.94, 1.5, marks=pytest.mark.soak),
        pytest.param("read", 1_000_000.0, 0.1, 0.83, 1.7, marks=pytest.mark.soak),
    ],
)
def test_the_pauses_of_a_card_cost_their_time_once(
    direction: Direction, rate: float, rtt: float, share: float, requests: float
) -> None:
    """Without answers in reserve the link is idle in a third of them, or the server for as long again."""
    result = measure(Case("px4-nuttx", rate, rtt, 0.0, direction), 1.5 * SHORT)
    assert result.share >= share
    assert result.requests <= requests


def test_a_reserve_keeps_to_what_the_links_queue_holds() -> None:
    """0.25 s would be 25 kB: most of it was lost, and asked for again, twice for each chunk."""
    result = measure(Case("px4-nuttx", 100_000.0, 0.01, 0.0), SHORT, queue=SHORT_QUEUE)
    assert result.share >= 0.8
    assert result.requests <= 1.4


@pytest.mark.soak
def test_what_a_short_queue_loses_is_not_put_down_to_the_pauses_of_a_card() -> None:
    """All was, where the server answers faster than the link brings requests: the more was lost, the more
    went out, in some runs two thirds in vain, until the upload was given up."""
    case = Case("px4-nuttx", 100_000.0, 0.3, 0.0, "write")
    results = [measure(case, LONG, queue=SHORT_QUEUE, seed=seed) for seed in range(1, 3)]
    assert mean(result.share for result in results) >= 0.85
    assert mean(result.requests for result in results) <= 1.6


@pytest.mark.holds("fault overflow")
@BOTH
@pytest.mark.parametrize(
    ("rate", "rtt", "jitter", "loss"),
    [
        (100_000.0, 0.05, 0.02, 0.0),
        pytest.param(625_000.0, 0.03, 0.015, 0.03, marks=pytest.mark.soak),
        pytest.param(1e6, 0.01, 0.01, 0.0, marks=pytest.mark.soak),
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


@BOTH
@pytest.mark.soak
@pytest.mark.parametrize(("reorder", "share", "requests"), [(0.1, 0.9, 1.1), (0.5, 0.65, 1.3)])
def test_so_is_one_that_mixes_packets(
    reorder: float, share: float, requests: float, direction: Direction
) -> None:
    """Packets that are delayed by 20 ms make the usual round trip longer than the least: half the rate was
    reached."""
    result = measure(Case("px4", 625_000.0, 0.03, 0.0, direction), SHORT, reorder=reorder)
    assert result.share >= share
    assert result.requests <= requests


@HARDER
def test_nor_does_that_flood_a_short_queue(direction: Direction) -> None:
    """A window three times as wide lost 60 % of what it asked for, and everybody else's packets with it."""
    case = Case("px4", 625_000.0, 0.03, 0.0, direction)
    result = measure(case, 8.0, jitter=0.01, queue=int(case.rate * 0.014))
    assert result.share >= 0.87
    assert result.requests <= 1.2


@pytest.mark.holds("fault overflow")
@BOTH
@pytest.mark.parametrize(
    ("profile", "rate", "rtt", "loss"),
    [
        ("px4", 5760.0, 0.3, 0.05),
        pytest.param("px4", 100_000.0, 0.1, 0.0, marks=pytest.mark.soak),
        ("ardupilot", 5760.0, 0.3, 0.0),
        ("ardupilot", 100_000.0, 0.1, 0.05),
    ],
)
def test_telemetry_gets_through_beside_a_copy(
    profile: str, rate: float, rtt: float, loss: float, direction: Direction
) -> None:
    """Telemetry shares a short queue with the answers, which must not fill it for long."""
    case = Case(profile, rate, rtt, loss, direction)
    seconds, telemetry = (LONG, 400.0) if rate == 5760.0 else (SHORT, 4000.0)
    result = measure(case, seconds, queue=SHORT_QUEUE, telemetry=telemetry)
    assert result.dropped <= 0.1 * case.limit * seconds / MAX_DATA
    assert result.share >= (target(case) - START if direction == "read" else 0.7)


def test_a_short_shared_queue_does_not_empty_a_long_way() -> None:
    """ArduPilot, 300 ms away: five at a time would be 3.9 kB/s, its bursts 30; evenly asked it is more."""
    case = Case("ardupilot", 100_000.0, 0.3, 0.0)
    assert measure(case, 2 * SHORT).share * case.limit > 50_000.0


@pytest.mark.holds("rule 14.24")
@pytest.mark.parametrize("profile", ["ardupilot", "ardupilot5", "littlefs"])
async def test_never_more_is_written_than_a_short_queue_holds(profile: str) -> None:
    here = Rig(profile, link=LinkSettings(rate=1e6, delay=0.005))
    here.card.add_directory(b"/d")
    source = MemorySource(bytes(range(256)) * 400)
    async with here.connected() as connection:
        upload = connection.store.open_upload(b"/d/f", source)
        await upload.finish()
        await upload.end()
    assert here.card.data(b"/d/f") == source.content
    assert here.server.firmware.dropped_requests == 0
    assert connection.engine.stats.lost == 0


async def test_a_slow_link_that_becomes_fast_is_used() -> None:
    """The pace of a radio is kept while that is the way; then the cable is plugged in."""
    size = 1_500_000
    here = Rig("px4", {b"/d/f": content(size, 1)}, LinkSettings(rate=5760.0, delay=0.05))
    async with here.connected() as connection:
        reader, sink = await begin_to_read(connection, b"/d/f", 0)
        for rate in (50_000.0, 5760.0):
            await trio.sleep(8.0)
            here.model.settings = LinkSettings(rate=rate, queue=16_384, delay=0.01)
            await trio.sleep(5.0)
            before = sink.have.total
            await trio.sleep(5.0)
            assert sink.have.total - before > 0.8 * 5.0 * rate * MAX_DATA / FRAME
        reader.close()
