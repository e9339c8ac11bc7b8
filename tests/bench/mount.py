"""Real sockets and a real mount beside the peers: scripts/bench mount [--json FILE].

For each server, link and direction, everybody moves the same file (a shorter one goes to the peers where a
link has no rate), in turns, each against a freshly started server: nobody pays for what another left behind.
A link with a rate is the simulator's model, frame by frame. Timed from the first call to the last: for a
mount, the `cp`. Bytes are compared after each run; a client that does not finish in time, fails, or brings
other bytes is listed as that.
"""

from __future__ import annotations

import argparse
import filecmp
import os
import random
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench import record, tables
from tests.bench.cases import Direction
from tests.bench.figures import BARE, LINKS, REAL_MAVSDK, US, Cell, Measured, Outcome, Run, as_json, summarise
from tests.bench.peers import PINS, Client, Job, clients, install
from tests.support.mounts import wait_until
from tests.support.vehicles import HOST, Process, free_udp_port

READY_TIMEOUT = 90.0

CELLS = (
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
"""Server and link."""


def cells() -> Iterator[Cell]:
    """Yield cells with sizes and a time-out that keep a run within bounds."""
    for server, link in CELLS:
        shape, slow = LINKS[link], server == "ardupilot"
        if shape is None:
            size, peers_size, timeout = (200_000, 200_000, 10.0) if slow else (8_000_000, 800_000, 10.0)
        elif shape.rate < 10_000:
            size, peers_size, timeout = 60_000, 60_000, 45.0
        else:
            size = peers_size = 100_000 if slow else 2_500_000
            timeout = 12.0
        directions: tuple[Direction, ...] = ("read", "write")
        for direction in directions:
            yield Cell(server, link, direction, size, peers_size, timeout)


def server_argv(cell: Cell, root: Path, port: int, seed: int) -> list[str]:
    """Return the command line of a vehicle that serves `root` to the client on `port`."""
    if cell.server == REAL_MAVSDK:
        return [sys.executable, "-m", "tests.support.mavsdk_server", str(root), f"udpout://{HOST}:{port}"]
    base = [sys.executable, "-m", "mavftpfs", "sim", str(root), "--profile", cell.server]
    base += ["--link", f"udpout:{HOST}:{port}"]
    if cell.shape is None:
        return base
    link = {"rate": cell.shape.rate, "delay": cell.shape.rtt / 2, "loss": cell.shape.loss}
    link |= {"queue": cell.shape.queue, "seed": seed}
    return [*base, *(word for name, value in link.items() for word in (f"--{name}", f"{value:g}"))]


def run_one(cell: Cell, client: Client, source: Path, seed: int) -> Run:
    """Let one client move the file once."""
    what = (cell.server, cell.link, cell.direction, client.name, source.stat().st_size)
    with TemporaryDirectory(prefix="mavftpfs-bench-") as name:
        folder = Path(name)
        card, here = folder / "card/bench", folder / "here"
        card.mkdir(parents=True)
        here.mkdir()
        reading = cell.direction == "read"
        shutil.copyfile(source, (card if reading else here) / "file.bin")
        port, local = free_udp_port(), here / "file.bin"
        job = Job(cell, port, local, folder)
        server = Process("server", server_argv(cell, folder / "card", port, seed), folder)
        try:
            wait_until("server ready", lambda: bool(server.output.read_bytes()), READY_TIMEOUT)
            measured = client.run(job)
        finally:
            with suppress(AssertionError):  # it was killed for not ending: what a peer may do to a server
                server.stop()
        arrived = (here if reading else card) / "file.bin"
        if measured.outcome is Outcome.OK and not (
            arrived.is_file() and filecmp.cmp(source, arrived, shallow=False)
        ):
            measured = Measured(Outcome.CORRUPT, detail="other bytes arrived")
        detail = measured.detail.replace(f"{folder}/", "")
    return Run(*what, replace(measured, detail=detail))


def measure(chosen: Sequence[Cell], everybody: Sequence[Client], repetitions: int, folder: Path) -> list[Run]:
    """Run every cell, all clients in turns; a client that fails in one is not asked there again."""
    runs: list[Run] = []
    for cell in chosen:
        left = [client for client in everybody if cell.direction in client.directions]
        for repetition in range(repetitions):
            for client in list(left):
                run = run_one(cell, client, _source(cell, client, folder), repetition + 1)
                runs.append(run)
                if run.outcome is not Outcome.OK:
                    left.remove(client)
                took, why = run.measured.seconds, run.measured.detail
                rate = f"{run.size / took / 1000:,.1f} kB/s" if took else why
                where = f"{run.server} {run.link} {run.direction}"
                print(f"{where}: {run.client}: {run.outcome} {rate}", file=sys.stderr)
    return runs


def _source(cell: Cell, client: Client, folder: Path) -> Path:
    size = cell.size if client.name in (US, BARE) else cell.peers_size
    path = folder / f"{size}.bin"
    if not path.exists():
        path.write_bytes(random.Random(size).randbytes(size))
    return path


def main(argv: Sequence[str]) -> int:
    """Measure, print, and write the JSON file."""
    parser = argparse.ArgumentParser(prog="scripts/bench mount", description="a real mount beside the peers")
    everybody = clients()
    parser.add_argument("--clients", nargs="+", choices=everybody, default=list(everybody))
    parser.add_argument("--repetitions", type=int, default=1, help="of each run, interleaved")
    parser.add_argument("--json", type=Path, help="put the rows into this file")
    args = parser.parse_args(argv)
    if {*args.clients} - {US, BARE}:
        install()
    chosen = list(cells())
    load = os.getloadavg()[0]
    if load > tables.BUSY * (os.cpu_count() or 1):
        print(f"load {load:.1f} before we began: rates will be too low", file=sys.stderr)
    with TemporaryDirectory(prefix="mavftpfs-bench-") as name:
        os.environ["XDG_STATE_HOME"] = name  # what a mount cannot deliver is not kept for the user
        runs = measure(chosen, [everybody[one] for one in args.clients], args.repetitions, Path(name))
    rows = summarise(runs, {cell.link: cell.timeout for cell in chosen})
    print(tables.peers_table(rows), tables.cost_table(rows, "px4", "unshaped"), sep="\n\n")
    if args.json is not None:
        record.put(args.json, "mount", argv, load, {"peers": list(PINS), "rows": list(map(as_json, rows))})
    return 0
