"""The bench beside the peers, with short files: our mount, the bare loop, and made-up peers that misbehave.

The real peers are not run in tests: they are others' programs, and have to be downloaded.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.bench.figures import BARE, US, Cell, Outcome, summarise
from tests.bench.mount import measure
from tests.bench.peers import Client, clients

SIZE = 60_000
EVERYBODY = clients()


def test_our_mount_and_the_bare_loop_are_measured_in_turns(tmp_path: Path) -> None:
    cell = Cell("px4", "wifi-5%", "write", SIZE, SIZE, 30.0)
    runs = measure([cell], [EVERYBODY[BARE], EVERYBODY[US]], 1, tmp_path)
    assert [(run.client, run.outcome) for run in runs] == [(BARE, Outcome.OK), (US, Outcome.OK)], runs
    for row in summarise(runs, {"wifi-5%": 30.0}):
        assert row.rate is not None
        assert 0 < row.rate < 625_000, "faster than the link"
        assert row.cpu is not None
        assert row.cpu > 0
        assert row.memory is not None
        assert 5e6 < row.memory < 200e6


PROGRAMS = {
    "lies": ("print(1.0, 1.0, 1000)", Outcome.CORRUPT, "other bytes arrived"),
    "hangs": ("import signal, time; signal.alarm(1); time.sleep(60)", Outcome.TIMEOUT, ""),
    "fails": ("raise SystemExit('no space')", Outcome.FAILED, "no space"),
    "does not mount": ("raise SystemExit('no FUSE')", Outcome.FAILED, "no FUSE"),
}


def test_who_lies_hangs_or_fails_is_listed_as_that(tmp_path: Path) -> None:
    def program(name: str, text: str) -> Client:
        return Client(name, lambda job, point: [sys.executable, "-c", text], mounts="mount" in name)

    cell = Cell("px4", "unshaped", "write", SIZE, SIZE, 30.0)
    peers = [program(name, text) for name, (text, _, _) in PROGRAMS.items()]
    found = {run.client: (run.outcome, run.measured.detail) for run in measure([cell], peers, 1, tmp_path)}
    assert found == {name: (outcome, told) for name, (_, outcome, told) in PROGRAMS.items()}
