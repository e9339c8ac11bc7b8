"""`cache_dir=`: what one mount read, the next one of the same vehicle does not read again.

What is kept and believed: tests/unit/test_kept.py.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.requests import Counting
from tests.support.takingturns import taking_turns
from tests.support.trees import content

YESTERDAY = 86_400
FILES = {"00000001.BIN": 300_000, "00000002.BIN": 65_536, "LASTLOG.TXT": 3}


def fill(card: Path) -> Path:
    """Put yesterday's logs on a card."""
    logs = card / "logs"
    logs.mkdir()
    for name, size in FILES.items():
        (logs / name).write_bytes(content(name, size))
        os.utime(logs / name, (time.time() - YESTERDAY,) * 2)
    return logs


def read_all(mount: Mount, logs: Path) -> None:
    """Compare all files with the card."""
    mount.run("diff", "-r", logs, mount.path / "logs")


@pytest.mark.parametrize("profile", taking_turns(["px4", "ardupilot5", "mavsdk"]))
def test_a_copy_an_unmount_a_mount_and_a_copy_cost_one_copy_and_the_checksums(
    field: Field, profile: str
) -> None:
    card, cache = field.local("card"), field.local("cache")
    logs = fill(card)
    vehicle = field.counted_sim(card, profile)
    mount = field.mount(vehicle.source, f"cache_dir={cache}")
    read_all(mount, logs)
    assert mount.unmount() == 0
    mount = field.mount(vehicle.source, f"cache_dir={cache}")
    Counting(vehicle, mount).settle()  # it looks once whether there are parameters
    mark = vehicle.asked()
    read_all(mount, logs)
    counts = vehicle.cost_since(mark).counts
    asked = Counter({name: counts[name] for name in ("open", "read", "burst", "crc") if counts[name]})
    repeated = asked - Counter(crc=len(FILES))  # because the machine was too busy to answer
    assert asked["crc"] >= len(FILES)
    assert repeated.total() <= mount.status()["link"]["retransmissions"], asked
