"""Reading by the library beside `cp` from a mount: scripts/bench library [--size MB] [--runs N].

In turns, each against a freshly started simulated PX4 on the loopback, from open to close; the bytes are
compared. Python's file is read in pieces of 1 MiB, as shutil.copyfileobj does.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import mavftpfs
from tests.support.vehicles import SimVehicle

PIECE = 1 << 20


def by_library(source: str, local: Path, folder: Path) -> float:
    """Return the seconds that a program needs that opens and copies the file."""
    with mavftpfs.connect(source) as drone:
        began = time.monotonic()
        with drone.open("/file", "rb") as file, local.open("wb") as out:
            shutil.copyfileobj(file, out, PIECE)
        return time.monotonic() - began


def by_mount(source: str, local: Path, folder: Path) -> float:
    """Return the seconds that `cp` needs."""
    mountpoint = folder / "mnt"
    mountpoint.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "mavftpfs"]
    subprocess.run([*command, source, mountpoint], check=True)
    try:
        began = time.monotonic()
        subprocess.run(["cp", mountpoint / "file", local], check=True)
        return time.monotonic() - began
    finally:
        subprocess.run([*command, "umount", mountpoint], check=True)


def measured(way: Callable[[str, Path, Path], float], data: bytes) -> float:
    """Return the rate in MB/s of one run."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        card, local = folder / "card", folder / "copy"
        card.mkdir()
        (card / "file").write_bytes(data)
        vehicle = SimVehicle(card, folder, "px4")
        vehicle.start()
        try:
            took = way(vehicle.source, local, folder)
        finally:
            vehicle.finish()
        assert local.read_bytes() == data, "other bytes came"
        return len(data) / took / 1e6


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser("scripts/bench library", description=__doc__)
    parser.add_argument("--size", type=int, default=50, help="MB")
    parser.add_argument("--runs", type=int, default=5)
    args = parser.parse_args(argv)
    data = os.urandom(args.size * 1_000_000)
    rates: dict[str, list[float]] = {"cp from a mount": [], "mavftpfs.connect": []}
    for _ in range(args.runs):
        rates["cp from a mount"].append(measured(by_mount, data))
        rates["mavftpfs.connect"].append(measured(by_library, data))
    for who, found in rates.items():
        print(f"{who:<17} {median(found):6.1f} MB/s   ({', '.join(f'{rate:.1f}' for rate in found)})")
    for what, of in (("medians", median), ("best runs", max)):  # on a busy machine the best say more
        share = of(rates["mavftpfs.connect"]) / of(rates["cp from a mount"])
        print(f"library / mount   {share:6.2f}   ({what})")
    return 0
