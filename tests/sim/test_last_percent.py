"""No transfer gets slow at its end: what was lost on the way is asked for again on the way, on virtual time.

So when the first bytes of the last percent come, little more than what is in flight is missing. All that was
lost, asked for again only then, would be a fifth of the file: 1.6 s more.

That it costs no more than its share of the rate is held by test_shares and test_write_share.
"""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from statistics import mean

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.bench.cases import FRAME, WAITING, Case, Direction
from tests.support.sources import MemorySource
from tests.support.worlds import ROOTS, MemorySink, World

RATE, RTT, LOSS = 100_000.0, 0.1, 0.1
SIZE = 700_000
LAST = 0.99
SEEDS = range(1, 7)

IN_VAIN = 1 - (1 - LOSS) ** 2
"""The share of requests that get no answer."""

TIMER = 1.5
"""Round trips after which what no newer answer tells to be lost is asked for again."""

LONE_TIMER = 3.0
"""The same for the Terminate: how long answers of its kind take is not known yet."""


def allowed(case: Case) -> float:
    """Return how many seconds the end may take on average: its share at the rate to be reached, one round
    trip, and a timer for each time that what is lost most often is lost; one more for chance.

    What waits in the link for the pauses of a card makes a reader's round trips longer.
    """
    pauses = PROFILES[case.profile].stall_chance > 0 and case.direction == "read"
    trip = RTT + WAITING if pauses else RTT
    in_flight = min(RATE / FRAME, case.limit / MAX_DATA) * RTT
    losses: float = sum(1 - (1 - IN_VAIN**times) ** in_flight for times in range(1, 30))
    close = (1 + IN_VAIN / (1 - IN_VAIN) * LONE_TIMER) * RTT if case.direction == "write" else 0.0
    assert case.target is not None
    share = (1 - LAST) * SIZE / (case.target * case.limit)
    return share + trip + (losses + 1) * TIMER * trip + close


class Marks:
    """When the first of the last percent was there."""

    def __init__(self) -> None:
        self.almost: float | None = None

    def see(self, stop: int) -> None:
        """Be told where what came ends."""
        if self.almost is None and stop >= LAST * SIZE:
            self.almost = trio.current_time()

    def since(self) -> float:
        """Return how long the end took that is now."""
        assert self.almost is not None
        return trio.current_time() - self.almost


async def read(here: World, path: bytes) -> float:
    data = random.Random(1).randbytes(SIZE)
    here.tree.add(path, data)
    async with here.connection() as connection:
        marks = Marks()

        class Sink(MemorySink):
            def on_data(self, offset: int, data: bytes) -> None:
                super().on_data(offset, data)
                marks.see(offset + len(data))

        sink = Sink(SIZE)
        reader = await connection.store.open_reader(path, sink)
        reader.want(0, SIZE, demand=True)
        assert await sink.wait_for(0, SIZE) == data
        took = marks.since()
        reader.close()
    return took


async def write(here: World, path: bytes) -> float:
    async with here.connection() as connection:
        marks = Marks()

        class Source(MemorySource):
            def on_acked(self, offset: int, count: int) -> None:
                super().on_acked(offset, count)
                marks.see(offset + count)

        source = Source(random.Random(1).randbytes(SIZE))
        upload = await connection.store.open_upload(path, source)
        await upload.finish()
        took = marks.since()
        await upload.abort()
    assert here.tree.data(path) == source.content
    return took


TRANSFERS: dict[Direction, Callable[[World, bytes], Awaitable[float]]] = {"read": read, "write": write}


@pytest.mark.parametrize("direction", ["read", "write"])
@pytest.mark.parametrize(
    "profile",
    ["px4", *(pytest.param(name, marks=pytest.mark.soak) for name in ("px4-nuttx", "ardupilot", "mavsdk"))],
)
def test_the_last_percent_is_not_slow(profile: str, direction: Direction) -> None:
    link = LinkSettings(rate=RATE, delay=RTT / 2, loss=LOSS, queue=int(RATE / 2))
    directory = ROOTS.get(profile, b"") + b"/d"

    def run(seed: int) -> float:
        here = World(profile, link, seed=seed)
        here.tree.add_directory(directory)
        return trio.run(TRANSFERS[direction], here, directory + b"/f", clock=MockClock(autojump_threshold=0))

    assert mean(map(run, SEEDS)) <= allowed(Case(profile, RATE, RTT, LOSS, direction))
