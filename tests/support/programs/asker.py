"""Asks for names that are not there, on four threads, as fast as it can, until it is killed; says so."""

from __future__ import annotations

import os
import threading
from itertools import count


def ask(number: int) -> None:
    """Look up one name after the other in the working directory."""
    for time in count():
        os.path.exists(f"{os.getpid()}-{number}-{time}")


def main() -> None:
    """Run them."""
    for number in range(4):
        threading.Thread(target=ask, args=(number,)).start()
    print("asking", flush=True)


if __name__ == "__main__":
    main()
