"""All measurements: scripts/bench [PART] [--quick] [--json FILE] [--date DATE] [options of the part].

goodput   share of a link's limit, reading and writing, on virtual time (the same figures on every machine)
cost      CPU time and memory of the hot path
mount     a real mount beside the clients that people use now, over real sockets
plots     draw what docs/benchmarks.md shows from the file of --json
all       everything, in this order; the default

Options that are not named here go to the part: scripts/bench PART --help. With --json, each part replaces its
own section of the file and leaves the others as they are.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench import tables
from tests.bench.record import Record

MEASURED = ("goodput", "cost", "mount")
TIMED = ("cost", "mount")
"""Parts that use the machine's clock."""

INTERRUPTED = 130
CLEANING_UP = 120.0
PARTS = (*MEASURED, "plots", "all")

QUICK: dict[str, tuple[str, ...]] = {
    "goodput": ("--seconds", "10", "--profiles", "px4", "ardupilot", "mavsdk", "--rates", "100000"),
    "cost": ("--size", "8", "--servers", "px4"),
    "mount": ("--quick",),
}
"""What --quick means to a part; options given by the user come later and win."""


def split(argv: Sequence[str]) -> tuple[str, list[str]]:
    """Return the part and the other arguments."""
    if argv and argv[0] in PARTS:
        return argv[0], list(argv[1:])
    return "all", list(argv)


def run_part(part: str, quick: bool, record: Record | None, date: str, rest: Sequence[str]) -> int:
    """Measure one part in a process of its own, note its section, and return its exit code."""
    load = os.getloadavg()[0]
    if part in TIMED and load > tables.BUSY * (os.cpu_count() or 1):
        print(f"scripts/bench: load {load:.1f} before we began: rates will be too low", file=sys.stderr)
    options = [*(QUICK.get(part, ()) if quick else ()), *rest]
    with TemporaryDirectory(prefix="mavftpfs-bench-") as folder:
        found = Path(folder) / "section.json"
        note = [] if record is None else ["--json", str(found)]
        code = ended([sys.executable, "-m", f"tests.bench.{part}", *options, *note])
        if record is not None and found.exists():
            content = json.loads(found.read_text())
            command = " ".join(["scripts/bench", part, *(["--quick"] if quick else []), *rest])
            record.put(part, command, content, date, load)
    return code


def ended(command: Sequence[str]) -> int:
    """Run a command and return its exit code; an interrupt goes to the child too, which cleans up first."""
    child = subprocess.Popen(command)
    try:
        return child.wait()
    except KeyboardInterrupt:
        child.wait(CLEANING_UP)  # subprocess.run would kill it after a quarter of a second
        raise


def main(argv: Sequence[str]) -> int:
    """Run the parts asked for; 1 if one of them failed."""
    part, others = split(argv)
    if part == "plots":
        from tests.bench import plots  # only here: matplotlib is large

        return plots.main(others)
    parser = argparse.ArgumentParser(
        prog="scripts/bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=part == "all",
        allow_abbrev=False,
    )
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="put the results into this file")
    parser.add_argument("--date", default="", help="what to note as the date of the measurement")
    known, rest = parser.parse_known_args(others)
    if part == "all" and rest:
        parser.error(f"{' '.join(rest)}: name the part that this is for ({', '.join(MEASURED)})")
    record = None if known.json is None else Record(known.json)
    parts = MEASURED if part == "all" else (part,)
    try:
        codes = [run_part(name, known.quick, record, known.date, rest) for name in parts]
    except KeyboardInterrupt:
        return INTERRUPTED
    if part == "all" and known.json is not None:
        from tests.bench import plots

        codes.append(plots.main(["--json", str(known.json)]))
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
