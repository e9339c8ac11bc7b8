"""Reading by bursts beside a window of requests, on virtual time: python -m tests.bench.bursts --help.

How fast a file comes over a radio, and how long a listing waits beside it (95th percentile). ARCHITECTURE.md,
"Bursts", says what follows. Deterministic by its seeds; bytes are compared in every run.
"""

from __future__ import annotations

import argparse
import random
import sys
from itertools import product
from statistics import mean, quantiles

import trio
from rich.console import Console
from rich.table import Table
from trio.testing import MockClock

from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.policy import ReadMode
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from tests.support.worlds import begin_to_read, content, path, world

MODES: tuple[ReadMode, ...] = ("window", "burst")
PATIENCE = 20
DIRECTORIES = 100
PAUSE = (0.5, 2.5)
"""Seconds between two listings."""


def read(profile: str, link: LinkSettings, mode: ReadMode, seconds: float, seed: int) -> float:
    """Return how many bytes per second a file takes, of so many seconds of the link."""
    data = content(int((link.rate or 0.0) * seconds))
    here = world(profile, link, big=data)

    async def run() -> float:
        async with here.connection(ConnectOptions(read_mode=mode), seed=seed) as connection:
            began = trio.current_time()
            with trio.fail_after(seconds * PATIENCE):
                _, sink = await begin_to_read(connection, path(profile, "big"), 0)
                assert await sink.wait_for(0, len(data)) == data
            return len(data) / (trio.current_time() - began)

    return trio.run(run, clock=MockClock(autojump_threshold=0))


def wait(profile: str, link: LinkSettings, mode: ReadMode, seconds: float, seed: int) -> float:
    """Return how long a listing of a directory waits beside it: the 95th percentile."""
    data = content(int((link.rate or 0.0) * seconds))
    here = world(profile, link, big=data)
    for number in range(DIRECTORIES):
        here.tree.add(path(profile, f"{number}/f"), b"small")

    async def run() -> float:
        async with here.connection(ConnectOptions(read_mode=mode), seed=seed) as connection:
            _, sink = await begin_to_read(connection, path(profile, "big"), 1)
            waits = [0.0]
            for number in range(DIRECTORIES):
                await trio.sleep(random.Random(number).uniform(*PAUSE))
                if sink.have.covers(0, len(data)):
                    break
                waits.append(await _list(connection, path(profile, f"{number}")))
            return quantiles(waits[1:], n=20)[-1]

    return trio.run(run, clock=MockClock(autojump_threshold=0))


async def _list(connection: Connection, directory: bytes) -> float:
    began = trio.current_time()
    listing = await connection.store.list_directory(directory)
    assert [entry.name for entry in listing.entries] == [b"f"]
    return trio.current_time() - began


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.bursts", description="bursts beside a window"
    )
    parser.add_argument("--profiles", nargs="+", default=["px4", "mavsdk"])
    parser.add_argument("--duplex", nargs="+", choices=["half", "full"], default=["half", "full"])
    parser.add_argument("--rates", nargs="+", type=float, default=[5760.0])
    parser.add_argument("--rtts", nargs="+", type=float, default=[0.05, 0.1, 0.3])
    parser.add_argument("--losses", nargs="+", type=float, default=[0.0, 0.01, 0.05])
    parser.add_argument("--queue", type=int, default=4096, help="bytes that wait for the link's transmitter")
    parser.add_argument("--seconds", type=float, default=60.0, help="link time of each run")
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    table = Table(
        "profile", "duplex", "bytes/s", "RTT s", "loss", "window", "burst", "gain", "ls s: window", "burst"
    )
    options = (arguments.profiles, arguments.duplex, arguments.rates, arguments.rtts, arguments.losses)
    for profile, duplex, rate, rtt, loss in product(*options):
        link = LinkSettings(rate, arguments.queue, Duplex(duplex), rtt / 2, loss=loss)
        runs = range(1, 1 + arguments.seeds)
        by, asked = (
            [mean(measure(profile, link, mode, arguments.seconds, seed) for seed in runs) for mode in MODES]
            for measure in (read, wait)
        )
        conditions = (profile, duplex, f"{rate:g}", f"{rtt:g}", f"{loss:g}")
        gain = f"{100 * (by[1] / by[0] - 1):+.1f} %"
        table.add_row(
            *conditions, *(f"{speed:.0f}" for speed in by), gain, *(f"{late:.2f}" for late in asked)
        )
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
