"""No transfer gets slow at its end: what was lost is repaired while the window moves, on virtual time."""

from __future__ import annotations

import random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.sources import MemorySource
from tests.support.worlds import ROOTS, MemorySink, World

RATE, RTT, LOSS = 100_000.0, 0.1, 0.1
SIZE = 1_500_000
LAST = 0.99
ROUND_TRIPS = 8
"""That the end may take beside its share: what is lost last is missed after one, and may be lost again. To
repair a tenth of the file behind it would take 15 and more."""

PROFILES = ["px4", "px4-nuttx", "ardupilot", "mavsdk"]


class Marks:
    """When almost all was there."""

    def __init__(self) -> None:
        self.began = trio.current_time()
        self.almost: float | None = None

    def see(self, total: int) -> None:
        if self.almost is None and total >= LAST * SIZE:
            self.almost = trio.current_time()

    def check(self) -> None:
        """The end took its share of the time, and a few round trips."""
        assert self.almost is not None
        end = trio.current_time()
        assert end - self.almost <= (1 - LAST) * (end - self.began) + ROUND_TRIPS * RTT


def world(profile: str) -> tuple[World, bytes]:
    here = World(profile, LinkSettings(rate=RATE, delay=RTT / 2, loss=LOSS, queue=int(RATE / 2)))
    directory = ROOTS.get(profile, b"") + b"/d"
    here.tree.add_directory(directory)
    return here, directory + b"/f"


@pytest.mark.parametrize("profile", PROFILES)
async def test_reading(profile: str, autojump: MockClock) -> None:
    here, path = world(profile)
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
        marks.check()
        reader.close()


@pytest.mark.parametrize("profile", PROFILES)
async def test_writing(profile: str, autojump: MockClock) -> None:
    here, path = world(profile)
    async with here.connection() as connection:
        marks = Marks()

        class Source(MemorySource):
            def on_acked(self, offset: int, count: int) -> None:
                super().on_acked(offset, count)
                marks.see(self.acked.total + self.proven.total)

        source = Source(random.Random(1).randbytes(SIZE))
        upload = await connection.store.open_upload(path, source, create=True)
        await upload.finish()
        marks.check()
        await upload.abort()
    assert here.tree.data(path) == source.content
