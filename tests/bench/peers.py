"""Who takes part in `tests.bench.mount`, and how each is made to move a file.

Two kinds. A *worker* is a process that says `ready` when it is connected, waits for a line, moves the file,
says `done` or `failed WHY`, and waits for another line so that its CPU time and memory can be read. A *mount*
is a daemon; the transfer is a `cp`. Peers live in an environment of their own, with pinned versions, in the
user's cache directory; pymavlink's mount needs libfuse.so.2 (Debian: libfuse2) besides.
"""

from __future__ import annotations

import hashlib
import os
import platform
import select
import shutil
import subprocess
import sys
import time
import venv
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.bench.cases import Direction
from tests.bench.figures import BARE, US, Measured, Outcome
from tests.support.mounts import abort_mount, mounted_at
from tests.support.vehicles import HOST, PROJECT, Process, peak_memory

PINS = ("fusepy==3.0.1", "loguru==0.7.3", "mavsdk==4.1.0", "pymavlink==2.4.50")
CONNECT_TIMEOUT = 120.0
END_TIMEOUT = 20.0
HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Job:
    """One transfer: client port, REMOTE (a path on the vehicle), LOCAL (what to write or read here).

    timeout: seconds. window: requests that the server can have in flight. patience: seconds after which one
    is lost. folder: for logs and mount points.
    """

    port: int
    direction: Direction
    remote: str
    local: Path
    timeout: float
    window: int
    patience: float
    folder: Path


@dataclass(frozen=True, slots=True)
class Client:
    """One way to move a file; `name` is what tables call it.

    argv: the command line for a job, and the mount point. mounts: it is a mount.
    """

    name: str
    argv: Callable[[Job, Path], list[str]]
    mounts: bool = False
    directions: tuple[Direction, ...] = ("read", "write")

    def run(self, job: Job) -> Measured:
        """Do the job; everything that was started has ended on return."""
        point = job.folder / "mnt"
        point.mkdir()
        return (
            _by_mount(self.argv(job, point), point, job)
            if self.mounts
            else _by_worker(self.argv(job, point), job)
        )


def cpu_of(pid: int) -> float:
    """Return the seconds of CPU, user and system, that the threads of a process used."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        total += int((task / "schedstat").read_text().split()[0])
    return total / 1e9


class Lines:
    """Awaits lines of a child's output, with a limit."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._buffer = b""

    def await_one(self, beginnings: tuple[str, ...], timeout: float) -> str | None:
        """Return the first line with one of the beginnings; None at the end of output or of `timeout`."""
        deadline = time.monotonic() + timeout
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline:
                self._buffer = rest
                text = line.decode(errors="replace").strip()
                if text.startswith(beginnings):
                    return text
                continue
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._pipe], [], [], left)[0]:
                return None
            piece = os.read(self._pipe, 65536)
            if not piece:
                return None
            self._buffer += piece


def _by_worker(argv: list[str], job: Job) -> Measured:
    log = job.folder / "worker.log"
    with log.open("wb") as errors:
        child = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, cwd=PROJECT
        )
    try:
        measured = _converse(child, job)
    finally:
        child.kill()
        child.communicate()
    if measured.outcome is Outcome.FAILED and not measured.detail:
        return Measured(Outcome.FAILED, detail=_last_line(log))
    return measured


def _converse(child: subprocess.Popen[bytes], job: Job) -> Measured:
    assert child.stdout is not None
    assert child.stdin is not None
    lines = Lines(child.stdout.fileno())
    first = lines.await_one(("ready", "failed"), CONNECT_TIMEOUT)
    if first != "ready":
        return Measured(Outcome.FAILED, detail=first or "")
    cpu = cpu_of(child.pid)
    began = time.monotonic()
    child.stdin.write(b"go\n")
    child.stdin.flush()
    answer = lines.await_one(("done", "failed"), job.timeout)
    seconds = time.monotonic() - began
    if answer is None:
        return Measured(Outcome.TIMEOUT if seconds >= job.timeout else Outcome.FAILED)
    if answer != "done":
        return Measured(Outcome.FAILED, detail=answer.removeprefix("failed "))
    return Measured(Outcome.OK, seconds, cpu_of(child.pid) - cpu, peak_memory(child.pid))


def _by_mount(argv: list[str], point: Path, job: Job) -> Measured:
    daemon = Process("daemon", argv, job.folder)
    try:
        if not _await_mount(daemon, point):
            return Measured(Outcome.FAILED, detail=_last_line(daemon.log) or "not mounted in time")
        there = point / job.remote.lstrip("/")
        source, target = (there, job.local) if job.direction == "read" else (job.local, there)
        cpu = cpu_of(daemon.popen.pid)
        copied = _copy(source, target, job, point)
        if copied.cpu is None:
            return copied
        spent = copied.cpu + cpu_of(daemon.popen.pid) - cpu
        return Measured(Outcome.OK, copied.seconds, spent, peak_memory(daemon.popen.pid))
    finally:
        if mounted_at(point) and daemon.running:
            subprocess.run(["fusermount3", "-u", point], capture_output=True, timeout=20, check=False)
            with suppress(subprocess.TimeoutExpired):
                daemon.popen.wait(END_TIMEOUT)
        daemon.kill()
        abort_mount(point)


def _copy(source: Path, target: Path, job: Job, point: Path) -> Measured:
    """Run `cp`; cpu is its own."""
    log = job.folder / "cp.log"
    with log.open("wb") as errors:
        began = time.monotonic()
        child = subprocess.Popen(["cp", source, target], stdin=subprocess.DEVNULL, stderr=errors)
    ended = os.pidfd_open(child.pid)  # exact, where Popen.wait would poll
    try:
        in_time = bool(select.select([ended], [], [], job.timeout)[0])
        seconds = time.monotonic() - began
    finally:
        os.close(ended)
    if not in_time:
        child.kill()
        abort_mount(point)  # else it waits in the kernel
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if not in_time:
        return Measured(Outcome.TIMEOUT)
    if child.returncode:
        return Measured(Outcome.FAILED, detail=_last_line(log))
    return Measured(Outcome.OK, seconds, used.ru_utime + used.ru_stime)


def _await_mount(daemon: Process, point: Path) -> bool:
    deadline = time.monotonic() + CONNECT_TIMEOUT
    while daemon.running and time.monotonic() < deadline:
        if mounted_at(point):
            return True
        time.sleep(0.02)
    return False


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else ""


# -- the peers' environment -------------------------------------------------------------------------


def _environment() -> Path:
    """Return where the virtual environment with the peers is, or will be."""
    key = hashlib.sha256("\n".join((platform.python_version(), *PINS)).encode()).hexdigest()[:12]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "mavftpfs" / f"bench-peers-{key}"


def install() -> None:
    """Make that environment if it is not there.

    Raises:
        CalledProcessError: pip cannot install the packages; it said why.
    """
    place = _environment()
    if (place / "complete").exists():
        return
    print(f"installing the peers ({', '.join(PINS)}) in an environment of their own", file=sys.stderr)
    shutil.rmtree(place, ignore_errors=True)
    venv.create(place, with_pip=True)
    pip = [str(place / "bin/python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, *PINS], check=True)
    (place / "complete").touch()


def clients() -> dict[str, Client]:
    """Return all clients that can take part, by name."""
    place = _environment()
    python = str(place / "bin/python")

    def peer(library: str, job: Job, *more: str) -> list[str]:
        return [python, str(HERE / "peer.py"), library, *_task(job), *more]

    def tuned(job: Job, point: Path) -> list[str]:
        return peer("pymavlink", job, "--chunk", "239", "--window", str(job.window))

    def bare(job: Job, point: Path) -> list[str]:
        limits = ["--window", str(job.window), "--timeout", str(job.patience)]
        return [sys.executable, "-m", "tests.bench.bare", *_task(job), *limits]

    def ours(job: Job, point: Path) -> list[str]:
        source = f"udpin:{HOST}:{job.port}"
        return [sys.executable, "-m", "mavftpfs", source, str(point), "-f", "-o", "verify=size"]

    def fusepy(job: Job, point: Path) -> list[str]:
        (script,) = place.glob("lib/python*/site-packages/pymavlink/mavftpfs.py")
        return [python, str(script), "-m", f"udpin:{HOST}:{job.port}", "--mountpoint", str(point)]

    everybody = [
        Client(BARE, bare),
        Client(US, ours, mounts=True),
        Client("pymavlink mavftp", lambda job, point: peer("pymavlink", job)),
        Client("pymavlink mavftp, tuned", tuned),
        Client("pymavlink mavftpfs", fusepy, True, ("read",)),
        Client("MAVSDK", lambda job, point: peer("mavsdk", job)),
    ]
    return {client.name: client for client in everybody}


def _task(job: Job) -> list[str]:
    return [str(job.port), job.direction, job.remote, str(job.local)]
