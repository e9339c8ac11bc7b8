"""All measurements: scripts/bench PART [options of the part; --help tells them].

goodput   share of a link's limit, reading and writing, on virtual time (the same figures on every machine)
mount     a real mount beside the clients that people use now, over real sockets
library   reading by mavftpfs.connect beside `cp` from a mount, over real sockets
parameters  how long 2,000 parameters take to be parsed, shown, read and packed
plots     draw what docs/benchmarks.md shows, from the file that `--json FILE` of the others writes
"""

from __future__ import annotations

import sys
from importlib import import_module

PARTS = ("goodput", "library", "mount", "parameters", "plots")


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
