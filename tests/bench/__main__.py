"""All measurements: scripts/bench PART [options of the part; --help tells them].

goodput   share of a link's limit, reading and writing, on virtual time (the same figures on every machine)
mount     a real mount beside the clients that people use now, over real sockets
plots     the picture and the tables of docs/benchmarks.md, from what `--json FILE` of the others wrote
"""

from __future__ import annotations

import sys
from importlib import import_module

PARTS = ("goodput", "mount", "plots")


def main(argv: list[str]) -> int:
    """Run the part that is asked for."""
    if not argv or argv[0] not in PARTS:
        print(__doc__, file=sys.stderr)
        return 1
    code: int = import_module(f"tests.bench.{argv[0]}").main(argv[1:])
    return code


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
