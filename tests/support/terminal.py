"""The screen of a program on a terminal of a given size."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import shlex
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.support.vehicles import PROJECT

NANO = shlex.join([sys.executable, str(Path(__file__).parent / "programs" / "nano_save.py")])
"""Edits a file in nano, as a shell command: FILE [LINE,COLUMN WORD]."""

_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """A program on a pty of `columns` x `rows`, which all its standard streams are."""

    def __init__(self, argv: Sequence[str], columns: int, rows: int) -> None:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        environment = {**os.environ, "TERM": "xterm-256color", "LC_ALL": "C.UTF-8"}
        for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR"):
            environment.pop(name, None)
        self.child = subprocess.Popen(
            argv, stdin=theirs, stdout=theirs, stderr=theirs, cwd=PROJECT, env=environment
        )
        os.close(theirs)
        self._shown = b""

    @property
    def raw(self) -> str:
        """All that it wrote so far, with what terminals obey."""
        return self._shown.decode(errors="replace")

    @property
    def lines(self) -> list[str]:
        """Every line that was ever drawn, without what terminals obey."""
        return [line for line in re.split(r"[\r\n]+", _ESCAPE.sub("", self.raw)) if line.strip()]

    def read_until(self, condition: Callable[[Terminal], bool], timeout: float = 90.0) -> None:
        """Read until the condition holds; the program's end, or the time, fails the test."""
        deadline = time.monotonic() + timeout
        while not condition(self):
            assert self._read(deadline), f"it ended, or took too long:\n{self.raw}"

    def finish(self, timeout: float = 90.0) -> int:
        """Read to the program's end and return its exit code."""
        deadline = time.monotonic() + timeout
        while self._read(deadline):
            pass
        os.close(self._ours)
        return self.child.wait(max(1.0, deadline - time.monotonic()))

    def type(self, text: str) -> None:
        """Press the keys of a text."""
        os.write(self._ours, text.encode())

    def end(self) -> None:
        """End a program that would go on."""
        self.child.kill()
        self.finish()

    def interrupt(self) -> None:
        """Do what Ctrl-C does."""
        self.child.send_signal(signal.SIGINT)

    def _read(self, deadline: float) -> bool:
        if not select.select([self._ours], [], [], max(0.0, deadline - time.monotonic()))[0]:
            self.child.kill()
            return False
        try:
            data = os.read(self._ours, 65536)
        except OSError:  # the last program that had the terminal open closed it
            return False
        self._shown += data
        return bool(data)


def mavftpfs(*words: object, columns: int = 80, rows: int = 24) -> Terminal:
    """Run a command on a terminal."""
    return Terminal([sys.executable, "-m", "mavftpfs", *map(str, words)], columns, rows)
