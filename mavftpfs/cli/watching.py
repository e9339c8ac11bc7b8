"""`mavftpfs sync --watch`: its lines for people, and its command for each log. Layer: cli."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import trio

from mavftpfs.cli.drawing import shown
from mavftpfs.client.files import Target
from mavftpfs.client.logs import SyncRequest
from mavftpfs.client.progress import Progress
from mavftpfs.client.watch import Watch
from mavftpfs.shared.errors import ExitCode
from mavftpfs.shared.readable import readable, readable_time

EXEC_LIMIT = 600.0
"""Seconds for the command of --exec."""
_LAST_WORDS = 1.0
"""Seconds to read the command's last output after its end."""
_KILL_AFTER = 5.0
"""Seconds between SIGTERM and SIGKILL."""


Work = Callable[[Target], Coroutine[Any, Any, None]]


def watch(args: argparse.Namespace, request: SyncRequest, run: Callable[[Work], None]) -> int:
    """Download logs until SIGINT or SIGTERM; run: runs the work on SOURCE.

    Raises:
        UsageError: LOCAL or the options are wrong.
    """
    hand_on = None if args.command is None else partial(run_command, args.command, limit=EXEC_LIMIT)
    bar = Progress()

    async def work(target: Target) -> None:
        await Watch(request, say, hand_on, bar, args.verify).run(target)

    try:
        with shown(bar, idle=""):
            say(f"waiting for vehicles on {args.source}; Ctrl-C ends it")
            run(work)
    except KeyboardInterrupt:
        say("ended; the next run continues")
    return ExitCode.OK


def say(line: str) -> None:
    """Print a line, with the time unless the journal adds it."""
    when = f"{time.strftime('%H:%M:%S')} " if sys.stdout.isatty() else ""
    print(f"{when}{readable(line)}", flush=True)


async def run_command(command: str, file: Path, *, limit: float) -> str:
    """Run a shell command with a file as its last argument; return why it failed, or "".

    limit: seconds after which the command is ended, with all processes that it started.
    """
    words = ["/bin/sh", "-c", f'{command} "$@"', "sh", os.fspath(file)]
    try:
        process = await trio.lowlevel.open_process(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except OSError as exc:
        return f"--exec cannot be run: {exc.strerror}"
    async with trio.open_nursery() as nursery:
        nursery.start_soon(_pass_on, process)
        try:
            with trio.move_on_after(limit):
                code = await process.wait()
                return "" if code == 0 else f"--exec ended with exit code {code}"
            return f"--exec took longer than {readable_time(limit)} and was ended"
        finally:
            with trio.CancelScope(shield=True):
                await _end(process)
            nursery.cancel_scope.deadline = trio.current_time() + _LAST_WORDS  # others may hold the pipe


async def _pass_on(process: trio.Process) -> None:
    """Print the output of a command, above the progress."""
    assert process.stdout is not None
    rest = b""
    async for data in process.stdout:
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            print(readable(line.decode(errors="replace")), flush=True)
    if rest:
        print(readable(rest.decode(errors="replace")), flush=True)


async def _end(process: trio.Process) -> None:
    """End a command and the processes that it started."""
    if process.returncode is None:
        _signal(process, signal.SIGTERM)
        with trio.move_on_after(_KILL_AFTER):
            await process.wait()
    if process.returncode is None:
        _signal(process, signal.SIGKILL)
        await process.wait()


def _signal(process: trio.Process, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)
