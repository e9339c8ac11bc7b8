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
from tests.support.mounts import Mount, wait_until
from tests.support.places import FOLDERS, OPTIONS, REAL
from tests.support.trees import content
from tests.support.vehicles import UdpVehicle

CAPACITY = 120_000
OLD = content("old", 45_000)
NEW = content("new", 60_000)
TOO_LARGE = content("too large", 105_000)
FULL = ("No space left on device", "Input/output error")
PLAIN_WORDS = ("px4", "px4-nuttx", "ardupilot")
"""Servers that say what it is; FatFs below ArduPilot and MAVSDK have but one word for all failures."""

IN_SOAK = ("ardupilot", "ardupilot5", "px4-nuttx", "mavsdk")
KINDS = [
    pytest.param(kind, marks=pytest.mark.soak if kind in IN_SOAK else ()) for kind in ("px4", REAL, *IN_SOAK)
]


@pytest.fixture
def root(field: Field) -> Iterator[Path]:
    """A directory with little room."""
    path = field.local("card")
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={CAPACITY}", "card", path], check=True, timeout=20)
    yield path
    subprocess.run(["umount", "-l", path], check=True, timeout=20)


def mounted(field: Field, kind: str, root: Path, name: str) -> tuple[Mount, Path, Path]:
    """Put a file there; return a mount, the folder as it shows it and as it lies on the card."""
    card = root / FOLDERS[kind]
    card.mkdir(parents=True, exist_ok=True)
    (card / name).write_bytes(OLD)
    vehicle: UdpVehicle = field.mavsdk(root) if kind == REAL else field.sim(root, kind)
    mount = field.mount(vehicle.source, *OPTIONS.get(kind, ()))
    return mount, mount.path / FOLDERS[kind], card


def names(folder: Path) -> list[str]:
    """Return everything in a folder, hidden names too."""
    return sorted(os.listdir(folder))


@pytest.mark.holds("fault full card")
@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_fit_costs_nothing_that_was_there(
    root: Path, field: Field, kind: str, tmp_path: Path
) -> None:
    mount, shown, card = mounted(field, kind, root, "old.bin")
    source = tmp_path / "source.bin"
    source.write_bytes(TOO_LARGE)
    result = mount.run("cp", source, shown / "old.bin", code=None)
    assert result.returncode == 1
    assert FULL[kind not in PLAIN_WORDS] in result.stderr, result.stderr
    assert (card / "old.bin").read_bytes() == OLD
    again = mount.run("cp", source, shown / "other.bin", code=None)
    assert (again.returncode, FULL[kind not in PLAIN_WORDS] in again.stderr) == (1, True)
    assert (card / "old.bin").read_bytes() == OLD

    mount.run("rm", shown / "other.bin")  # what was accepted is held until its name goes
    source.write_bytes(NEW)
    mount.run("cp", source, shown / "old.bin")  # holds what fits beside the old file
    assert (card / "old.bin").read_bytes() == NEW
    mount.run("ls", "-A", shown)
    wait_until("nothing is left behind", lambda: names(card) == ["old.bin"])
    assert mount.read_bytes(shown / "old.bin") == NEW
