"""How long 2,000 parameters take to be parsed, shown, read from a text, compared and packed: scripts/bench
parameters.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable

from mavftpfs.parameters.packed import HEADER, MAGIC, pack_upload, unpack
from mavftpfs.parameters.saving import make_plan
from mavftpfs.parameters.text import parse, render_all, render_qgc
from mavftpfs.parameters.values import Kind, Parameter, nearest_float


def sample(count: int) -> list[Parameter]:
    """Return parameters like those of a vehicle: half integers, half floats of few or of many digits."""
    rng = random.Random(1)
    made = []
    for i in range(count):
        name = f"GROUP{i // 20}_{i % 20:02}"
        if i % 2:
            value = rng.choice([rng.random() * 10, 1500.0, 0.135, rng.gauss(0, 1e-5)])
            made.append(Parameter(name, Kind.FLOAT, nearest_float(value)))
        else:
            made.append(Parameter(name, Kind.INT16, i))
    return made


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs."""
    best = float("inf")
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - began)
    return best * 1e3


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="scripts/bench parameters", description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args(argv)
    parameters = sample(args.count)
    packed = b"".join(pack_upload(parameters))
    download = HEADER.pack(MAGIC, args.count, args.count) + packed[HEADER.size :]
    text = render_all(parameters)
    lines, values = parse(text)[0], {one.name: one for one in parameters}
    parts: dict[str, Callable[[], object]] = {
        "parse the packed file": lambda: unpack(download),
        "show it as NAME,VALUE": lambda: render_all(parameters),
        "show it as QGroundControl does": lambda: render_qgc(parameters, 1, 1),
        "read a text": lambda: parse(text),
        "compare a text": lambda: make_plan(lines, None, values, meant=False),
        "pack an upload": lambda: pack_upload(parameters),
    }
    for name, work in parts.items():
        print(f"{name:<32}{milliseconds(work, args.repeats):6.1f} ms")
    return 0
