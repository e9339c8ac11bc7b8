"""The bench beside the peers, with short files: our mount, the bare loop, and made-up peers that misbehave.

The real peers are not run in tests: they are others' programs, and have to be downloaded.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from rich.console import Console

from tests.bench.figures import BARE, US, Outcome, Run, summarise
from tests.bench.mount import Bench, Cell, run_one
from tests.bench.peers import Client, Environment, Job, MountClient, Worker, clients

SIZE = 60_000
EVERYBODY = clients(Environment(pins=()))


def source(tmp_path: Path) -> Path:
    """Return a file to move."""
    path = tmp_path / "source.bin"
    path.write_bytes(random.Random(1).randbytes(SIZE))
    return path


def moved(client: Client, tmp_path: Path, link: str = "unshaped", timeout: float = 30.0) -> Run:
    """Let a client write a short file to PX4."""
    return run_one(Cell("px4", link, "write", SIZE, SIZE, timeout), client, source(tmp_path), 1)


def program(text: str) -> Worker:
    """Return a peer that is a few lines of Python; {remote} and {local} are filled in."""

    def argv(job: Job) -> list[str]:
        return [sys.executable, "-c", text, job.remote, str(job.local)]

    return Worker("peer", argv)


def test_our_mount_and_the_bare_loop_are_measured_in_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.bench.mount.SPEND", 1000.0)  # a slow machine has all repetitions, too
    bench = Bench([EVERYBODY[BARE], EVERYBODY[US]], 1, tmp_path, Console(quiet=True))
    runs = bench.run([Cell("px4", "unshaped", "write", 300_000, SIZE, 30.0)])
    assert [run.client for run in runs] == [BARE, US]
    assert {run.outcome for run in runs} == {Outcome.OK}, runs
    for row in summarise(runs, {"unshaped": 30.0}):
        assert row.good == row.runs == 1
        assert row.rate is not None
        assert row.rate > 0
        assert row.cpu is not None
        assert row.cpu > 0
        assert row.memory is not None
        assert 5e6 < row.memory < 200e6


def test_a_lossy_link_stands_between_server_and_client(tmp_path: Path) -> None:
    cell = Cell("px4", "wifi-5%", "read", SIZE, SIZE, 30.0)
    run = run_one(cell, EVERYBODY[BARE], source(tmp_path), 1)
    assert run.outcome is Outcome.OK, run
    assert run.seconds is not None
    assert run.seconds > SIZE / 625_000, "faster than the link"  # holds however slow the machine is


def test_who_only_claims_to_have_moved_it_is_found_out(tmp_path: Path) -> None:
    liar = program("print('some noise\\nready', flush=True); input(); print('done', flush=True); input()")
    assert moved(liar, tmp_path).outcome is Outcome.CORRUPT


def test_who_hangs_is_cut_off(tmp_path: Path) -> None:
    sleeper = program("import time; print('ready', flush=True); time.sleep(60)")
    assert moved(sleeper, tmp_path, timeout=0.2).outcome is Outcome.TIMEOUT


def test_who_fails_is_quoted(tmp_path: Path) -> None:
    refused = program("print('ready', flush=True); input(); print('failed NO SPACE', flush=True)")
    crashed = program("print('ready', flush=True); input(); raise OSError('broken')")
    unconnected = program("print('failed no autopilot found', flush=True)")
    assert (moved(refused, tmp_path).outcome, moved(refused, tmp_path).detail) == (Outcome.FAILED, "NO SPACE")
    assert (moved(crashed, tmp_path).outcome, moved(crashed, tmp_path).detail) == (
        Outcome.FAILED,
        "OSError: broken",
    )
    assert moved(unconnected, tmp_path).outcome is Outcome.FAILED


def test_a_mount_that_does_not_come_is_a_failure(tmp_path: Path) -> None:
    dead = MountClient("dead", lambda job, point: [sys.executable, "-c", "raise SystemExit('no FUSE here')"])
    run = moved(dead, tmp_path)
    assert (run.outcome, run.detail) == (Outcome.FAILED, "no FUSE here")
