"""A file that shrinks on the card while it is written in place and the session is lost."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.remote import Upload
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileChanged
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import Faults
from tests.support.sources import MemorySource
from tests.support.worlds import ROOTS, World

KEEPING = [name for name, profile in PROFILES.items() if not profile.write_only_truncates]
OLD = random.Random(1).randbytes(5000)
NEW = random.Random(2).randbytes(20_000)
PLAIN = LinkSettings(rate=20_000.0, delay=0.02)


async def sent(faults: Faults, count: int) -> None:
    """Wait until so many writes reached the server."""
    for _ in range(10_000):
        if faults.requests.count(Opcode.WRITE_FILE) >= count:
            return
        await trio.sleep(0.05)


@asynccontextmanager
async def uploading(
    here: World, path: bytes, source: MemorySource, least: int | None = None
) -> AsyncIterator[tuple[Upload, trio.Nursery]]:
    """Open an upload where it is known what OpenFileWO does; of a new file unless it has `least` bytes."""
    async with here.connection() as connection, trio.open_nursery() as nursery:
        store = connection.store
        await store.probe_open_for_write(path + b"1", path + b"2")
        upload = await store.open_upload(path, source, create=least is None, least=least or 0)
        yield upload, nursery
        await upload.abort()
        nursery.cancel_scope.cancel()


def names(here: World, path: bytes) -> list[bytes]:
    return [entry.name for entry in here.tree.entries(path.rpartition(b"/")[0])]


@pytest.mark.parametrize("shrinks", [False, True])
@pytest.mark.parametrize("profile", KEEPING)
async def test_a_lost_session_goes_on_only_where_the_rest_is_still_there(
    profile: str, shrinks: bool, autojump: MockClock
) -> None:
    """shrinks: to more than what was sent so far, and less than what it had."""
    here = World(profile, PLAIN)
    path = ROOTS.get(profile, b"") + b"/d/file"
    here.tree.add(path, OLD + NEW)
    faults = Faults(here)
    source = MemorySource(NEW)
    async with uploading(here, path, source, least=len(OLD + NEW)) as (upload, nursery):

        async def disturb() -> None:
            await sent(faults, 30)
            here.link.cut()
            if shrinks:
                here.tree.truncate(path, 24_000)
            await trio.sleep(4)
            here.link.restore()

        nursery.start_soon(disturb)
        if shrinks:
            with pytest.raises(FileChanged):
                await upload.finish()
            assert len(here.tree.data(path)) == 24_000
        else:
            await upload.finish()
            assert here.tree.data(path) == NEW + (OLD + NEW)[len(NEW) :]


@pytest.mark.parametrize("profile", KEEPING)
async def test_a_temporary_that_was_tidied_up_is_sent_whole(profile: str, autojump: MockClock) -> None:
    """OpenFileWO makes missing files on some servers: what was sent before would be a hole."""
    here = World(profile, PLAIN)
    path = ROOTS.get(profile, b"") + b"/d/file"
    here.tree.add_directory(path.rpartition(b"/")[0])
    faults = Faults(here)
    source = MemorySource(NEW)
    async with uploading(here, path, source) as (upload, nursery):

        def tidy_up() -> None:
            if source.rollbacks == [] and path.rpartition(b"/")[2] in names(here, path):
                here.tree.remove(path)

        async def disturb() -> None:
            await sent(faults, 60)
            here.link.cut()
            for opcode in (Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO):
                faults.at(opcode, tidy_up)
            await trio.sleep(4)
            here.link.restore()

        nursery.start_soon(disturb)
        await upload.finish()
        assert True in source.rollbacks
        assert here.tree.data(path) == NEW


@pytest.mark.parametrize("profile", ["spec", "px4", "px4-nuttx", "px4-2026"])
async def test_what_was_never_proven_may_be_missing(profile: str, autojump: MockClock) -> None:
    """The bytes behind the last checkpoint were lost with the session: they are sent again. (ArduPilot ACKs
    the end of a session that it does not know.)"""
    here = World(profile, PLAIN)
    path = ROOTS.get(profile, b"") + b"/d/file"
    here.tree.add(path, OLD)
    faults = Faults(here)
    source = MemorySource(OLD + NEW)
    async with uploading(here, path, source, least=len(OLD)) as (upload, nursery):

        async def disturb() -> None:
            await sent(faults, 60)
            here.link.cut()
            here.vehicle.server.reboot(trio.current_time())
            here.tree.truncate(path, len(OLD))
            await trio.sleep(20)
            here.link.restore()

        nursery.start_soon(disturb)
        await upload.finish()
        assert here.tree.data(path) == OLD + NEW
