"""Random system calls on a real mount, over bad links, compared with a local directory call by call.

What fails prints its seed and the last calls; `tests.support.programs.lockstep` runs it again.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.places import FOLDERS, NO_RENAME, REAL, start_place
from tests.support.trees import differing

LOCKSTEP = Path(__file__).parents[1] / "support" / "programs" / "lockstep.py"
FLAWS = ("--dup", "0.02", "--reorder", "0.02", "--corrupt", "0.005")
DELAY = ("--delay", "0.011")
"""One way. Frames are held back for less than a round trip: an older write would pass for a new one."""


def run_lockstep(field: Field, kind: str, loss: str, seed: int, count: int, limit: float) -> None:
    """Mount a vehicle with an empty card, make the calls, unmount, compare what is left."""
    flaws = ("--loss", loss) if kind == REAL else (*FLAWS, *DELAY, "--loss", loss)
    place = start_place(field, kind, (*flaws, "--seed", str(seed)))
    local = field.local("twin")
    mount = field.mount(place.vehicle.source, *place.options)
    where = [str(mount.path / place.folder), str(local), str(place.card)]
    argv = [sys.executable, str(LOCKSTEP), *where, "--seed", str(seed), "--count", str(count)]
    result = mount.run(*argv, timeout=limit, code=None)
    said = f"{kind}, seed {seed}\n{result.stdout}\n{result.stderr}\n{mount.alive().text()[-3000:]}"
    assert result.returncode == 0, said
    assert mount.unmount() == 0, mount.alive_or_ended().text()
    assert differing(local, place.card) == [], said


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("kind", ["px4-nuttx", "ardupilot", REAL])
def test_random_calls_do_what_a_local_disk_does(field: Field, kind: str) -> None:
    run_lockstep(field, kind, "0.001", seed=1, count=150, limit=120)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(101, 107))
@pytest.mark.parametrize("kind", sorted(set(FOLDERS) - set(NO_RENAME)))
def test_thousands_of_random_calls(field: Field, kind: str, seed: int) -> None:
    run_lockstep(field, kind, "0.01", seed, count=1500, limit=1200)
