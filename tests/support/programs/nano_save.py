"""Open a file in nano on a terminal of its own, type a word, save, leave: nano_save.py FILE [LINE,COLUMN
WORD]
"""

from __future__ import annotations

import os
import pty
import select
import sys
import time

PATIENCE = 60.0


def read_until(terminal: int, words: bytes) -> None:
    """Read what the program shows until `words` were among it."""
    deadline, seen = time.monotonic() + PATIENCE, b""
    while words not in seen:
        if time.monotonic() > deadline or not select.select([terminal], [], [], PATIENCE)[0]:
            raise SystemExit(f"nano does not say {words!r}: {seen!r}")
        seen += os.read(terminal, 65536)


def main() -> None:
    """Play the user."""
    place, word = ([f"+{sys.argv[2]}"], sys.argv[3]) if len(sys.argv) > 2 else ([], "word ")
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "xterm"
        os.execvp("nano", ["nano", "--ignorercfiles", *place, sys.argv[1]])
    read_until(terminal, b"Exit")
    os.write(terminal, word.encode() + b"\x0f")
    read_until(terminal, b"Write")
    os.write(terminal, b"\r")
    read_until(terminal, b"Wrote")
    os.write(terminal, b"\x18")
    raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))


main()
