"""What a chunk of 239 bytes costs: scripts/bench cost [--size MB] [--memory MB] [--servers NAME ...].

cp from and to a real mount over loopback, between two runs of a bare pipelined loop against the same server.
Seconds depend on what else the machine does, so the figures to go by are each process's CPU time (user +
system) per chunk, and the ratio of rates to the bare loop. With --memory, the mount's largest resident size
while a file of so many megabytes is read, and another written, through it. Bytes are compared in every run.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from mavftpfs.protocol.payload import MAX_DATA
from tests.bench.bare import Bare
from tests.support.mounts import Mount
from tests.support.vehicles import MavsdkVehicle, Process, SimVehicle, UdpVehicle

REAL_MAVSDK = "mavsdk-real"
"""The MAVSDK library's own server; every other name is a profile of the simulator."""

WINDOWS = {"px4": 64, REAL_MAVSDK: 32}
FEW = 4
SIZE_SHARE = {"px4": 1.0, REAL_MAVSDK: 0.25}
"""Of --size; the others are slower still."""

LEAST_SHARE = 1 / 32
PATIENCE = 0.3
HOLES = 8 << 20
"""Bytes between the parts of the large file that are not zeros."""

_TICK = 1.0 / os.sysconf("SC_CLK_TCK")
_US = 1e6


@dataclass(frozen=True, slots=True)
class Copy:
    """One copy. rate: bytes/s; client, server: microseconds of CPU per chunk."""

    server_name: str
    what: str
    rate: float
    client: float
    server: float


@dataclass(frozen=True, slots=True)
class Memory:
    """Bytes: of the file read or written, the mount's largest resident size, and what promise 8 allows."""

    what: str
    size: int
    peak: int
    allowed: int


def cpu_of(process: Process) -> float:
    """Return the seconds of CPU, user and system, that a process used."""
    fields = Path(f"/proc/{process.popen.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK


class Bench:
    """One server in a directory of its own, and what was measured with it."""

    def __init__(self, server: str, folder: Path) -> None:
        self.server = server
        self.found: list[Copy] = []
        self.folder = folder
        self.root, self.mountpoint = folder / "card", folder / "mnt"
        self.root.mkdir()
        self.mountpoint.mkdir()
        os.environ["XDG_STATE_HOME"] = str(folder / "state")
        self.vehicle: UdpVehicle
        if server == REAL_MAVSDK:
            self.vehicle = MavsdkVehicle(self.root, folder)
        else:
            self.vehicle = SimVehicle(self.root, folder, server)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the server for the length of the body."""
        self.vehicle.start()
        try:
            yield
        finally:
            self.vehicle.finish()

    @contextmanager
    def mounted(self, *options: str) -> Iterator[Mount]:
        """Mount it for the length of the body."""
        mount = Mount(self.vehicle.source, self.mountpoint, self.folder, options)
        mount.start()
        try:
            yield mount
        finally:
            mount.finish()

    @contextmanager
    def timed(self, what: str, size: int, client: Callable[[], float]) -> Iterator[None]:
        """Measure the body, which moves `size` bytes; `client` returns the client's CPU time."""
        server = self.vehicle.process
        assert server is not None
        before = time.monotonic(), client(), cpu_of(server)
        yield
        after = time.monotonic(), client(), cpu_of(server)
        seconds, *spent = (late - early for early, late in zip(before, after, strict=True))
        per_chunk = [cpu * MAX_DATA / size * _US for cpu in spent]
        self.found.append(Copy(self.server, what, size / seconds, *per_chunk))

    def bare(self, data: bytes) -> None:
        """Read and write by the bare loop."""
        window = WINDOWS.get(self.server, FEW)
        # Each by a client of its own: replies that one left behind must not meet the next.
        with closing(Bare(self.vehicle.client_port, window, PATIENCE)) as reader:
            reader.connect()
            with self.timed("bare read", len(data), time.process_time):
                assert reader.read(b"/in.bin") == data
        with closing(Bare(self.vehicle.client_port, window, PATIENCE)) as writer:
            writer.connect()
            with self.timed("bare write", len(data), time.process_time):
                writer.write(b"/bare.bin", data)
        assert (self.root / "bare.bin").read_bytes() == data

    def by_mount(self, mount: Mount, data: bytes) -> None:
        """Read and write by cp."""
        daemon, local = mount.alive(), self.folder / "local.bin"
        with self.timed("cp from the mount", len(data), lambda: cpu_of(daemon)):
            subprocess.run(["cp", mount.path / "in.bin", local], check=True)
        assert local.read_bytes() == data
        with self.timed("cp to the mount", len(data), lambda: cpu_of(daemon)):
            subprocess.run(["cp", local, mount.path / "up.bin"], check=True)
        assert (self.root / "up.bin").read_bytes() == data


def copies(server: str, size: int) -> list[Copy]:
    """Measure the bare loop, the mount, and the bare loop again."""
    with TemporaryDirectory() as folder:
        bench = Bench(server, Path(folder))
        data = random.Random(1).randbytes(size)
        (bench.root / "in.bin").write_bytes(data)
        with bench.running():
            bench.bare(data)
            with bench.mounted() as mount:
                bench.by_mount(mount, data)
            bench.bare(data)
        return bench.found


CACHE = 64 << 20
ALLOWED = CACHE + (8 << 20) + (60 << 20)
"""Bytes of memory: cache_size, the default of dirty_max, and the program."""


def memory_reading(size: int) -> Memory:
    """Read a large file through a mount and return how much memory that took at most."""
    with TemporaryDirectory() as folder:
        bench = Bench("px4", Path(folder))
        rng = random.Random(2)
        with (bench.root / "large.bin").open("wb") as file:
            for at in range(0, size, HOLES):
                file.seek(at)
                file.write(rng.randbytes(4096))
            file.truncate(size)
        with bench.running(), bench.mounted(f"cache_size={CACHE >> 20}M") as mount:
            subprocess.run(["cmp", mount.path / "large.bin", bench.root / "large.bin"], check=True)
            peak = mount.alive().peak_memory()
    return Memory("read", size, peak, ALLOWED)


def memory_writing(size: int) -> Memory:
    """Write a large file through a mount and return how much memory that took at most."""
    with TemporaryDirectory() as folder:
        bench = Bench("px4", Path(folder))
        local, block = bench.folder / "large.bin", random.Random(3).randbytes(1 << 20)
        with local.open("wb") as file:
            for at in range(0, size, len(block)):
                file.write(block[: size - at])
        with bench.running(), bench.mounted(f"cache_size={CACHE >> 20}M") as mount:
            subprocess.run(["cp", local, mount.path / "large.bin"], check=True)
            peak = mount.alive().peak_memory()
        subprocess.run(["cmp", local, bench.root / "large.bin"], check=True)
    return Memory("written", size, peak, ALLOWED)


def show_copies(found: Sequence[Copy]) -> None:
    """Print the copies and their ratios to the bare loop."""
    table = Table("server", "what", "MB/s", "of the bare loop", "client µs/chunk", "server µs/chunk")
    for copy in found:
        kind = "read" if copy.what.endswith(("read", "from the mount")) else "write"
        peers = [c.rate for c in found if (c.server_name, c.what) == (copy.server_name, f"bare {kind}")]
        ratio = copy.rate / (sum(peers) / len(peers))
        figures = (f"{copy.rate / 1e6:.2f}", f"{ratio:.2f}", f"{copy.client:.1f}", f"{copy.server:.1f}")
        table.add_row(copy.server_name, copy.what, *figures)
    Console().print(table)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="scripts/bench cost", description="CPU time and memory a chunk costs"
    )
    parser.add_argument("--size", type=float, default=32.0, help="megabytes to copy (to slow servers less)")
    parser.add_argument("--servers", nargs="*", default=["px4", REAL_MAVSDK, "ardupilot"])
    parser.add_argument(
        "--memory", type=float, default=0.0, help="megabytes to read and write for the memory's peak"
    )
    parser.add_argument("--json", type=Path, help="write the results here too")
    arguments = parser.parse_args()
    found: list[Copy] = []
    for server in arguments.servers:
        found += copies(server, int(arguments.size * 1e6 * SIZE_SHARE.get(server, LEAST_SHARE)))
    if found:
        show_copies(found)
    peaks: list[Memory] = []
    if arguments.memory:
        peaks = [measure(int(arguments.memory * 1e6)) for measure in (memory_reading, memory_writing)]
    for peak in peaks:
        print(
            f"{peak.size} bytes {peak.what}: {peak.peak} bytes of memory at most, {peak.allowed} are allowed"
        )
    if arguments.json is not None:
        results = {"copies": [asdict(copy) for copy in found], "memory": [asdict(peak) for peak in peaks]}
        arguments.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
