"""What commands cost in FTP requests, on real mounts: python -m tests.bench.requests [--json FILE].

The same cases as tests/mount/test_requests.py, which holds the exact numbers; here they are shown. If the
machine was so busy that some were asked for again, nothing is written: that is not what a command costs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.support.mounts import Mount
from tests.support.request_cases import CASES, FIRST
from tests.support.request_costs import MOUNT, PROFILES
from tests.support.requests import OPTIONS, Case, Cost, CountedVehicle, Counting, prepare

ROUNDS = 10


def counted(profile: str, cases: tuple[Case, ...], folder: Path) -> dict[str, Cost]:
    """Mount a vehicle of this profile and return what mounting and each case cost."""
    root, here = folder / "card", folder / "mnt"
    for path in (root, here):
        path.mkdir()
    prepare(root, profile, cases)
    with ExitStack() as stack:
        vehicle = stack.enter_context(CountedVehicle(root, profile))
        mount = Mount(vehicle.source, here, folder, OPTIONS)
        stack.callback(mount.finish)
        counting = Counting(vehicle, mount)
        costs = {MOUNT: counting.start()}
        for case in cases:
            costs[case.name] = counting.run(case)
    return costs


def exactly(profile: str, cases: tuple[Case, ...], folder: Path) -> dict[str, Cost]:
    """Return the same, with new tries on new mounts where the machine was too busy."""
    costs: dict[str, Cost] = {}
    wanted = cases
    for number in range(ROUNDS):
        place = folder / f"{profile}-{number}"
        place.mkdir()
        found = counted(profile, wanted, place)
        costs = found | {name: cost for name, cost in costs.items() if is_exact(cost)}
        missing = tuple(case for case in cases if not is_exact(costs[case.name]))
        if not missing:
            break
        wanted = tuple(dict.fromkeys((FIRST, *missing)))  # others cost less once the server is known
    return {name: costs[name] for name in (MOUNT, *(case.name for case in cases))}


def show(results: dict[str, dict[str, Cost]], *, requests: bool) -> None:
    """Print a table of cases by profile."""
    table = Table("command", *results, title="MAVLink FTP requests, without keep-alives")
    for name in next(iter(results.values())):
        table.add_row(name, *(text_of(costs[name]) for costs in results.values()))
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(table)
    if requests:
        for profile, costs in results.items():
            for name, cost in costs.items():
                console.print(f"[bold]{profile}: {name}[/]", *cost.requests, sep="\n    ", highlight=False)


def text_of(cost: Cost) -> str:
    """Return one cell of the table."""
    return cost.text() if is_exact(cost) else f"{cost.text()} (asked again: {cost.repeats})"


def is_exact(cost: Cost) -> bool:
    """Whether that is what the command costs, and not what a busy machine made of it."""
    return not cost.repeats and not cost.late


def as_json(results: dict[str, dict[str, Cost]]) -> list[dict[str, Any]]:
    """Return the counts in order, and nothing that differs from run to run."""
    return [
        {"profile": profile, "command": name, "requests": dict(+cost.counts), "payload": cost.payload}
        for profile, costs in results.items()
        for name, cost in costs.items()
    ]


def main() -> int:
    """Count and show."""
    parser = argparse.ArgumentParser(prog="scripts/bench requests", description="requests per command")
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
            results[profile] = exactly(profile, cases, Path(folder))
    show(results, requests=args.requests)
    busy = [
        f"{server}: {name}"
        for server, of in results.items()
        for name, cost in of.items()
        if not is_exact(cost)
    ]
    if busy:
        print(f"scripts/bench requests: too busy to count, run it again: {', '.join(busy)}", file=sys.stderr)
        return 1
    if args.json is not None:
        args.json.write_text(json.dumps(as_json(results), indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
