"""Uploads to a vehicle of one directory (worlds.world), without a mount."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.session.connection import Connection
from mavftpfs.session.upload import Upload
from mavftpfs.sim.profiles import PROFILES
from tests.support.sources import MemorySource
from tests.support.worlds import path


def know(connection: Connection, profile: str) -> None:
    """Have it known what OpenFileWO does, as after the first upload that was interrupted."""
    connection.store.traits.wo_truncates = PROFILES[profile].write_only_truncates


async def start(connection: Connection, profile: str, source: MemorySource, name: str = "new") -> Upload:
    return await connection.store.open_upload(path(profile, name), source)


async def put(connection: Connection, target: bytes, data: bytes) -> None:
    """Upload a whole file."""
    source = MemorySource(data)
    upload = await connection.store.open_upload(target, source)
    await upload.finish()
    assert source.all_proven
    await upload.end()


@asynccontextmanager
async def under_way(
    connection: Connection, profile: str, data: bytes, *, seconds: float = 1.5
) -> AsyncIterator[MemorySource]:
    """Upload `new`, and give its source after so long; leaving waits for the end, without an error."""
    source = MemorySource(data)
    upload = await start(connection, profile, source)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(upload.finish)
        await trio.sleep(seconds)
        yield source
