"""Real sockets and a real mount beside the peers: scripts/bench mount [--quick] [--json FILE].

For each server, link and direction, everybody moves the same file (a shorter one goes to the peers where a
link has no rate), in turns, each against a freshly started server: nobody pays for what another left behind.
A shaped link is a process between server and client, the same for all (`tests.bench.shaper`). Timed from the
first call to the last: for a mount, the `cp`. Bytes are compared after each run; whoever does not finish in
time, fails, or brings other bytes is listed as that.
"""

from __future__ import annotations

import argparse
import filecmp
import json
import os
import random
import shutil
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from tests.bench.cases import Direction
from tests.bench.figures import BARE, LINKS, US, LinkShape, Outcome, Row, Run, as_json, summarise
from tests.bench.peers import PINS, Client, Environment, Job, Measured, NotToBeHadError, clients
from tests.support.mounts import wait_until
from tests.support.vehicles import HOST, Process, free_udp_port

REAL_MAVSDK = "mavsdk-real"
"""The MAVSDK library's own server; every other name is a profile of the simulator."""

WINDOWS = {"ardupilot": 5, "ardupilot5": 5, "mavsdk": 32, REAL_MAVSDK: 32}
LOOPBACK_WINDOW = 64
SPEND = 5.0
"""Seconds after which a client has no further repetition in a cell."""

READY_TIMEOUT = 90.0
TABLE_WIDTH = 132


@dataclass(frozen=True, slots=True)
class Cell:
    """What everybody does. size, peers_size: bytes. timeout: seconds."""

    server: str
    link: str
    direction: Direction
    size: int
    peers_size: int
    timeout: float

    @property
    def shape(self) -> LinkShape | None:
        """The link, None for the bare loopback."""
        return LINKS[self.link]

    @property
    def window(self) -> int:
        """Requests in flight that fill the link and that the server can hold: for those who must be told."""
        server = WINDOWS.get(self.server, 10_000)
        if self.shape is None:
            return min(server, LOOPBACK_WINDOW)
        return min(server, max(4, int(1.5 * self.shape.rate * self.shape.rtt / 266)))

    @property
    def patience(self) -> float:
        """Seconds after which a request is lost, for those who must be told: twice a full window's trip."""
        if self.shape is None:
            return 0.25
        return 0.1 + 2 * (self.shape.rtt + self.window * 277 / self.shape.rate)

    def size_for(self, client: str) -> int:
        """Return how much a client moves."""
        return self.size if client in (US, BARE) else self.peers_size


def cell(server: str, link: str, direction: Direction, *, quick: bool) -> Cell:
    """Return the sizes and the time-out that keep a run within bounds."""
    shape = LINKS[link]
    slow = server.startswith(("ardupilot", "littlefs"))
    if shape is None:
        size, peers_size = (200_000, 200_000) if slow else (8_000_000, 800_000)
        timeout = 10.0
    elif shape.rate < 10_000:
        size = peers_size = 60_000
        timeout = 45.0
    else:
        size = peers_size = 100_000 if slow else 2_500_000
        timeout = 12.0
    if quick:
        size, peers_size, timeout = size // 4, peers_size // 4, timeout / 2
    return Cell(server, link, direction, size, peers_size, timeout)


# -- one run ----------------------------------------------------------------------------------------


def server_argv(server: str, root: Path, port: int) -> list[str]:
    """Return the command line of a vehicle that serves `root` to the client on `port`."""
    if server == REAL_MAVSDK:
        return [sys.executable, "-m", "tests.support.mavsdk_server", str(root), f"udpout://{HOST}:{port}"]
    link = f"udpout:{HOST}:{port}"
    return [sys.executable, "-m", "mavftpfs", "sim", str(root), "--profile", server, "--link", link]


def shaper_argv(shape: LinkShape, vehicle_port: int, client_port: int, seed: int) -> list[str]:
    """Return the command line of the link between two ports."""
    options = {
        "rate": shape.rate,
        "delay": shape.rtt / 2,
        "loss": shape.loss,
        "queue": shape.queue,
        "seed": seed,
    }
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return [sys.executable, "-m", "tests.bench.shaper", str(vehicle_port), str(client_port), *words]


class Stage:
    """A server, perhaps a link, and a client's folder, all of one run."""

    def __init__(self, cell: Cell, folder: Path, source: Path, seed: int) -> None:
        self.cell = cell
        self.folder = folder
        self.source = source
        self.seed = seed
        self.port = free_udp_port()
        (folder / "card" / "bench").mkdir(parents=True)
        (folder / "here").mkdir()

    def job(self) -> Job:
        """Put the files where they belong and return what is to be done."""
        card, here = self.folder / "card" / "bench", self.folder / "here"
        shutil.copyfile(self.source, (card if self.cell.direction == "read" else here) / "file.bin")
        return Job(
            port=self.port,
            direction=self.cell.direction,
            remote="/bench/file.bin",
            local=here / "file.bin",
            timeout=self.cell.timeout,
            window=self.cell.window,
            patience=self.cell.patience,
            folder=self.folder,
        )

    def start(self, stack: ExitStack) -> None:
        """Start link and server; `stack` ends them."""
        shape, port = self.cell.shape, self.port
        if shape is not None:
            port = free_udp_port()
            link = Process("link", shaper_argv(shape, port, self.port, self.seed), self.folder)
            stack.callback(_stop, link)
        argv = server_argv(self.cell.server, self.folder / "card", port)
        server = Process("server", argv, self.folder)
        stack.callback(_stop, server)
        wait_until("server ready", lambda: bool(server.output.read_bytes()), READY_TIMEOUT)

    def same_bytes(self) -> bool:
        """Whether what arrived is what was sent."""
        there = self.folder / ("here" if self.cell.direction == "read" else "card/bench") / "file.bin"
        return there.is_file() and filecmp.cmp(self.source, there, shallow=False)


def _stop(process: Process) -> None:
    with suppress(AssertionError):  # it was killed for not ending: what a peer may do to a server
        process.stop()


def run_one(cell: Cell, client: Client, source: Path, seed: int) -> Run:
    """Let one client move the file once."""
    size = source.stat().st_size
    with TemporaryDirectory(prefix="mavftpfs-bench-") as name:
        stage = Stage(cell, Path(name), source, seed)
        with ExitStack() as stack:
            job = stage.job()
            stage.start(stack)
            measured = client.run(job)
        detail = measured.detail.replace(f"{stage.folder}/", "")
        if measured.outcome is Outcome.OK and not stage.same_bytes():
            measured, detail = Measured(Outcome.CORRUPT), "other bytes arrived"
    return Run(
        cell.server,
        cell.link,
        cell.direction,
        client.name,
        size,
        measured.outcome,
        measured.seconds,
        measured.cpu,
        measured.memory,
        detail,
    )


# -- all runs ---------------------------------------------------------------------------------------


class Bench:
    """Runs cells; `everybody` by name, `repetitions` of each at most."""

    def __init__(self, everybody: Sequence[Client], repetitions: int, folder: Path, console: Console) -> None:
        self.everybody = everybody
        self.repetitions = repetitions
        self.folder = folder
        self.console = console
        self.runs: list[Run] = []

    def run(self, cells: Sequence[Cell]) -> list[Run]:
        """Run every cell and return all runs: one by one, but slow links, which need no CPU, at once."""
        slow = [cell for cell in cells if cell.shape is not None and cell.shape.rate < 10_000]
        for cell in cells:
            if cell not in slow:
                self._run_in_turns(cell)
        jobs = [(cell, client) for cell in slow for client in self._participants(cell)]
        with ThreadPoolExecutor(max_workers=max(1, len(jobs))) as pool:
            for run in pool.map(lambda job: self._once(job[0], job[1], 1), jobs):
                self._note(run)
        return self.runs

    def _participants(self, cell: Cell) -> Iterator[Client]:
        for client in self.everybody:
            if client.takes_part(cell.direction, shaped=cell.shape is not None):
                yield client

    def _run_in_turns(self, cell: Cell) -> None:
        spent: dict[str, float] = {}
        for repetition in range(self.repetitions):
            for client in self._participants(cell):
                if spent.get(client.name, 0.0) >= SPEND:
                    continue
                run = self._once(cell, client, repetition + 1)
                self._note(run)
                ends_it = run.outcome in (Outcome.TIMEOUT, Outcome.UNAVAILABLE)
                cost = SPEND if ends_it else run.seconds or 0.0
                spent[client.name] = spent.get(client.name, 0.0) + cost

    def _once(self, cell: Cell, client: Client, seed: int) -> Run:
        try:
            client.prepare()
        except NotToBeHadError as error:
            size = cell.size_for(client.name)
            what = (cell.server, cell.link, cell.direction, client.name)
            return Run(*what, size, Outcome.UNAVAILABLE, detail=str(error))
        return run_one(cell, client, self._source(cell.size_for(client.name)), seed)

    def _source(self, size: int) -> Path:
        path = self.folder / f"{size}.bin"
        if not path.exists():
            fresh = path.with_suffix(f".{random.randbytes(8).hex()}")
            fresh.write_bytes(random.Random(size).randbytes(size))
            fresh.rename(path)
        return path

    def _note(self, run: Run) -> None:
        self.runs.append(run)
        rate = f"{run.size / run.seconds / 1000:,.1f} kB/s" if run.seconds else run.detail
        where = f"{run.server} {run.link} {run.direction}"
        self.console.print(f"{where}: {run.client}: {run.outcome} {rate}", highlight=False, style="dim")


# -- presentation -----------------------------------------------------------------------------------


def show(rows: Sequence[Row], console: Console) -> None:
    """Print a table."""
    table = Table("server", "link", "", "client", "kB/s", "of mavftpfs", "of bare loop", "of limit")
    for head in ("CPU s/MB", "µs/chunk", "peak MB", "runs"):
        table.add_column(head)
    before = None
    for row in rows:
        here = (row.server, row.link, row.direction)
        if before not in (None, here):
            table.add_section()
        before = here
        table.add_row(*here, row.client, *cells_of(row))
    console.print(table)


def cells_of(row: Row) -> list[str]:
    """Return the figures of a row as text."""
    mark = "< " if row.at_most else ""

    def number(value: float | None, form: str, prefix: str = mark) -> str:
        return "–" if value is None else f"{prefix}{value:{form}}"

    rate = number(None if row.rate is None else row.rate / 1000, ",.1f")
    if row.outcome is not Outcome.OK:
        rate = f"{rate} ({row.outcome})" if row.rate else str(row.outcome)
    return [
        rate,
        *(number(share, ".2f") for share in (row.of_us, row.of_bare, row.of_limit)),
        number(row.cpu, ".3f", ""),
        number(None if row.per_chunk is None else row.per_chunk * 1e6, ".1f", ""),
        number(None if row.memory is None else row.memory / 1e6, ".0f", ""),
        f"{row.good}/{row.runs}",
    ]


# -- the command ------------------------------------------------------------------------------------

DEFAULT_CELLS: tuple[tuple[str, str], ...] = (
    ("px4", "unshaped"),
    (REAL_MAVSDK, "unshaped"),
    ("ardupilot", "unshaped"),
    ("px4", "wifi"),
    ("px4", "wifi-1%"),
    ("px4", "wifi-5%"),
    ("ardupilot", "wifi-1%"),
    ("px4", "57600"),
    ("ardupilot", "57600"),
)
QUICK_CELLS: tuple[tuple[str, str], ...] = (("px4", "unshaped"), ("px4", "wifi-5%"))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(prog="scripts/bench mount", description="a real mount beside the peers")
    made.add_argument(
        "--servers", nargs="+", help="profiles of the simulator, and mavsdk-real (the library's server)"
    )
    made.add_argument("--links", nargs="+", choices=LINKS)
    made.add_argument("--directions", nargs="+", choices=["read", "write"], default=["read", "write"])
    made.add_argument("--clients", nargs="+", help="default: all")
    made.add_argument(
        "--size", type=int, metavar="BYTES", help="of everybody's file, in place of a choice by link"
    )
    made.add_argument("--timeout", type=float, metavar="S", help="after which a run is cut off")
    made.add_argument("--repetitions", type=int, help="of each run, interleaved (default 3, quick 1)")
    made.add_argument("--quick", action="store_true", help="two cells, shorter files, one repetition")
    made.add_argument("--json", type=Path, help="write runs and rows here too")
    return made


def chosen_cells(args: argparse.Namespace) -> list[Cell]:
    """Return the cells asked for: the default ones, unless servers or links were named."""
    pairs: Iterator[tuple[str, str]] | tuple[tuple[str, str], ...]
    pairs = QUICK_CELLS if args.quick else DEFAULT_CELLS
    if args.servers or args.links:
        servers = args.servers or dict.fromkeys(server for server, _ in pairs)
        pairs = product(servers, args.links or LINKS)
    chosen = [
        cell(server, link, direction, quick=args.quick)
        for server, link in pairs
        for direction in args.directions
    ]
    if args.size:
        chosen = [replace(cell, size=args.size, peers_size=args.size) for cell in chosen]
    if args.timeout:
        chosen = [replace(cell, timeout=args.timeout) for cell in chosen]
    return chosen


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, and write the JSON file."""
    args = parser().parse_args(argv)
    everybody = clients(Environment())
    unknown = sorted(set(args.clients or ()) - everybody.keys())
    if unknown:
        print(f"no such client: {', '.join(unknown)}; there are {', '.join(everybody)}", file=sys.stderr)
        return 1
    chosen = [everybody[name] for name in args.clients or everybody]
    cells = chosen_cells(args)
    repetitions = args.repetitions or (1 if args.quick else 3)
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    with TemporaryDirectory(prefix="mavftpfs-bench-") as name:
        os.environ["XDG_STATE_HOME"] = name  # what a mount cannot deliver is not kept for the user
        bench = Bench(chosen, repetitions, Path(name), console)
        runs = bench.run(cells)
    rows = summarise(runs, {cell.link: cell.timeout for cell in cells})
    show(rows, console)
    if args.json is not None:
        links = {name: as_json(shape) for name, shape in LINKS.items() if shape is not None}
        section = {
            "peers": list(PINS),
            "links": links,
            "cells": [[*pair] for pair in dict.fromkeys((cell.server, cell.link) for cell in cells)],
            "rows": [as_json(row) for row in rows],
            "runs": [as_json(run) for run in runs],
        }
        args.json.write_text(json.dumps(section))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
