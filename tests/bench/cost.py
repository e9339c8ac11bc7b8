"""What a chunk costs: python -m tests.bench.cost [--size MB] [--json FILE] [mount | parts | memory].

`mount`: cp from and to a real mount of the simulated PX4, over loopback, between two runs of a bare pipelined
loop against the same server. Seconds depend on what else the machine does, so the figures to go by are the
CPU time (user + system) of each process per chunk of 239 bytes, and the ratio to the bare loop.
Bytes are compared in every run.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mavftpfs.protocol.payload import MAX_DATA
from tests.bench.bareloop import BareLoop
from tests.support.mounts import Mount
from tests.support.vehicles import Process, SimVehicle

_TICK = 1.0 / os.sysconf("SC_CLK_TCK")


def cpu_of(process: Process) -> float:
    """Return the seconds of CPU, user and system, that a process used."""
    fields = Path(f"/proc/{process.popen.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK


@dataclass(frozen=True, slots=True)
class Copy:
    """One copy. rate: bytes/s; client, server: microseconds of CPU per chunk."""

    what: str
    rate: float
    client: float
    server: float


@contextmanager
def timed(what: str, size: int, server: Process, client: Process | None, into: list[Copy]) -> Iterator[None]:
    """Measure the body, which moves `size` bytes; without a client process it is this one's CPU time."""
    def own() -> float:
        return time.process_time() if client is None else cpu_of(client)

    before = own(), cpu_of(server), time.monotonic()
    yield
    after = own(), cpu_of(server), time.monotonic()
    chunks = size / MAX_DATA
    spent = [(b - a) for a, b in zip(before, after, strict=True)]
    into.append(Copy(what, size / spent[2], spent[0] / chunks * 1e6, spent[1] / chunks * 1e6))


def bare(vehicle: SimVehicle, data: bytes, into: list[Copy]) -> None:
    """Read and write by the bare loop."""
    assert vehicle.process is not None
    loop = BareLoop(vehicle.client_port)
    try:
        loop.wait()
        with timed("bare read", len(data), vehicle.process, None, into):
            assert loop.read(b"/in.bin") == data
        with timed("bare write", len(data), vehicle.process, None, into):
            loop.write(b"/bare.bin", data)
        assert (vehicle.root / "bare.bin").read_bytes() == data
    finally:
        loop.close()


def by_mount(vehicle: SimVehicle, mount: Mount, data: bytes, scratch: Path, into: list[Copy]) -> None:
    """Read and write by cp."""
    assert vehicle.process is not None
    daemon = mount.alive()
    with timed("cp from mount", len(data), vehicle.process, daemon, into):
        subprocess.run(["cp", mount.path / "in.bin", scratch / "out.bin"], check=True)
    assert (scratch / "out.bin").read_bytes() == data
    with timed("cp to mount", len(data), vehicle.process, daemon, into):
        subprocess.run(["cp", scratch / "out.bin", mount.path / "up.bin"], check=True)
    assert (vehicle.root / "up.bin").read_bytes() == data


def measure(size: int, options: list[str]) -> list[Copy]:
    """Run the bare loop, the mount and the bare loop again."""
    found: list[Copy] = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        root, path = folder / "card", folder / "mnt"
        root.mkdir()
        path.mkdir()
        os.environ["XDG_STATE_HOME"] = str(folder / "state")
        data = random.Random(1).randbytes(size)
        (root / "in.bin").write_bytes(data)
        vehicle = SimVehicle(root, folder, "px4")
        vehicle.start()
        try:
            bare(vehicle, data, found)
            mount = Mount(vehicle.source, path, folder, options)
            mount.start()
            try:
                by_mount(vehicle, mount, data, folder, found)
            finally:
                mount.finish()
            bare(vehicle, data, found)
        finally:
            vehicle.finish()
    return found


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=float, default=16)
    parser.add_argument("-o", action="append", default=[])
    a = parser.parse_args()
    for c in measure(int(a.size * 1e6), a.o):
        print(f"{c.what:16} {c.rate / 1e6:6.1f} MB/s  client {c.client:5.2f}  server {c.server:5.2f} us/chunk")
    return 0


if __name__ == "__main__":
    sys.exit(main())
