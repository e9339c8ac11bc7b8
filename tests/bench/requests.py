"""What commands cost in FTP requests, on real mounts: python -m tests.bench.requests [--json FILE].

The same cases as tests/mount/test_requests.py, which holds the exact numbers; here they are shown.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.support.mounts import Mount
from tests.support.request_cases import CASES
from tests.support.requests import OPTIONS, Case, Cost, CountedVehicle, Counting, prepare
from tests.support.vehicles import SimVehicle

PROFILES = ("px4", "px4-nuttx", "ardupilot", "ardupilot5", "mavsdk")
MOUNT = "mount"


def counted(profile: str, cases: tuple[Case, ...], folder: Path) -> dict[str, Cost]:
    """Mount a vehicle of this profile and return what mounting and each case cost."""
    root, here = folder / "card", folder / "mnt"
    for path in (root, here):
        path.mkdir()
    prepare(root, profile, cases)
    vehicle: SimVehicle = CountedVehicle(root, folder, profile)
    assert isinstance(vehicle, CountedVehicle)
    with ExitStack() as stack:
        stack.callback(vehicle.finish)
        vehicle.start()
        mount = Mount(vehicle.source, here, folder, OPTIONS)
        stack.callback(mount.finish)
        counting = Counting(vehicle, mount)
        costs = {MOUNT: counting.start()}
        for case in cases:
            costs[case.name] = counting.run(case)
    return costs


def show(results: dict[str, dict[str, Cost]], *, requests: bool) -> None:
    """Print a table of cases by profile."""
    table = Table("command", *results, title="MAVLink FTP requests, without keep-alives")
    for name in next(iter(results.values())):
        table.add_row(name, *(costs[name].text() for costs in results.values()))
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(table)
    if requests:
        for profile, costs in results.items():
            for name, cost in costs.items():
                console.print(f"[bold]{profile}: {name}[/]", *cost.requests, sep="\n    ", highlight=False)


def main() -> int:
    """Count and show."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the counts there, too")
    parser.add_argument("--profile", action="append", choices=PROFILES, help="only these servers")
    parser.add_argument("--case", action="append", metavar="NAME", help="only commands with this in the name")
    parser.add_argument("--requests", action="store_true", help="show each request")
    args = parser.parse_args()
    wanted = args.case or [""]
    cases = tuple(case for case in CASES if any(word in case.name for word in wanted))
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder
        for profile in args.profile or PROFILES:
            place = Path(folder) / profile
            place.mkdir()
            results[profile] = counted(profile, cases, place)
    show(results, requests=args.requests)
    if args.json is not None:
        plain = {
            profile: {
                name: {"requests": dict(cost.counts), "payload": cost.payload, "seconds": cost.seconds}
                for name, cost in costs.items()
            }
            for profile, costs in results.items()
        }
        args.json.write_text(json.dumps(plain, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
