"""Uploads against every profile over bad links, on virtual time."""

from __future__ import annotations

import random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.sources import MemorySource
from tests.support.worlds import GOOD_LINK, ROOTS, World, read_file

EVERY_PROFILE = sorted(PROFILES)
BAD = LinkSettings(rate=60_000.0, delay=0.02, loss=0.1, duplicate=0.02, reorder=0.05)
PLAIN = LinkSettings(rate=60_000.0, delay=0.02)


def content(size: int, seed: int = 0) -> bytes:
    return random.Random(seed).randbytes(size)


def path(profile: str, name: str) -> bytes:
    return ROOTS.get(profile, b"") + b"/d/" + name.encode()


def probes(profile: str) -> tuple[bytes, bytes]:
    return path(profile, ".mavftpfs-aaaadaaa"), path(profile, ".mavftpfs-aaaadaab")


def world(profile: str, settings: LinkSettings = GOOD_LINK, **files: bytes) -> World:
    made = World(profile, settings)
    made.tree.add_directory(path(profile, "")[:-1])
    for name, data in files.items():
        made.tree.add(path(profile, name), data)
    return made


async def put(connection: Connection, target: bytes, data: bytes) -> MemorySource:
    """Upload a whole file."""
    source = MemorySource(data)
    upload = await connection.store.open_upload(target, source, create=True)
    await upload.finish()
    assert source.all_proven
    await upload.abort()
    return source


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_what_is_on_the_card_is_what_was_given(profile: str, autojump: MockClock) -> None:
    sizes = (0, 1, 238, 239, 240, 478, 5000, 60_000)
    here = world(profile, BAD, f1=b"something older and longer")
    async with here.connection() as connection:
        for size in sizes:
            await put(connection, path(profile, f"f{size}"), content(size, size))
            assert here.tree.data(path(profile, f"f{size}")) == content(size, size)
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_small_file_costs_create_write_terminate(profile: str, autojump: MockClock) -> None:
    here = world(profile)
    async with here.connection() as connection:
        await put(connection, path(profile, "small"), b"hello")
        assert connection.engine.stats.by_opcode == {
            Opcode.CREATE_FILE: 1,
            Opcode.WRITE_FILE: 1,
            Opcode.TERMINATE_SESSION: 1,
        }


@pytest.mark.parametrize("profile", EVERY_PROFILE)
@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
async def test_two_uploads_and_a_reader_at_once(profile: str, probed: bool, autojump: MockClock) -> None:
    here = world(profile, LinkSettings(rate=60_000.0, delay=0.02, loss=0.03), old=content(40_000, 9))
    got: list[bytes] = []
    async with here.connection() as connection:
        if probed:
            await connection.store.probe_open_for_write(*probes(profile))
        async with trio.open_nursery() as nursery:

            async def read() -> None:
                got.append(await read_file(connection, path(profile, "old")))

            nursery.start_soon(read)
            for index in range(2):
                nursery.start_soon(put, connection, path(profile, f"f{index}"), content(60_000, index))
    assert got == [content(40_000, 9)]
    for index in range(2):
        assert here.tree.data(path(profile, f"f{index}")) == content(60_000, index)
    assert here.vehicle.server.open_sessions == 0
    assert [entry.name for entry in here.tree.entries(path(profile, "")) if b"mavftpfs" in entry.name] == []


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_the_probe_learns_what_the_profile_says(profile: str, autojump: MockClock) -> None:
    here = world(profile, LinkSettings(rate=60_000.0, delay=0.02, loss=0.05))
    facts = PROFILES[profile]
    async with here.connection() as connection:
        await connection.store.probe_open_for_write(*probes(profile))
        traits = connection.store.traits
        assert traits.wo_truncates is facts.write_only_truncates
        assert traits.wo_creates is (facts.write_only_creates or facts.name == "spec")
        assert traits.rename_works is (facts.storage.value != "littlefs")
        assert traits.truncate_works is (facts.truncate_file and profile != "px4-nuttx")
        if traits.rename_works:
            assert traits.rename_replaces is (facts.storage.value != "fatfs")
    assert here.tree.entries(path(profile, ""))[2:] == []
    assert here.vehicle.server.open_sessions == 0
