"""A file that others replace by one of the same size while nothing is open there: one version or an error.

The server's session is closed when nobody wanted bytes for a while. Virtual time.
"""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.sim.linkmodel import LinkSettings
from tests.sim.test_replaced import STEP, mounted
from tests.support.worlds import ROOTS, World

OLD = random.Random(1).randbytes(400_000)
NEW = random.Random(2).randbytes(500_000)
THEN = 1_700_000_000
LINK = LinkSettings(rate=200_000.0, delay=0.01)
IDLE = 4.0
"""Seconds after which the session is closed."""

TIMED = ["mavsdk", "spec", "ardupilot5", "px4-2026"]
UNTIMED = ["px4", "mavsdk-old"]


class Card:
    """One vehicle with one file, and with `others` beside it, so that a listing takes several requests."""

    def __init__(self, profile: str, *, others: bool = False, link: LinkSettings = LINK) -> None:
        self.world = World(profile, link)
        self.folder = ROOTS.get(profile, b"") or b"/"
        self.path = ROOTS.get(profile, b"") + b"/big"
        self.world.tree.add(self.path, OLD, THEN)
        for number in range(30 * others):
            self.world.tree.add(b"%s-%d" % (self.path, number), b"", THEN)

    def replace(self, data: bytes = NEW[: len(OLD)], mtime: int = THEN + 100) -> None:
        """Move another file over it, as others would."""
        folder = self.path[: self.path.rindex(b"/") + 1]
        self.world.tree.add(folder + b"other", data, mtime)
        self.world.tree.rename(folder + b"other", self.path)

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[tuple[Tree, OpenFile]]:
        """Mount it and open the file."""
        async with self.world.connection() as connection:
            tree = mounted(connection)
            handle = await tree.open(self.path)
            yield tree, handle
            handle.close()

    @asynccontextmanager
    async def opened_late(self) -> AsyncIterator[tuple[Tree, OpenFile]]:
        """Mount it and list the file; open it, and read its head, right after it was replaced."""
        async with self.world.connection() as connection:
            tree = mounted(connection)
            assert (await tree.stat(self.path)).mtime == THEN
            self.replace()
            handle = await tree.open(self.path)
            assert await handle.read(0, STEP) == NEW[:STEP]
            yield tree, handle
            handle.close()


async def read_head(handle: OpenFile) -> None:
    """Read the first bytes, and wait until the session is closed."""
    assert await handle.read(0, STEP) == OLD[:STEP]
    await trio.sleep(IDLE)


async def read_on(handle: OpenFile, start: int) -> bytes:
    """Read from there to the end."""
    return b"".join([bytes(await handle.read(at, STEP)) for at in range(start, handle.size, STEP)])
