"""A simulated vehicle with a mount, in memory and on virtual time, and all that a test may do to the two.

    async with rig("px4", {FILE: b"content"}) as here:
        tree = here.mount(verify="size")

`card` makes a fixture of it. Paths are the mount's: where only a part of the card may be written (px4-nuttx),
that part is the root of the mount. What happens to single requests is `here.faults`.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from random import Random
from typing import Any

import pytest
import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.client.connect import subscribe
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.shared.errors import AlreadyExists, RequestTimeout, VehicleLost
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind
from tests.support.faults import Faults
from tests.support.lying import LyingServer, lie_for
from tests.support.worlds import DEFAULTS, GOOD_LINK, ROOTS, World, wall

KINDS = ("px4", "px4-nuttx", "ardupilot5", "littlefs", "mavsdk")
"""One profile of each kind that is written differently: a rename over a file replaces it; it removes the file
first; it is refused (FAT); nothing can be renamed; and OpenFileWO empties files."""

RENAMING = tuple(name for name in KINDS if PROFILES[name].storage is not Storage.LITTLEFS)


class Rig:
    """One vehicle, one connection to it, and any number of trees over that.

    Attributes:
        server: its answers may be changed. faults: what happens to single requests.
        invalidated: paths whose pages the kernel was told to drop.
    """

    def __init__(
        self, profile: str, files: Mapping[bytes, bytes], link: LinkSettings = GOOD_LINK, **world: Any
    ) -> None:
        """`world`: more of World."""
        self.world = World(profile, link, **world)
        self.root = ROOTS.get(profile, b"")
        self.world.tree.add_directory(self.root or b"/")
        for path, data in files.items():
            self.put(path, data)
        self.server: LyingServer = lie_for(self.world)
        self.faults = Faults(self.world)
        self.invalidated: list[bytes] = []
        self.connection: Connection
        self.nursery: trio.Nursery

    # --- this side

    @asynccontextmanager
    async def connected(
        self, options: ConnectOptions = DEFAULTS, *, seed: int = 7
    ) -> AsyncIterator[Connection]:
        """Connect; a second time is another process, after the first one was killed."""
        connection = self.world.connection(options, seed=seed)
        async with connection as self.connection, trio.open_nursery() as self.nursery:
            yield self.connection
            self.nursery.cancel_scope.cancel()

    def mount(
        self, *, seed: int = 1, spool: SpoolDirectory | None = None, keep: Any = None, **options: Any
    ) -> Tree:
        """Return a tree that is told what happens to the vehicle. keep: as Tree's. options: CacheOptions."""
        tree = Tree(
            self.connection.store,
            CacheOptions(**{"root": self.root or b"/", **options}),
            clock=trio.current_time,
            invalidate=self.invalidated.append,
            nursery=self.nursery,
            spool=spool,
            keep=keep,
            wall=wall,
            rng=Random(seed),
        )
        subscribe(self.connection, tree)
        return tree

    @property
    def renames(self) -> bool:
        """Whether the card can rename."""
        return self.world.profile in RENAMING

    # --- the card

    def put(self, path: bytes, data: bytes, mtime: int | None = None) -> None:
        """Put a file there, as others would; into the file that is there, if one is."""
        self.world.tree.add(self.root + path, data, mtime)

    def replace(self, path: bytes, data: bytes, mtime: int | None = None) -> None:
        """Move another file over it, as others would: who has the old one open keeps it."""
        self.put(b"/another", data, mtime)
        self.world.tree.rename(self.root + b"/another", self.root + path)

    def put_directory(self, path: bytes) -> None:
        """Make a directory and those above it."""
        self.world.tree.add_directory(self.root + path)

    def take(self, path: bytes) -> None:
        """Remove a file, as others would."""
        self.world.tree.remove(self.root + path)

    def data(self, path: bytes) -> bytes:
        """Return what a file on the card holds."""
        return self.world.tree.data(self.root + path)

    def files(self) -> dict[bytes, bytes]:
        """Return every file on the card, those under names of ours included."""
        found = ((path, kind) for path, kind in self._below(b"/") if kind is Kind.FILE)
        return {path: self.data(path) for path, _ in found}

    def directories(self) -> list[bytes]:
        """Return every directory but the root."""
        return [path for path, kind in self._below(b"/") if kind is Kind.DIRECTORY]

    def litter(self) -> list[bytes]:
        """Return which files under names of ours are there."""
        return [path for path in self.files() if is_reserved(split(path)[1])]

    def _below(self, folder: bytes) -> Iterator[tuple[bytes, Kind]]:
        for entry in self.world.tree.entries(self.root + folder):
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
        self.world.link.cut()
        await self._until(lambda: self.connection.store.why_lost() is not None)
        for _ in range(2):
            with suppress(RequestTimeout, VehicleLost):
                await self.connection.store.list_directory(self.root or b"/")

    async def find(self) -> None:
        """Mend the link, and wait until the vehicle is heard."""
        self.world.link.restore()
        await self._until(lambda: self.connection.store.why_lost() is None)

    async def arm(self) -> None:
        """Have the vehicle armed, and wait until that is known."""
        self.world.vehicle.arm()
        self.world.link.kick()
        await self._until(lambda: self.connection.vehicle.armed)

    async def disarm(self) -> None:
        """Have it disarmed, and wait until that is known."""
        self.world.vehicle.disarm()
        self.world.link.kick()
        await self._until(lambda: not self.connection.vehicle.armed)

    async def reboot(self) -> None:
        """Restart the vehicle, and wait until that is known."""
        await trio.sleep(5.0)  # a boot time has to go back by some seconds to tell of a restart
        before = self.connection.vehicle.reboots
        self.world.vehicle.reboot(trio.current_time())
        self.world.link.kick()
        await self._until(lambda: self.connection.vehicle.reboots > before)

    async def _until(self, done: Callable[[], bool]) -> None:
        for _ in range(600):
            if done():
                return
            await trio.sleep(0.1)
        raise AssertionError("it did not come")


@asynccontextmanager
async def rig(
    profile: str = "px4",
    files: Mapping[bytes, bytes] | None = None,
    *,
    link: LinkSettings = GOOD_LINK,
    options: ConnectOptions = DEFAULTS,
    **world: Any,
) -> AsyncIterator[Rig]:
    """Connect to a vehicle that has these files. world: as for Rig."""
    here = Rig(profile, files or {}, link, **world)
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


async def read_file(tree: Tree, path: bytes, step: int = 128 * 1024) -> bytes:
    """Open, read to the end and close, as `cat` does."""
    file = await tree.open(path)
    try:
        return b"".join([bytes(await file.read(at, step)) for at in range(0, file.size + 1, step)])
    finally:
        file.close()


async def write_file(tree: Tree, path: bytes, data: bytes, step: int = 128 * 1024) -> None:
    """Make or replace a file, as `cp` does: every error shows."""
    try:
        file = await tree.create(path, exclusive=True)
    except AlreadyExists:
        file = await tree.open(path, write=True, truncate=True)
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
