"""The tree of a mount over a simulated vehicle, in memory and without a kernel."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.session.connection import Connection
from tests.support.worlds import World


def writable_tree(
    connection: Connection,
    nursery: trio.Nursery | None = None,
    *,
    seed: int = 3,
    spool: SpoolDirectory | None = None,
    **options: Any,
) -> Tree:
    """Return what a mount has over a connection. options: CacheOptions; seed: of our temporary names."""
    return Tree(
        connection.store,
        CacheOptions(**options),
        clock=trio.current_time,
        invalidate=lambda path: None,
        nursery=nursery,
        spool=spool,
        rng=random.Random(seed),
    )


@asynccontextmanager
async def mounted(
    world: World, listed: bytes | None = None, **options: Any
) -> AsyncIterator[tuple[Connection, Tree]]:
    """Connect and give the connection and its tree. listed: a directory that is listed first."""
    async with world.connection() as connection, trio.open_nursery() as nursery:
        tree = writable_tree(connection, nursery, **options)
        if listed is not None:
            await tree.list(listed)
        yield connection, tree
        nursery.cancel_scope.cancel()
