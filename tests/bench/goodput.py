"""The share of a link that reading reaches, on virtual time: python -m tests.bench.goodput [--json FILE].

Deterministic: a simulated vehicle with its real queue and timing, a modelled link, no clock but the model's.
The limit is that of design: (rate - telemetry) * 239/266 * (1 - loss), and at most the server's ceiling.
Bytes are compared in every run.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import trio
from rich.console import Console
from rich.table import Table
from trio.testing import MockClock

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.worlds import ROOTS, MemorySink, World

FRAME = 266
"""Bytes of a MAVLink 2 frame that carries 239 bytes of data."""

ARDUPILOT_BURST = MAX_DATA / 0.0056
ARDUPILOT_WINDOW = 4
ARDUPILOT_POLL = 0.010
PATIENCE = 20
"""How many times the ideal duration a run may take."""


@dataclass(frozen=True, slots=True)
class Case:
    """One measurement's conditions. rate in bytes/s, rtt in seconds, loss 0..1 each way."""

    profile: str
    rate: float
    rtt: float
    loss: float

    @property
    def limit(self) -> float:
        """Bytes per second that could be read at best."""
        limit = self.rate * MAX_DATA / FRAME * (1 - self.loss)
        if self.profile.startswith(("ardupilot", "littlefs")):
            window = ARDUPILOT_WINDOW * MAX_DATA / (self.rtt + ARDUPILOT_POLL)
            burst = min(ARDUPILOT_BURST, self.rate / 3)
            limit = min(limit, max(window, burst))
        return limit


@dataclass(frozen=True, slots=True)
class Result:
    """share: goodput over the limit. requests: per chunk of data."""

    case: Case
    share: float
    requests: float


def measure(case: Case, seconds: float) -> Result:
    """Read for about `seconds` of link time.

    Raises:
        AssertionError: the bytes differ.
        trio.TooSlowError: it took PATIENCE times the ideal.
    """
    settings = LinkSettings(
        rate=case.rate, delay=case.rtt / 2, loss=case.loss, queue=int(max(4096, case.rate / 2))
    )
    world = World(case.profile, settings)
    size = int(case.limit * seconds)
    data = random.Random(1).randbytes(size)
    path = ROOTS.get(case.profile, b"") + b"/d/log.bin"
    world.tree.add(path, data)

    async def read() -> Result:
        async with world.connection() as connection:
            began = trio.current_time()
            sink = MemorySink(size)
            reader = await connection.store.open_reader(path, sink)
            reader.want(0, size, demand=True)
            with trio.fail_after(seconds * PATIENCE):
                assert await sink.wait_for(0, size) == data
            took = trio.current_time() - began
            return Result(case, size / took / case.limit, connection.engine.stats.requests * MAX_DATA / size)

    return trio.run(read, clock=MockClock(autojump_threshold=0))


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    """Yield every combination asked for."""
    for profile, rate, rtt, loss in product(
        arguments.profiles, arguments.rates, arguments.rtts, arguments.losses
    ):
        yield Case(profile, rate, rtt, loss)


def show(results: list[Result]) -> None:
    """Print a table."""
    table = Table("profile", "bytes/s", "RTT s", "loss", "share of limit", "requests/chunk")
    for result in results:
        case = result.case
        table.add_row(
            case.profile,
            f"{case.rate:g}",
            f"{case.rtt:g}",
            f"{case.loss:g}",
            f"{result.share:.2f}",
            f"{result.requests:.2f}",
        )
    Console().print(table)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description="reading: share of the link's limit")
    profiles = ["px4", "px4-nuttx", "ardupilot", "mavsdk"]
    parser.add_argument("--profiles", nargs="+", default=profiles)
    parser.add_argument("--rates", nargs="+", type=float, default=[5760.0, 100_000.0])
    parser.add_argument("--rtts", nargs="+", type=float, default=[0.01, 0.1, 0.3])
    parser.add_argument("--losses", nargs="+", type=float, default=[0.0, 0.01, 0.05, 0.1])
    parser.add_argument("--seconds", type=float, default=60.0, help="link time of each run")
    parser.add_argument("--json", type=Path, help="write the results here too")
    arguments = parser.parse_args()
    results = [measure(case, arguments.seconds) for case in cases(arguments)]
    show(results)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(result) for result in results], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
