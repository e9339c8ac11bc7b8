"""`cache_dir=`: what one mount read, the next one of the same vehicle does not read again."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path

import pytest

from mavftpfs.cache.versions import BLOCK_SIZE
from tests.mount.conftest import Field
from tests.support.mounts import Mount, wait_until
from tests.support.requests import CountedVehicle, Counting
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


def read_and_keep(field: Field, vehicle: CountedVehicle, logs: Path, cache: Path) -> None:
    """Read all in a mount of its own, which ends when everything lies on the disk."""
    mount = field.mount(vehicle.source, f"cache_dir={cache}")
    read_all(mount, logs)
    blocks = sum(-(-size // BLOCK_SIZE) for size in FILES.values())
    counting = Counting(vehicle, mount)
    # What was read gets to the disk when it was beyond suspicion for 12 s.
    wait_until("all is kept", lambda: counting.status()["cache"]["blocks_to_disk"] == blocks)
    assert mount.unmount() == 0


def check_cost(field: Field, vehicle: CountedVehicle, logs: Path, cache: Path, **expected: int) -> Mount:
    """Compare all files with the card in a new mount; return it. expected: how many files it has to open for
    that, and so on; more only where it repeated requests, because the machine was too busy to answer."""
    mount = field.mount(vehicle.source, f"cache_dir={cache}")
    Counting(vehicle, mount).settle()  # it looks once whether there are parameters
    mark = vehicle.asked()
    read_all(mount, logs)
    counts = vehicle.cost_since(mark).counts
    asked = Counter({name: counts[name] for name in ("open", "read", "burst", "crc") if counts[name]})
    assert asked >= Counter(expected), asked
    assert (asked - Counter(expected)).total() <= mount.status()["link"]["retransmissions"], asked
    return mount


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
    check_cost(field, vehicle, logs, cache, crc=len(FILES))


@pytest.mark.parametrize("profile", taking_turns(["ardupilot5", "mavsdk"]))
def test_yesterdays_logs_are_not_read_again(field: Field, profile: str) -> None:
    card, cache = field.local("card"), field.local("cache")
    logs = fill(card)
    vehicle = field.counted_sim(card, profile)
    read_and_keep(field, vehicle, logs, cache)
    mount = check_cost(field, vehicle, logs, cache)
    (logs / "00000003.BIN").write_bytes(content("new", 1000))
    mount.unmount()
    check_cost(field, vehicle, logs, cache, open=1, read=5)
