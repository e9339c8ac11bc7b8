"""A card that is full: an error, nothing lost that was there, nothing left behind.

The card is a small tmpfs below the simulated server or the MAVSDK library's.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.places import REAL
from tests.support.trees import content

CAPACITY = 120_000
OLD = content("old", 45_000)
NEW = content("new", 60_000)
TOO_LARGE = content("too large", 105_000)
FULL = {"px4": "No space left on device", REAL: "Input/output error"}
"""The errno that programs get: MAVSDK has but one word for all failures."""


@pytest.fixture
def root(field: Field) -> Iterator[Path]:
    """A directory with little room."""
    path = field.local("card")
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={CAPACITY}", "card", path], check=True, timeout=20)
    yield path
    subprocess.run(["umount", "-l", path], check=True, timeout=20)


def names(folder: Path) -> list[str]:
    """Return everything in a folder, hidden names too."""
    return sorted(os.listdir(folder))


@pytest.mark.needs("root")
@pytest.mark.holds("fault full card")
@pytest.mark.parametrize("kind", FULL)
def test_what_does_not_fit_costs_nothing_that_was_there(
    root: Path, field: Field, kind: str, tmp_path: Path
) -> None:
    (root / "old.bin").write_bytes(OLD)
    mount = field.mount((field.mavsdk(root) if kind == REAL else field.sim(root, kind)).source)
    source = tmp_path / "source.bin"
    source.write_bytes(TOO_LARGE)
    result = mount.run("cp", source, mount.path / "old.bin", code=None)
    assert result.returncode == 1
    assert FULL[kind] in result.stderr, result.stderr
    assert (root / "old.bin").read_bytes() == OLD
    again = mount.run("cp", source, mount.path / "other.bin", code=None)
    assert (again.returncode, FULL[kind] in again.stderr) == (1, True)
    assert (root / "old.bin").read_bytes() == OLD

    mount.run("rm", mount.path / "other.bin")  # what was accepted is held until its name goes
    source.write_bytes(NEW)
    mount.run("cp", source, mount.path / "old.bin")  # holds what fits beside the old file
    assert (root / "old.bin").read_bytes() == NEW
    mount.run("ls", "-A", mount.path)
    wait_until("nothing is left behind", lambda: names(root) == ["old.bin"])
    assert mount.read_bytes(mount.path / "old.bin") == NEW
