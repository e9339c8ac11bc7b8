"""The share of a link that reading and writing reach, on virtual time: scripts/bench goodput --help.

Deterministic: a simulated vehicle with its real queue and timing, a modelled link, no clock but the model's.
Writing is timed from open to close through the caches, with verify_max=0; reading from open to the last byte
through the session. Bytes are compared in every run.
"""

from __future__ import annotations

import argparse
import random
import signal
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import trio
from rich.console import Console
from rich.progress import track
from trio.testing import MockClock

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.session.connection import Connection
from tests.bench import record, tables
from tests.bench.cases import TROUBLES, Case, Direction, Result
from tests.support.rigs import Rig
from tests.support.transfers import MemorySink

PATIENCE = 20
"""How many times the ideal duration a run may take."""

PIECE = 128 * 1024
"""Bytes that a program writes at once."""

FILE = b"/d/log.bin"


def measure(
    case: Case,
    seconds: float,
    *,
    queue: int | None = None,
    telemetry: float = 0.0,
    jitter: float = 0.0,
    reorder: float = 0.0,
    seed: int = 1,
) -> Result:
    """Read or write for about `seconds` of link time; queue: bytes that wait for the link's transmitter;
    telemetry: bytes per second that the vehicle sends beside it; jitter, reorder: of the link; seed: chance.

    Raises:
        AssertionError: the bytes differ.
        trio.TooSlowError: it took PATIENCE times the ideal.
    """
    room = int(max(4096, case.rate / 2)) if queue is None else queue
    link = TROUBLES[case.trouble]
    settings = replace(
        link,
        rate=case.rate,
        delay=case.rtt / 2,
        jitter=jitter or link.jitter,
        reorder=reorder or link.reorder,
        loss=case.loss,
        queue=room,
    )
    here = Rig(case.profile, link=settings, seed=seed, telemetry=telemetry)
    data = random.Random(1).randbytes(int(case.limit * seconds))
    transfer = _read if case.direction == "read" else _write

    async def run() -> Result:
        async with here.connected() as connection:
            with trio.fail_after(seconds * PATIENCE):
                took = await transfer(here, connection, data)
        requests = connection.engine.stats.requests * MAX_DATA / len(data)
        server = here.vehicle.server
        dropped = here.model.dropped
        dropped += server.firmware.dropped_replies
        limit = replace(case, rate=case.rate - telemetry).limit_beside(server.firmware.pauses)
        return Result(case, limit, len(data) / took / limit, requests, dropped)

    return trio.run(run, clock=MockClock(autojump_threshold=0))


async def _read(here: Rig, connection: Connection, data: bytes) -> float:
    """Return how many seconds it took to read the file."""
    here.put(FILE, data)
    began = trio.current_time()
    sink = MemorySink(len(data))
    reader = await connection.store.open_reader(here.root + FILE, sink)
    reader.want(0, len(data), demand=True)
    assert await sink.wait_for(0, len(data)) == data
    return trio.current_time() - began


async def _write(here: Rig, connection: Connection, data: bytes) -> float:
    """Return how many seconds it took from the open of a new file to the return of its close."""
    here.put_directory(b"/d")
    tree = here.mount(verify_max=0)
    assert FILE not in dict(await tree.list(b"/d"))  # as a lookup does before the open
    began = trio.current_time()
    file = await tree.create(FILE, exclusive=False)
    for at in range(0, len(data), PIECE):
        await file.write(at, data[at : at + PIECE])
    await file.flush()
    took = trio.current_time() - began
    assert here.data(FILE) == data
    await file.release()
    return took


def cases(arguments: argparse.Namespace) -> list[Case]:
    """Return every combination asked for."""
    directions: tuple[Direction, ...] = ("read", "write")
    chosen = (
        arguments.profiles,
        arguments.rates,
        arguments.rtts,
        arguments.losses,
        directions,
        arguments.troubles,
    )
    return [Case(*conditions) for conditions in product(*chosen)]


def measure_seed(run: tuple[Case, int], seconds: float) -> Result:
    """Measure a case with one seed; see measure."""
    case, seed = run
    return measure(case, seconds, seed=seed)


def everything(chosen: Sequence[Case], seeds: Sequence[int], seconds: float) -> list[Result]:
    """Measure all cases, as many at once as there are processors (each has a clock of its own).

    Returns one result for each case: the mean of its seeds.
    """
    ours_to_end = (signal.SIGINT, signal.SIG_IGN)
    runs = list(product(chosen, seeds))
    with get_context("spawn").Pool(initializer=signal.signal, initargs=ours_to_end) as pool:
        found = pool.imap(partial(measure_seed, seconds=seconds), runs)
        shown = track(found, "goodput", total=len(runs), console=Console(stderr=True), transient=True)
        results = list(shown)
    return [mean(results[at : at + len(seeds)]) for at in range(0, len(results), len(seeds))]


def mean(results: Sequence[Result]) -> Result:
    """Return the mean of one case's results."""
    count = len(results)
    return Result(
        results[0].case,
        sum(result.limit for result in results) / count,
        sum(result.share for result in results) / count,
        sum(result.requests for result in results) / count,
        round(sum(result.dropped for result in results) / count),
    )


def main(argv: Sequence[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="scripts/bench goodput", description="share of the link's limit")
    profiles = ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk"]
    parser.add_argument("--profiles", nargs="+", default=profiles)
    parser.add_argument("--rates", nargs="+", type=float, default=[5760.0, 100_000.0, 1_000_000.0])
    parser.add_argument("--rtts", nargs="+", type=float, default=[0.01, 0.1, 0.3])
    parser.add_argument("--losses", nargs="+", type=float, default=[0.0, 0.01, 0.05, 0.1])
    parser.add_argument("--seconds", type=float, default=60.0, help="link time of each run")
    parser.add_argument(
        "--troubles",
        nargs="+",
        choices=TROUBLES,
        default=["none"],
        help="2 %% reordered, 1 %% doubled, 50 ms jittery",
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], help="a result is the mean of these")
    parser.add_argument("--json", type=Path, help="put the results into this file")
    parser.add_argument(
        "--against", type=Path, help="show what changed since this file of --json was written"
    )
    arguments = parser.parse_args(argv)
    before = record.sections(arguments.against)["goodput"]["results"] if arguments.against else []
    results = everything(cases(arguments), arguments.seeds, arguments.seconds)
    found = [asdict(result) | {"target": result.case.target} for result in results]
    print(tables.goodput_table(found))
    if before:
        print(tables.changes_table(before, found))
    if arguments.json is not None:
        record.put(arguments.json, "goodput", argv, 0.0, found)
    return 0
