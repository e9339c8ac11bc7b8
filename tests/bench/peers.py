"""The peers of `tests.bench.mount`, each with its way to move a file.

Two kinds. A *worker* is a process that connects, moves the file and says what it took (`peer.timed`), or
ends with a reason. A *mount* is a daemon; the transfer is a `cp`. Peers live in an environment of their own,
with pinned versions, in the user's cache directory; pymavlink's mount needs libfuse.so.2 (Debian: libfuse2)
besides.
"""

from __future__ import annotations

import hashlib
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import venv
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.bench.cases import Direction
from tests.bench.figures import BARE, US, Cell, Measured, Outcome
from tests.support.mounts import abort_mount, mounted_at, wait_until
from tests.support.vehicles import HOST, Process, peak_memory

PINS = ("fusepy==3.0.1", "loguru==0.7.3", "mavsdk==4.1.0", "pymavlink==2.4.50")
CONNECT_TIMEOUT = 120.0
HERE = Path(__file__).parent
REMOTE = "/bench/file.bin"


@dataclass(frozen=True, slots=True)
class Job:
    """One transfer. port: the client's. local: what to write or read here. folder: for logs, mount points."""

    cell: Cell
    port: int
    local: Path
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
        argv = self.argv(job, point)
        return _by_mount(argv, point, job) if self.mounts else _by_worker(argv, job)


def _by_worker(argv: list[str], job: Job) -> Measured:
    worker = Process("worker", argv, job.folder)
    try:
        code = worker.popen.wait(CONNECT_TIMEOUT + job.cell.timeout)
    except subprocess.TimeoutExpired:
        worker.kill()
        return Measured(Outcome.FAILED, detail="not connected in time")
    if code == -signal.SIGALRM:
        return Measured(Outcome.TIMEOUT)
    if code:
        return Measured(Outcome.FAILED, detail=_last_line(worker.log.read_text(errors="replace")))
    seconds, cpu, memory = worker.output.read_text(errors="replace").split()[-3:]
    return Measured(Outcome.OK, float(seconds), float(cpu), int(memory))


def _by_mount(argv: list[str], point: Path, job: Job) -> Measured:
    daemon = Process("daemon", argv, job.folder)
    try:
        with suppress(AssertionError):
            wait_until("mounted", lambda: mounted_at(point) or not daemon.running, CONNECT_TIMEOUT)
        if not mounted_at(point):
            return Measured(Outcome.FAILED, detail=_last_line(daemon.log.read_text(errors="replace")))
        return _copied(daemon.popen.pid, point, job)
    finally:
        with suppress(AssertionError):  # it was killed for not ending
            daemon.stop()
        abort_mount(point)


def _copied(daemon: int, point: Path, job: Job) -> Measured:
    """Run `cp`, which ends at the time-out because the mount does."""
    there = point / REMOTE.lstrip("/")
    paths = (there, job.local) if job.cell.direction == "read" else (job.local, there)
    watch = threading.Timer(job.cell.timeout, abort_mount, [point])
    watch.start()
    cpu, began = _spent(daemon), time.monotonic()
    copied = subprocess.run(["cp", *paths], stderr=subprocess.PIPE, text=True, check=False)
    seconds = time.monotonic() - began
    watch.cancel()
    if seconds >= job.cell.timeout:
        return Measured(Outcome.TIMEOUT)
    if copied.returncode:
        return Measured(Outcome.FAILED, detail=_last_line(copied.stderr))
    return Measured(Outcome.OK, seconds, _spent(daemon) - cpu, peak_memory(daemon))


def _spent(daemon: int) -> float:
    """Return the seconds of CPU that a daemon used, and children of ours that have ended."""
    threads = Path(f"/proc/{daemon}/task").glob("*/schedstat")
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    nanoseconds = sum(int(thread.read_text().split()[0]) for thread in threads)
    return nanoseconds / 1e9 + children.ru_utime + children.ru_stime


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
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
        return peer("pymavlink", job, "--chunk", "239", "--window", str(job.cell.window))

    def bare(job: Job, point: Path) -> list[str]:
        limits = ["--window", str(job.cell.window), "--patience", str(job.cell.patience)]
        return [sys.executable, "-m", "tests.bench.bare", *_task(job), *limits]

    def ours(job: Job, point: Path) -> list[str]:
        source = f"udpin:{HOST}:{job.port}"
        return [sys.executable, "-m", "mavftpfs", source, str(point), "-f", "-o", "verify_max=0"]

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
    return [str(job.port), job.cell.direction, REMOTE, str(job.local), str(job.cell.timeout)]
