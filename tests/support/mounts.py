"""A mount in its own process, and commands run on it with a bound.

A process that waits in a FUSE request cannot be killed, so a command that runs out of time is freed by
aborting the connection; then the test fails.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from base64 import b64decode
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NoReturn

from mavftpfs.cli import main, ports
from mavftpfs.client.control import ControlError, ask, find_socket
from tests.support.logs import assert_clean, suspects
from tests.support.vehicles import PROJECT, Process, Program

COMMAND_TIMEOUT = 120.0
END_TIMEOUT = 60.0
PATIENCE = 90.0
"""Seconds for what comes within a few on a machine that has time: only a failing test waits so long."""


def wait_until(what: str, condition: Callable[[], bool], timeout: float = PATIENCE) -> None:
    """Poll until `condition` holds; else fail, saying `what` was awaited.

    A file that the condition looks at and that is not there yet is one more thing to wait for. A look that
    takes long is followed by a pause as long: what is waited for needs the machine, too.
    """
    deadline = time.monotonic() + timeout
    while True:
        began = time.monotonic()
        if _holds(condition):
            return
        now = time.monotonic()
        assert now < deadline, f"not within {timeout} s: {what}"
        time.sleep(max(0.02, now - began))


def _holds(condition: Callable[[], bool]) -> bool:
    try:
        return condition()
    except FileNotFoundError:
        return False


def mavftpfs(*words: object, code: int = 0) -> tuple[str, str]:
    """Run a command as a process; it must end with `code`. Return what it said on stdout and stderr."""
    argv = [sys.executable, "-m", "mavftpfs", *map(str, words)]
    done = subprocess.run(
        argv, capture_output=True, text=True, timeout=COMMAND_TIMEOUT, cwd=PROJECT, check=False
    )
    assert done.returncode == code, f"{words}: exit {done.returncode}\n{done.stdout}{done.stderr}"
    assert suspects(done.stderr) == []
    return done.stdout, done.stderr


def command(*words: object, code: int = 0) -> tuple[str, str]:
    """Run a command in this process, where it needs no interpreter of its own: that takes more of a machine
    than what most commands do. Otherwise as `mavftpfs`."""
    assert re.fullmatch("(?!mount$)[a-z]+", str(words[0])), "a mount in the background forks"
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    before = signal.signal(signal.SIGALRM, _hung)
    signal.alarm(int(COMMAND_TIMEOUT))
    try:
        with redirect_stdout(out), redirect_stderr(err):
            ended = main.main([str(word) for word in words])
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    said, complained = (stream.buffer.getvalue().decode() for stream in (out, err))
    assert ended == code, f"{words}: exit {ended}\n{said}{complained}"
    assert suspects(complained) == []
    return said, complained


def install_programs(folder: Path, library: Path = PROJECT) -> Path:
    """Make the two programs of an installation; return the first. library: where their package is."""
    for name, function in (("mount.mavftpfs", "mount_helper"), ("mavftpfs", "main")):
        program = folder / name
        program.write_text(  # as pip does it: #! takes no path with a blank
            f"#!/bin/sh\n'''exec' {shlex.quote(sys.executable)} \"$0\" \"$@\"\n' '''\n"
            f"import sys\nsys.path.insert(0, {str(library)!r})\n"
            f"from mavftpfs.cli import main\nsys.exit(main.{function}())\n"
        )
        program.chmod(0o755)
    return program


def _hung(*_: object) -> NoReturn:
    raise AssertionError("the command hung")


def hub_of(source: str) -> dict[str, Any] | None:
    """Return what the hub of a port says, None if there is none."""
    found = ports.statuses(source)
    return dict(found[0]) if found else None


def mounted_at(path: Path) -> bool:
    """Return whether something is mounted there, without touching it."""
    escaped = re.sub(r"[\\\s]", lambda hit: f"\\{ord(hit[0]):03o}", str(path))
    lines = Path("/proc/self/mounts").read_text().splitlines()
    return any(line.split(" ")[1] == escaped for line in lines)


def _is_served(path: Path) -> bool:
    try:
        os.stat(path)
    except OSError as error:
        return error.errno not in (errno.ENOTCONN, errno.ECONNABORTED)
    return mounted_at(path)


def unmount(path: Path) -> None:
    """Unmount as a user does, if it is mounted. It may be in use for a moment more: by a program that ends
    (`git gc`), or one elsewhere that looks at all mounts (`df`)."""

    def unmounted() -> bool:
        if mounted_at(path):
            command = ["fusermount3", "-u", str(path)]
            subprocess.run(command, check=False, timeout=END_TIMEOUT, capture_output=True)
        return not mounted_at(path)

    wait_until("all programs stopped using the mount", unmounted)


def abort_mount(path: Path) -> None:
    """Free the programs that wait in the mount, and take it away; harmless if nothing is mounted."""
    for command in (["umount", "-f"], ["umount", "-l"], ["fusermount3", "-uz"]):
        if mounted_at(path):
            subprocess.run([*command, str(path)], capture_output=True, timeout=20, check=False)


def processes_in(path: Path) -> list[int]:
    """Return the processes with `path`, or something below it, in their command line."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and os.fsencode(path) in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:  # it ended meanwhile
            continue
    return found


class Mount:
    """`mavftpfs SOURCE MOUNTPOINT -f`, ended and judged by `finish`."""

    def __init__(
        self, source: str, path: Path, folder: Path, options: Sequence[str] = (), argv: Sequence[str] = ()
    ) -> None:
        self.source = source
        self.path = path
        self.folder = folder
        self.options = options
        self.extra = argv
        self.allowed_log: tuple[str, ...] = ()
        self.process: Process | None = None

    def argv(self) -> list[str]:
        """Return the module that mounts, and the words for it."""
        options = ["-o", ",".join(self.options)] if self.options else []
        return ["mavftpfs.__main__", self.source, str(self.path), "-f", *options, *self.extra]

    def start(self) -> None:
        """Start it and wait until it serves; a daemon that ends instead fails the test."""
        self.begin()
        self.await_serving()

    def begin(self) -> None:
        """Start it."""
        self.process = Program("mount", self.argv(), self.folder)

    def await_serving(self) -> None:
        """Wait until it serves; a daemon that ends instead fails the test."""
        process = self.alive_or_ended()
        wait_until(f"{self.argv()} mounted", lambda: self.serves() or not process.running)
        assert process.running, f"the mount ended with {process.popen.returncode}:\n{process.text()}"

    def serves(self) -> bool:
        """Return whether it is mounted and can be asked for its status, which is so a moment later."""
        if not mounted_at(self.path):
            return False
        try:
            self.status()
        except ControlError:
            return False
        return True

    def status(self) -> dict[str, Any]:
        """Return what it says of itself."""
        socket = find_socket(os.path.realpath(self.path))
        facts: dict[str, Any] = ask(socket, {"command": "status"}, timeout=20)["status"]
        return facts

    def bytes_read(self) -> int:
        """Return how much has come of the files that are being read."""
        return sum(one["done"] for one in self.status()["transfers"])

    def alive_or_ended(self) -> Process:
        """Return the process."""
        assert self.process is not None
        return self.process

    def kill(self) -> None:
        """kill -9 of the mount's process, until the kernel knows, too, that nobody serves the mount:
        that may be after the process was reaped."""
        process, self.process = self.alive(), None
        process.kill()
        wait_until("the kernel gives the mount up", lambda: not _is_served(self.path))

    def alive(self) -> Process:
        """Return the process, which must run."""
        assert self.process is not None
        assert self.process.running, self.process.text()
        return self.process

    def run(
        self,
        *argv: str | Path,
        timeout: float = COMMAND_TIMEOUT,
        code: int | None = 0,
        cwd: Path | None = None,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command that may touch the mount. `code`: the exit code it must have, None for any."""
        command = [str(part) for part in argv]
        with self.started(*command, cwd=cwd) as child:
            try:
                out, err = child.communicate(timeout=timeout)
            except subprocess.TimeoutExpired:
                log = self.process.text() if self.process else ""
                raise AssertionError(f"{command} hung for {timeout} s; the mount says\n{log}") from None
        result = subprocess.CompletedProcess(command, child.returncode, out, err)
        assert code is None or child.returncode == code, f"{command}: exit {child.returncode}\n{out}\n{err}"
        return result

    @contextmanager
    def started(self, *argv: str | Path, cwd: Path | None = None) -> Iterator[subprocess.Popen[str]]:
        """Run a command beside the test's own steps; if it still runs at the end it is freed and killed."""
        child = subprocess.Popen(
            [str(part) for part in argv],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="surrogateescape",
            cwd=cwd,
            env={**os.environ, "LC_ALL": "C.UTF-8"},
        )
        try:
            yield child
        finally:
            if child.poll() is None:
                child.kill()
                try:
                    child.communicate(timeout=2)
                except subprocess.TimeoutExpired:
                    abort_mount(self.path)
                    child.communicate(timeout=20)
            for pipe in (child.stdout, child.stderr):
                if pipe is not None:
                    pipe.close()  # nobody asked a child that ended by itself what it said

    def python(self, code: str, *args: str | Path, timeout: float = COMMAND_TIMEOUT) -> str:
        """Run a Python snippet as its own process and return its stdout; it must exit 0."""
        return self.run(sys.executable, "-c", code, *args, timeout=timeout).stdout

    def read_bytes(self, path: str | Path, timeout: float = COMMAND_TIMEOUT) -> bytes:
        """Return a file's content, read by a process of its own."""
        return b64decode(self.run("base64", path, timeout=timeout).stdout)

    def errno_of(self, code: str, *args: str | Path) -> str:
        """Return the name of the errno of the OSError that a snippet ends with, '' if it succeeds."""
        wrapped = (
            f"import errno, os, sys\ntry:\n    exec({code!r})\n"
            "except OSError as error:\n    print(errno.errorcode[error.errno], end='')"
        )
        return self.python(wrapped, *args)

    def unmount(self) -> int:
        """Unmount as a user does and return the daemon's exit code."""
        assert self.process is not None
        unmount(self.path)
        return self.process.wait(END_TIMEOUT)

    def end_by(self, number: signal.Signals) -> int:
        """End the daemon by a signal and return its exit code."""
        process = self.alive()
        process.send_signal(number)
        return process.wait(END_TIMEOUT)

    def finish(self) -> None:
        """Unmount if mounted; then the daemon must have ended with 0 and a clean log."""
        process, self.process = self.process, None
        if process is None:
            return
        try:
            if process.running:
                unmount(self.path)
            code = process.wait(END_TIMEOUT)
        finally:
            abort_mount(self.path)
        assert_clean("mount", process.text(), self.allowed_log)
        assert code == 0, f"the mount ended with {code}:\n{process.text()}"
