"""A way that becomes several times longer for good under a transfer with a small window, on virtual time."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.worlds import MemorySink, World

SIZE = 8 << 20


@pytest.mark.parametrize(("rate", "loss"), [(3_000.0, 0.0), (10_000.0, 0.0), (3_000.0, 0.02)])
async def test_a_small_window_finds_out(rate: float, loss: float, autojump: MockClock) -> None:
    """A slow link 50 ms away is full with a few requests; 3.7 kB/s stayed when it became a quick one 500 ms
    away."""
    world = World("px4", LinkSettings(rate=rate, delay=0.025, loss=loss))
    world.tree.add(b"/d/f", random.Random(1).randbytes(SIZE))
    async with world.connection() as connection:
        sink = MemorySink(SIZE)
        reader = await connection.store.open_reader(b"/d/f", sink)
        reader.want(0, SIZE, demand=True)
        await trio.sleep(20.0)
        world.model.settings = replace(world.model.settings, rate=60_000.0, delay=0.25)
        await trio.sleep(90.0)
        before = sink.have.total
        await trio.sleep(10.0)
        share = (sink.have.total - before) / (10.0 * 60_000.0 * 239 / 266 * (1 - loss))
        reader.close()
    assert share > 0.85
