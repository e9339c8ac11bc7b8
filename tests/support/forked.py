"""Python programs as processes of their own, started by a fork of a server that has their modules loaded.

Loading them takes an interpreter a third of a second of a core, and the suite starts some thousand. What is
of the start itself (arguments of the interpreter, the command line in /proc) is seen only by tests that run
`python -m mavftpfs`.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(
    [
        *("mavftpfs.__main__", "mavftpfs.cli.main", "mavftpfs.mount.single", "mavftpfs.sim.endpoints"),
        *("tests.support.flown", "tests.support.proxy"),
    ]
)


class Forked:
    """A process in which a module's `main` runs; has of `subprocess.Popen` what tests need.

    words: for it. output, log: where stdout and stderr go. cwd: where it works.
    """

    def __init__(self, module: str, words: Sequence[str], output: Path, log: Path, cwd: Path) -> None:
        arguments = (module, list(words), output, log, cwd, dict(os.environ))
        self._process = _SERVER.Process(target=_run, args=arguments, daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code, negative if a signal ended it; None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        """Wait for its end; return the exit code."""
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout)
        return code

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)


def _run(
    module: str, words: list[str], output: Path, log: Path, cwd: Path, environment: dict[str, str]
) -> None:
    for number, path in ((1, output), (2, log)):
        with path.open("ab") as file:
            os.dup2(file.fileno(), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    warnings.simplefilter("default")
    loaded = importlib.import_module(module)
    sys.argv = [str(loaded.__file__), *words]
    sys.exit(loaded.main())
