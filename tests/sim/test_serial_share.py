"""How much of a telemetry radio on a serial port is used, through the caches, on virtual time.

There the window grows from one and looks for what PX4's receive buffer survives (`protocol.flow`). That takes
the longer the longer the way is, and luck: so the mean of several runs counts.
"""

from __future__ import annotations

import random
from statistics import mean

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.sim.linkmodel import LinkSettings
from tests.bench.cases import Case, Direction
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World

RATE = 5760.0
SECONDS = 60.0
SEEDS = range(1, 4)
PIECE = 128 * 1024
"""Bytes that the kernel asks for, or a program writes, at once."""


async def read(tree: Tree, world: World, path: bytes, data: bytes) -> None:
    file = await tree.open(path)
    got = b""
    while len(got) < len(data):
        got += await file.read(len(got), PIECE)
    file.close()
    assert got == data


async def write(tree: Tree, world: World, path: bytes, data: bytes) -> None:
    file = await tree.create(path, exclusive=True)
    for at in range(0, len(data), PIECE):
        await file.write(at, data[at : at + PIECE])
    await file.flush()
    await file.release()
    assert world.tree.data(path) == data


def share(case: Case, seed: int) -> float:
    """Return the share of the limit that one run reaches."""
    link = LinkSettings(rate=case.rate, delay=case.rtt / 2, loss=case.loss, queue=4096)
    world = World(case.profile, link, seed=seed, serial=True)
    directory = ROOTS.get(case.profile, b"") + b"/d"
    world.tree.add_directory(directory)
    data = random.Random(1).randbytes(int(case.limit * SECONDS))
    if case.direction == "read":
        world.tree.add(directory + b"/log.bin", data)

    async def run() -> float:
        async with mounted(world, directory, verify="size") as (_, tree):
            began = trio.current_time()
            await (read if case.direction == "read" else write)(tree, world, directory + b"/log.bin", data)
            took = trio.current_time() - began
        return len(data) / took / case.limit_beside(world.vehicle.server.firmware.pauses)

    return trio.run(run, clock=MockClock(autojump_threshold=0))


@pytest.mark.parametrize(
    ("rtt", "loss"),
    [
        (0.3, 0.0),
        (0.3, 0.05),
        *(
            pytest.param(rtt, loss, marks=pytest.mark.soak)
            for rtt, loss in [(0.1, 0.0), (0.1, 0.01), (0.1, 0.05), (0.1, 0.1), (0.3, 0.01), (0.3, 0.1)]
        ),
    ],
)
@pytest.mark.parametrize("direction", ["read", "write"])
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
def test_a_radio_on_a_serial_port_is_used(
    profile: str, direction: Direction, rtt: float, loss: float
) -> None:
    case = Case(profile, RATE, rtt, loss, direction)
    assert case.target is not None
    assert mean(share(case, seed) for seed in SEEDS) >= case.target
