"""The bench beside the peers, with short files: our mount, the bare loop, and made-up peers that misbehave.

The real peers are not run in tests: they are others' programs, and have to be downloaded.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

from tests.bench.figures import BARE, US, Outcome, Run, summarise
from tests.bench.mount import Cell, measure, run_one
from tests.bench.peers import Client, clients

SIZE = 60_000
EVERYBODY = clients()


def moved(client: Client, tmp_path: Path, link: str = "unshaped", timeout: float = 30.0) -> Run:
    """Let a client write a short file to PX4."""
    source = tmp_path / "source.bin"
    source.write_bytes(random.Random(1).randbytes(SIZE))
    return run_one(Cell("px4", link, "write", SIZE, SIZE, timeout), client, source, 1)


def program(text: str) -> Client:
    """Return a peer that is a few lines of Python."""
    return Client("peer", lambda job, point: [sys.executable, "-c", text])


def test_our_mount_and_the_bare_loop_are_measured_in_turns(tmp_path: Path) -> None:
    cell = Cell("px4", "unshaped", "write", 300_000, SIZE, 30.0)
    runs = measure([cell], [EVERYBODY[BARE], EVERYBODY[US]], 1, tmp_path)
    assert [(run.client, run.outcome) for run in runs] == [(BARE, Outcome.OK), (US, Outcome.OK)], runs
    for row in summarise(runs, {"unshaped": 30.0}):
        assert row.rate is not None
        assert row.rate > 0
        assert row.cpu is not None
        assert row.cpu > 0
        assert row.memory is not None
        assert 5e6 < row.memory < 200e6


def test_a_lossy_link_stands_between_server_and_client(tmp_path: Path) -> None:
    run = moved(EVERYBODY[BARE], tmp_path, "wifi-5%")
    assert run.outcome is Outcome.OK, run
    assert run.measured.seconds is not None
    assert run.measured.seconds > SIZE / 625_000, "faster than the link"  # holds however slow the machine is


FAILING = {
    "print('noise\\nready', flush=True); input(); print('done', flush=True); input()": (
        Outcome.CORRUPT,
        "other bytes arrived",
    ),
    "import time; print('ready', flush=True); time.sleep(60)": (Outcome.TIMEOUT, ""),
    "print('ready', flush=True); input(); print('failed NO SPACE', flush=True)": (Outcome.FAILED, "NO SPACE"),
    "print('ready', flush=True); input(); raise OSError('broken')": (Outcome.FAILED, "OSError: broken"),
    "print('failed no autopilot', flush=True)": (Outcome.FAILED, "failed no autopilot"),
}


def test_who_lies_hangs_or_fails_is_listed_as_that(tmp_path: Path) -> None:
    for text, told in FAILING.items():
        run = moved(program(text), tmp_path, timeout=2.0)
        assert (run.outcome, run.measured.detail) == told
    dead = Client(
        "dead", lambda job, point: [sys.executable, "-c", "raise SystemExit('no FUSE')"], mounts=True
    )
    run = moved(dead, tmp_path)
    assert (run.outcome, run.measured.detail) == (Outcome.FAILED, "no FUSE")
