"""Vehicles as processes: the simulator with any profile, and the MAVSDK library's server, optionally behind
the bad link of `proxy`. Each speaks UDP to a port on 127.0.0.1 where the mount listens, as a vehicle does.
"""

from __future__ import annotations

import itertools
import os
import re
import signal
import socket
import subprocess
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from tests.support.forked import Forked
from tests.support.logs import assert_clean

HOST = "127.0.0.1"
PROJECT = Path(__file__).resolve().parents[2]
STOP_TIMEOUT = 60.0


PORTS_EACH = 1400
_RESERVED = 32
_turns = itertools.count(os.getpid())
_reserved: deque[socket.socket] = deque()


def free_udp_port() -> int:
    """Return a port of the loopback that nobody uses at the moment, for UDP or TCP.

    The kernel does not give it to a program that asks for any port, and no other worker or run of pytest
    takes it. So it is still free when another process uses it.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    first = 10_000 + worker % 16 * PORTS_EACH
    for turn in itertools.islice(_turns, PORTS_EACH):
        if _is_free(first + turn % PORTS_EACH) and _reserve(first + turn % PORTS_EACH):
            return first + turn % PORTS_EACH
    raise AssertionError("no port is free")


def _reserve(port: int) -> bool:
    """Tell other runs of these tests, by a name that they try too, to leave a port alone for a while."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sock.bind(f"\0mavftpfs tests port {port}")
    except OSError:
        sock.close()
        return False
    _reserved.append(sock)
    if len(_reserved) > _RESERVED:
        _reserved.popleft().close()
    return True


def _is_free(port: int) -> bool:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
        with socket.socket(socket.AF_INET, kind) as sock:
            try:
                sock.bind((HOST, port))
            except OSError:
                return False
    return True


def has_ipv6() -> bool:
    """Return whether this computer has IPv6: not every kernel and container has."""
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


def peak_memory(pid: int) -> int:
    """Return the largest resident size of a process so far, in bytes."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024


class Process:
    """A child with its output in files; ended by its own pid, never by name."""

    def __init__(self, name: str, argv: Sequence[str], folder: Path) -> None:
        self.name = name
        self.log = folder / f"{name}.log"
        self.output = folder / f"{name}.out"
        self.log.touch()
        self.output.touch()
        self.popen = self._started(argv)

    def _started(self, argv: Sequence[str]) -> subprocess.Popen[bytes] | Forked:
        with self.log.open("ab") as log, self.output.open("ab") as output:
            return subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=output, stderr=log, cwd=PROJECT)

    @property
    def running(self) -> bool:
        """True until the process ends."""
        return self.popen.poll() is None

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to a process that still runs."""
        if self.running:
            self.popen.send_signal(number)

    def wait(self, timeout: float = STOP_TIMEOUT) -> int:
        """Return the exit code; a process that does not end fails the test."""
        try:
            return self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            raise AssertionError(f"{self.name} did not end in {timeout} s\n{self.text()}") from None

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """End it politely and return the exit code."""
        self.send_signal(number)
        self.resume()  # a paused process takes the signal only then
        return self.wait()

    def kill(self) -> None:
        """kill -9, and reap."""
        self.send_signal(signal.SIGKILL)
        self.popen.wait(STOP_TIMEOUT)

    def peak_memory(self) -> int:
        """Return the largest resident size so far, in bytes."""
        return peak_memory(self.popen.pid)

    def pause(self) -> None:
        """Let it fall silent (SIGSTOP), as on a dead link."""
        self.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let it go on."""
        self.send_signal(signal.SIGCONT)

    def text(self) -> str:
        """Everything it wrote to stderr and stdout."""
        return self.log.read_text(errors="replace") + self.output.read_text(errors="replace")


class Program(Process):
    """The same for a Python program; argv: its module, and the words for it."""

    def _started(self, argv: Sequence[str]) -> Forked:
        return Forked(argv[0], argv[1:], self.output, self.log, PROJECT)


class UdpVehicle:
    """The common part of both kinds of vehicle: a port, a process, perhaps a bad link between."""

    name = "vehicle"
    allowed_log: tuple[str, ...] = ()

    def __init__(self, root: Path, folder: Path, *, bad_link: Sequence[str] = ()) -> None:
        self.root = root
        self.folder = folder
        self.client_port = free_udp_port()
        self.vehicle_port = free_udp_port() if bad_link else self.client_port
        self.bad_link = bad_link
        self.process: Process | None = None
        self.proxy: Process | None = None

    @property
    def source(self) -> str:
        return f"udpin:{HOST}:{self.client_port}"

    def argv(self) -> list[str]:
        """Return the vehicle's module, and the words for it."""
        raise NotImplementedError

    def start(self) -> None:
        if self.bad_link and self.proxy is None:
            ports = [str(self.vehicle_port), str(self.client_port)]
            self.proxy = Program("proxy", ["tests.support.proxy", *ports, *self.bad_link], self.folder)
        self.process = Program(self.name, self.argv(), self.folder)

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process = None

    def pause(self) -> None:
        """Let the vehicle fall silent without ending, as behind a dead link."""
        assert self.process is not None
        self.process.pause()

    def resume(self) -> None:
        """Let it speak again."""
        assert self.process is not None
        self.process.resume()

    def finish(self) -> None:
        """End vehicle and link, whatever state they are in, then judge what they logged."""
        process, self.process = self.process, None
        proxy, self.proxy = self.proxy, None
        if process is not None:
            self.await_ready(process)
        codes = [child.stop() for child in (process, proxy) if child is not None]
        if process is not None:
            assert_clean(process.name, process.text(), self.allowed_log)
            self.check_end(process)
        assert not any(codes), f"exit codes {codes} of {process and process.text()} {proxy and proxy.text()}"

    def await_ready(self, process: Process) -> None:
        """Wait for its first words: before these it does not know how to end in order."""
        deadline = time.monotonic() + STOP_TIMEOUT
        while process.running and not process.output.read_text() and time.monotonic() < deadline:
            process.resume()
            time.sleep(0.02)

    def check_end(self, process: Process) -> None:
        """Judge the vehicle's last words."""


class MavsdkVehicle(UdpVehicle):
    """The MAVSDK library's FtpServer."""

    name = "mavsdk"
    allowed_log = (r"\|Warn \||\|Error\|",)  # its own opinion of lost packets

    def argv(self) -> list[str]:
        url = f"udpout://{HOST}:{self.vehicle_port}"
        return ["tests.support.mavsdk_server", str(self.root), url]


class SimVehicle(UdpVehicle):
    """`mavftpfs sim` with a profile; `options` are its further arguments (link model, seed)."""

    def __init__(
        self,
        root: Path,
        folder: Path,
        profile: str,
        options: Sequence[str] = (),
        *,
        link: str | None = None,
    ) -> None:
        super().__init__(root, folder)
        self.link = link
        self.name = f"sim-{profile}"
        self.profile = profile
        self.options = options
        self.left_alone = False
        """Set where a mount was killed, so that nobody could close its session."""

    @property
    def source(self) -> str:
        """SOURCE for mavftpfs: with a link of its own, what the vehicle says in its first line."""
        if self.link is None:
            return super().source
        assert self.process is not None
        self.await_ready(self.process)
        words = self.process.output.read_text().split()
        assert words[:1] == ["mavftpfs"], self.process.text()
        return words[1]

    def react(self, number: signal.Signals) -> None:
        """Have it arm or disarm (SIGUSR1), cut or mend its link (SIGUSR2), or reboot (SIGPWR); returns when
        it has: of two equal signals that come quickly, one is lost."""
        assert self.process is not None
        self.await_ready(self.process)
        before = self.process.output.read_text()
        self.process.send_signal(number)
        deadline = time.monotonic() + STOP_TIMEOUT
        while self.process.output.read_text() == before:
            assert self.process.running, self.process.text()
            assert time.monotonic() < deadline, "it does not react"
            time.sleep(0.02)

    def argv(self) -> list[str]:
        link = self.link or f"udpout:{HOST}:{self.vehicle_port}"
        base = ["mavftpfs.__main__", "sim", str(self.root)]
        return [*base, "--profile", self.profile, "--link", link, *self.options]

    def check_end(self, process: Process) -> None:
        left = re.search(r"open sessions: (\d+)", process.output.read_text())
        assert left is not None, process.text()
        assert self.left_alone or left[1] == "0", f"{left[1]} sessions were left open"
