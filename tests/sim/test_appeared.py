"""A name is looked for right before a new file is made there, on every simulated server."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.remote import FREE_FOR
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import AlreadyExists, FtpNak, MavftpfsError
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import Faults
from tests.support.sources import MemorySource
from tests.support.worlds import path, world

EVERY_PROFILE = sorted(PROFILES)
LONG_AGO = float("-inf")


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_what_is_there_is_not_emptied(profile: str, autojump: MockClock) -> None:
    here = world(profile, there=b"theirs")
    async with here.connection() as connection:
        store, target = connection.store, path(profile, "there")
        upload = await store.open_upload(target, MemorySource(b"ours"), create=True, free_at=LONG_AGO)
        for _ in range(2):
            with pytest.raises(AlreadyExists):
                await upload.finish()
        assert not upload.begun
        await trio.sleep(100)
        await upload.abort()
        with pytest.raises(AlreadyExists):
            await store.create_empty(target, free_at=LONG_AGO)
        assert here.tree.data(target) == b"theirs"
        await store.create_empty(target)
        assert here.tree.data(target) == b""
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_free_name_costs_one_request_unless_it_was_just_seen(
    profile: str, autojump: MockClock
) -> None:
    here = world(profile, there=b"theirs")
    faults = Faults(here)
    async with here.connection() as connection:
        now = trio.current_time()
        for name, free_at, looks in (("a", now - FREE_FOR / 2, 0), ("b", LONG_AGO, 1), ("c", None, 0)):
            faults.requests.clear()
            source, target = MemorySource(b"ours"), path(profile, name)
            upload = await connection.store.open_upload(target, source, create=True, free_at=free_at)
            await upload.finish()
            assert upload.begun
            assert faults.requests.count(Opcode.OPEN_FILE_RO) == looks
            assert here.tree.data(target) == b"ours"
            await upload.abort()
            await connection.store.create_empty(path(profile, name + "-empty"), free_at=free_at)
            assert here.tree.data(path(profile, name + "-empty")) == b""


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_what_was_given_up_while_its_name_is_looked_for_makes_nothing(
    profile: str, autojump: MockClock
) -> None:
    """Who gave it up may not have waited for its end, and would take what is there for somebody else's."""
    here, target = world(profile, LinkSettings(delay=0.05), there=b"theirs"), path(profile, "new")
    faults = Faults(here)
    async with here.connection() as connection:
        store, source = connection.store, MemorySource(b"ours")
        upload = await store.open_upload(target, source, create=True, free_at=LONG_AGO)
        upload.wake()
        while Opcode.OPEN_FILE_RO not in faults.requests:  # noqa: ASYNC110 - the vehicle tells nobody
            await trio.sleep(0.001)
        with trio.move_on_after(0):
            await upload.abort()
        await trio.sleep(10)
        assert not upload.begun
        assert b"new" not in [entry.name for entry in here.tree.entries(path(profile, "")[:-1])]
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_repeated_attempt_is_our_own(profile: str, autojump: MockClock) -> None:
    """The link fails after CreateFile: the file that is there afterwards is ours."""
    here = world(profile, there=b"theirs")
    faults = Faults(here)
    async with here.connection() as connection:
        source, target = MemorySource(b"ours" * 100), path(profile, "new")
        upload = await connection.store.open_upload(target, source, create=True, free_at=LONG_AGO)
        faults.cut_after(2)
        with pytest.raises(MavftpfsError):
            await upload.finish()
        assert here.tree.data(target) == b""
        faults.cut_after(None)
        await upload.finish()
        assert here.tree.data(target) == b"ours" * 100


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "px4-2026"])
async def test_a_sticky_file_exists_does_not_look_like_a_file(profile: str, autojump: MockClock) -> None:
    here = world(profile, there=b"theirs")

    async with here.connection() as connection:
        for name in ("new", "empty"):
            directory = path(profile, "")[:-1]
            with pytest.raises(FtpNak):
                await connection.store.make_directory(directory)
            target = path(profile, name)
            if name == "empty":
                await connection.store.create_empty(target, free_at=LONG_AGO)
            else:
                source = MemorySource(b"ours")
                upload = await connection.store.open_upload(target, source, create=True, free_at=LONG_AGO)
                await upload.finish()
            assert here.tree.data(target) in (b"", b"ours")
