"""A simulated vehicle, a link to it, a connection and mounts, in memory and on virtual time, and all that a
test may do to them.

    async with rig("px4", {FILE: b"content"}) as here:
        tree = here.mount(verify_max=0)

`card` makes a fixture of it. Paths are the mount's: where only a part of the card may be written (px4-nuttx),
that part is the root of the mount. What happens to single requests is `here.faults`. What goes through the
session alone, by `here.connection.store`, is in `transfers`.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from itertools import count
from random import Random
from typing import Any

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.temporary import is_temporary
from mavftpfs.cache.tree import Tree
from mavftpfs.client.connect import subscribe
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection, ConnectOptions, connected
from mavftpfs.shared.errors import AlreadyExists, RequestTimeout, VehicleLost
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Family, Storage
from mavftpfs.sim.tree import Kind, MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.faults import STATION, Faults
from tests.support.invariants import Invariants
from tests.support.lying import LyingServer
from tests.support.memory import MemoryLink
from tests.support.replies import request
from tests.support.transfers import ROOTS

GOOD_LINK = LinkSettings()
DEFAULTS = ConnectOptions()
EPOCH = 1_700_000_000.0

KINDS = ("px4", "px4-nuttx", "ardupilot5", "littlefs", "mavsdk")
"""One profile of each kind that is written differently: a rename over a file replaces it; it removes the file
first; it is refused (FAT); nothing can be renamed; and OpenFileWO empties files."""

RENAMING = tuple(name for name in KINDS if PROFILES[name].storage is not Storage.LITTLEFS)


def wall() -> float:
    """Return the card's time of day: it goes on with the test's clock, so a write changes the mtime."""
    try:
        return EPOCH + trio.current_time()
    except RuntimeError:  # it is made before the test's clock runs
        return EPOCH


class Rig:
    """One vehicle, one link, one connection at a time, and any number of trees over that.

    Attributes:
        card: what the vehicle has. server: its answers may be changed.
        faults: what happens to single requests.
        invalidated: paths whose pages the kernel was told to drop.
    """

    def __init__(
        self,
        profile: str,
        files: Mapping[bytes, bytes | None] | None = None,
        link: LinkSettings = GOOD_LINK,
        *,
        seed: int = 1,
        telemetry: float = 0.0,
        serial: bool = False,
    ) -> None:
        """files: None for a directory. telemetry: bytes per second. serial: the link is a serial port."""
        self.profile = profile
        self.root = ROOTS.get(profile, b"")
        self.card = MemoryTree(clock=wall)
        self.vehicle = SimVehicle(self.card, PROFILES[profile], rng=Random(seed), telemetry=telemetry)
        self.server = LyingServer(self.card, PROFILES[profile], rng=Random(seed))
        self.vehicle.server = self.server
        self.faults = Faults(self.server)
        self.faults.orphans = bool(link.duplicate)
        self.model = LinkModel(Random(seed + 1), link)
        self.link = MemoryLink(self.vehicle, self.model, is_serial=serial)
        self.invalidated: list[bytes] = []
        self._watches: list[Invariants] = []
        self._numbers = count(30_000, 10)  # so far apart that no server takes one for the one before
        self.connection: Connection
        self.nursery: trio.Nursery
        self.card.add_directory(self.root or b"/")
        for path, data in (files or {}).items():
            if data is None:
                self.put_directory(path)
            else:
                self.put(path, data)

    # --- this side

    @asynccontextmanager
    async def connected(
        self, options: ConnectOptions = DEFAULTS, *, seed: int = 7
    ) -> AsyncIterator[Connection]:
        """Connect and wait for the first heartbeat; a second time is another process, after the first one was
        killed."""
        async with connected(self.link, options, rng=Random(seed)) as self.connection:
            await self.connection.ready(30.0)
            try:
                async with trio.open_nursery() as self.nursery:
                    yield self.connection
                    self.nursery.cancel_scope.cancel()
            finally:
                watches, self._watches = self._watches, []
                for watch in watches:
                    trio.lowlevel.remove_instrument(watch)
            for watch in watches:
                watch.require_none_broken()

    def mount(self, *, seed: int = 1, spool: SpoolDirectory | None = None, **options: Any) -> Tree:
        """Return a tree that is told what happens to the vehicle. options: CacheOptions."""
        tree = Tree(
            self.connection.store,
            CacheOptions(**{"root": self.root or b"/", **options}),
            clock=trio.current_time,
            invalidate=self.invalidated.append,
            nursery=self.nursery,
            spool=spool,
            wall=wall,
            rng=Random(seed),
        )
        subscribe(self.connection, tree)
        watch = Invariants(tree._card)
        trio.lowlevel.add_instrument(watch)
        self._watches.append(watch)
        return tree

    @asynccontextmanager
    async def mounted(self, listed: bytes | None = None, **options: Any) -> AsyncIterator[Tree]:
        """Connect and mount. listed: a directory that is listed first. options: as for `mount`."""
        async with self.connected():
            tree = self.mount(**options)
            if listed is not None:
                await tree.list(listed)
            yield tree

    @property
    def renames(self) -> bool:
        """True if the card can rename."""
        return self.profile in RENAMING

    # --- the card

    def put(self, path: bytes, data: bytes, mtime: int | None = None) -> None:
        """Put a file there, as others would; into the file that is there, if one is."""
        self.card.add(self.root + path, data, mtime)

    def replace(self, path: bytes, data: bytes, mtime: int | None = None) -> None:
        """Move another file over it, as others would: an open old one stays as it is."""
        self.put(b"/another", data, mtime)
        self.card.rename(self.root + b"/another", self.root + path)

    def put_directory(self, path: bytes) -> None:
        """Make a directory and those above it."""
        self.card.add_directory(self.root + path)

    def take(self, path: bytes) -> None:
        """Remove a file, as others would."""
        self.card.remove(self.root + path)

    def data(self, path: bytes) -> bytes:
        """Return what a file on the card holds."""
        return self.card.data(self.root + path)

    def files(self) -> dict[bytes, bytes]:
        """Return every file on the card, those under names of ours included."""
        found = ((path, kind) for path, kind in self._below(b"/") if kind is Kind.FILE)
        return {path: self.data(path) for path, _ in found}

    def directories(self) -> list[bytes]:
        """Return every directory but the root."""
        return [path for path, kind in self._below(b"/") if kind is Kind.DIRECTORY]

    def litter(self) -> list[bytes]:
        """Return which files under names of ours are there."""
        return [path for path in self.files() if is_temporary(split(path)[1])]

    def _below(self, folder: bytes) -> Iterator[tuple[bytes, Kind]]:
        for entry in self.card.entries(self.root + folder):
            if entry.name not in (b".", b".."):
                path = folder.rstrip(b"/") + b"/" + entry.name
                yield path, entry.stat.kind
                if entry.stat.kind is Kind.DIRECTORY:
                    yield from self._below(path)

    # --- the vehicle and the link

    def count(self, *opcodes: Opcode) -> int:
        """Return how often these were asked."""
        return sum(self.faults.requests.count(opcode) for opcode in opcodes)

    async def lose(self) -> None:
        """Cut the link, and wait until the vehicle counts as lost: no heartbeat came, and no answer."""
        self.link.cut()
        await self._until(lambda: self.connection.store.why_lost() is not None)
        for _ in range(2):
            with suppress(RequestTimeout, VehicleLost):
                await self.connection.store.list_directory(self.root or b"/")

    async def find(self) -> None:
        """Mend the link, and wait until the vehicle is heard."""
        self.link.restore()
        await self._until(lambda: self.connection.store.why_lost() is None)

    async def arm(self) -> None:
        """Have the vehicle armed, and wait until that is known."""
        self.vehicle.arm()
        await self._until(lambda: self.connection.vehicle.armed)

    async def disarm(self) -> None:
        """Have it disarmed, and wait until that is known."""
        self.vehicle.disarm()
        await self._until(lambda: not self.connection.vehicle.armed)

    async def reboot(self) -> None:
        """Restart the vehicle, and wait until that is known."""
        await trio.sleep(5.0)  # a boot time has to go back by some seconds to tell of a restart
        before = self.connection.vehicle.reboots
        self.vehicle.reboot(trio.current_time())
        await self._until(lambda: self.connection.vehicle.reboots > before)

    def another_asks(
        self, opcode: Opcode, data: bytes = b"", *, session: int | None = None, heard: bool = True
    ) -> None:
        """Have another client of the vehicle ask something.

        session: None for its own. heard: we hear what it asks; its answers we hear in any case.
        """
        if session is None:
            session = 77 if PROFILES[self.profile].family is Family.ARDUPILOT else 0
        size = 100 if opcode is Opcode.READ_FILE else None
        asked = request(next(self._numbers), opcode, session=session, data=data, size=size)
        self.vehicle.foreign_request(asked.encode(), STATION, trio.current_time(), audible=heard)

    async def _until(self, done: Callable[[], bool]) -> None:
        for _ in range(600):
            if done():
                return
            await trio.sleep(0.1)
        raise AssertionError("it did not come")


@asynccontextmanager
async def rig(
    profile: str = "px4",
    files: Mapping[bytes, bytes | None] | None = None,
    *,
    link: LinkSettings = GOOD_LINK,
    options: ConnectOptions = DEFAULTS,
    **more: Any,
) -> AsyncIterator[Rig]:
    """Connect to a vehicle that has these files. more: as for Rig."""
    here = Rig(profile, files, link, **more)
    async with here.connected(options):
        yield here


def card(
    files: Mapping[bytes, bytes],
    *,
    profiles: Sequence[str] = ("px4",),
    link: LinkSettings = GOOD_LINK,
    options: ConnectOptions = DEFAULTS,
) -> Any:
    """Return a fixture: a rig with these files, of each profile in turn."""

    @pytest.fixture(params=profiles if len(profiles) > 1 else None)
    async def here(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
        async with rig(getattr(request, "param", profiles[0]), files, link=link, options=options) as made:
            yield made

    return here


# --- what programs do

PIECE = 128 * 1024
"""Bytes of a program's calls, as of the kernel's."""


async def read_file(tree: Tree, path: bytes) -> bytes:
    """Open, read to the end and close, as `cat` does."""
    file = await tree.open(path)
    try:
        return b"".join([bytes(await file.read(at, PIECE)) for at in range(0, file.size + 1, PIECE)])
    finally:
        file.close()


async def open_to_copy(tree: Tree, path: bytes) -> OpenFile:
    """Make a file, or empty the one that is there, as `cp` does before it writes."""
    try:
        return await tree.create(path, exclusive=True)
    except AlreadyExists:
        return await tree.open(path, write=True, truncate=True)


async def write_file(tree: Tree, path: bytes, data: bytes, step: int = PIECE) -> None:
    """Make or replace a file, as `cp` does: every error shows."""
    file = await open_to_copy(tree, path)
    try:
        for at in range(0, len(data), step):
            await file.write(at, data[at : at + step])
        await file.flush()
        await file.release()
    finally:
        file.close()


async def list_all(here: Rig, tree: Tree) -> None:
    """List every directory anew, twice over."""
    tree.forget_caches()
    for directory in 2 * [b"/", *here.directories()]:
        await tree.list(directory)
