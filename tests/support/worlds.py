"""A simulated vehicle, a bad link and a connection to it, in memory and on virtual time."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.remote import Reader
from mavftpfs.session.connection import Connection, ConnectOptions, connected
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.sim.linkmodel import LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.memory import MemoryLink

GOOD_LINK = LinkSettings()
DEFAULTS = ConnectOptions()
EPOCH = 1_700_000_000.0

ROOTS = {"px4-nuttx": b"/fs/microsd"}
"""Where a profile's files may be written; the root elsewhere."""


def wall() -> float:
    """Return the card's time of day: it goes on with the test's clock, so a write changes the mtime."""
    try:
        return EPOCH + trio.current_time()
    except RuntimeError:  # it is made before the test's clock runs
        return EPOCH


@dataclass
class World:
    """One vehicle and one link; `connection()` may be entered again after it ended (a restarted client)."""

    profile: str
    settings: LinkSettings = GOOD_LINK
    seed: int = 1
    telemetry: float = 0.0
    serial: bool = False
    tree: MemoryTree = field(default_factory=lambda: MemoryTree(clock=wall))

    def __post_init__(self) -> None:
        rng = random.Random(self.seed)
        self.vehicle = SimVehicle(self.tree, PROFILES[self.profile], rng=rng, telemetry=self.telemetry)
        self.model = LinkModel(random.Random(self.seed + 1), self.settings)
        self.link = MemoryLink(self.vehicle, self.model, is_serial=self.serial)

    @asynccontextmanager
    async def connection(
        self, options: ConnectOptions = DEFAULTS, *, seed: int = 7
    ) -> AsyncIterator[Connection]:
        """Connect and wait for the first heartbeat."""
        async with connected(self.link, options, rng=random.Random(seed)) as connection:
            await connection.ready(30.0)
            yield connection


def content(size: int, seed: int = 0) -> bytes:
    return random.Random(seed).randbytes(size)


def path(profile: str, name: str) -> bytes:
    """Return the path of a name in the directory of `world`."""
    return ROOTS.get(profile, b"") + b"/d/" + name.encode()


def world(profile: str, settings: LinkSettings = GOOD_LINK, **files: bytes) -> World:
    """Return a vehicle with one directory, in which there are these files."""
    made = World(profile, settings)
    made.tree.add_directory(path(profile, "")[:-1])
    for name, data in files.items():
        made.tree.add(path(profile, name), data)
    return made


class MemorySink:
    """A ReadSink that keeps everything and can be waited for."""

    def __init__(self, size: int) -> None:
        self.data = bytearray(size)
        self.have = ExtentSet()
        self.suspicions: list[str] = []
        self.errors: list[Exception] = []
        self._news = trio.Event()

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        return self.have.missing(start, stop)

    def on_opened(self, at: float) -> None:
        """Nobody asks."""

    def on_data(self, offset: int, data: bytes) -> None:
        assert offset + len(data) <= len(self.data)
        self.data[offset : offset + len(data)] = data
        self.have.add(offset, offset + len(data))

    def on_batch(self, count: int) -> None:
        self._tell()

    def on_queued(self) -> None:
        """Nobody asks."""

    def on_suspect(self, reason: str) -> None:
        self.suspicions.append(reason)

    def on_failed(self, error: Exception) -> None:
        self.errors.append(error)
        self._tell()

    async def wait_for(self, start: int, stop: int) -> bytes:
        """Wait until a range is there, or raise the error that came instead."""
        while not self.have.covers(start, stop):
            if self.errors:
                raise self.errors.pop(0)
            await self._news.wait()
        return bytes(self.data[start:stop])

    def _tell(self) -> None:
        self._news.set()
        self._news = trio.Event()


async def read_file(connection: Connection, path: bytes) -> bytes:
    """Open, read whole, close."""
    sink = MemorySink(1 << 22)
    reader = await connection.store.open_reader(path, sink)
    try:
        reader.want(0, reader.size, demand=True)
        return await sink.wait_for(0, reader.size)
    finally:
        reader.close()


async def begin_to_read(connection: Connection, target: bytes, count: int) -> tuple[Reader, MemorySink]:
    """Want a file whole; return its reader and what comes, once so many bytes did."""
    sink = MemorySink(1 << 22)
    reader = await connection.store.open_reader(target, sink)
    reader.want(0, reader.size, demand=True)
    await sink.wait_for(0, count)
    return reader, sink
