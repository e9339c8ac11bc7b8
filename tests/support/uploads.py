"""Uploads to a vehicle of one directory (worlds.world), without a mount."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.session.connection import Connection
from mavftpfs.session.upload import QueuedUpload
from tests.support.sources import MemorySource
from tests.support.worlds import path


async def probe(connection: Connection, profile: str) -> None:
    """Try out what the server does to files that it opens."""
    first, second = path(profile, ".mavftpfs-aaaadaaa"), path(profile, ".mavftpfs-aaaadaab")
    await connection.store.probe_open_for_write(first, second)


async def start(
    connection: Connection, profile: str, source: MemorySource, name: str = "new"
) -> QueuedUpload:
    return await connection.store.open_upload(path(profile, name), source, create=True)


async def put(connection: Connection, target: bytes, data: bytes) -> None:
    """Upload a whole file."""
    source = MemorySource(data)
    upload = await connection.store.open_upload(target, source, create=True)
    await upload.finish()
    assert source.all_proven
    await upload.abort()


async def append(connection: Connection, target: bytes, data: bytes, at: int) -> None:
    """Change a file in place."""
    source = MemorySource(bytes(at) + data)
    source.dirty.discard(0, at)
    source.proven.add(0, at)
    upload = await connection.store.open_upload(target, source, create=False)
    await upload.finish()
    await upload.abort()


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
