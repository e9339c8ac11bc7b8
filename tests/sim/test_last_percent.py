"""No transfer gets slow at its end: what was lost on the way is there by then, on virtual time.

That it costs no more than its share of the rate is held by test_shares and test_write_share.
"""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from statistics import mean

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.sources import MemorySource
from tests.support.worlds import ROOTS, MemorySink, World

RATE, RTT, LOSS = 100_000.0, 0.1, 0.1
SIZE = 500_000
LAST = 0.99
SEEDS = range(1, 7)
MOST = {"read": 0.75, "write": 1.25}
"""Seconds that the end may take on average, a write's Terminate included. What is lost last is missed after a
round trip, and may be lost again, or a card pauses."""


class Marks:
    """When almost all was there."""

    def __init__(self) -> None:
        self.almost: float | None = None

    def see(self, total: int) -> None:
        """Be told of each news."""
        if self.almost is None and total >= LAST * SIZE:
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
                marks.see(self.have.total)

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
                marks.see(self.acked.total + self.proven.total)

        source = Source(random.Random(1).randbytes(SIZE))
        upload = await connection.store.open_upload(path, source, create=True)
        await upload.finish()
        took = marks.since()
        await upload.abort()
    assert here.tree.data(path) == source.content
    return took


@pytest.mark.parametrize("transfer", [read, write])
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot", "mavsdk"])
def test_the_last_percent_is_not_slow(
    profile: str, transfer: Callable[[World, bytes], Awaitable[float]]
) -> None:
    link = LinkSettings(rate=RATE, delay=RTT / 2, loss=LOSS, queue=int(RATE / 2))
    directory = ROOTS.get(profile, b"") + b"/d"

    def run(seed: int) -> float:
        here = World(profile, link, seed=seed)
        here.tree.add_directory(directory)
        return trio.run(transfer, here, directory + b"/f", clock=MockClock(autojump_threshold=0))

    assert mean(map(run, SEEDS)) <= MOST[transfer.__name__]
