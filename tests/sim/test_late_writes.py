"""A WriteFile of one file that comes once more, later than is feared, when another file is being written.

It names no file, so the server writes it to the one that is open; its answer is all that tells. What is
believed then: the right bytes, or an error.
"""

from __future__ import annotations

import errno

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.echoes import QUIET
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import DataUnproven
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.sim.test_doubted_bytes import CLEAN, DOUBLING, KEEPING
from tests.support.latecomers import Latecomer
from tests.support.mounting import mounted
from tests.support.takingturns import taking_turns
from tests.support.worlds import World, content, path, world

EVERY_PROFILE = sorted(PROFILES)
LONG = QUIET[1] + 3.0
"""Seconds: no copy is feared any more."""


async def change(tree: Tree, name: bytes, at: int, data: bytes) -> None:
    """Change a part of a file, and close it."""
    file = await tree.open(name, write=True)
    try:
        await file.write(at, data)
        await file.flush()
    finally:
        file.close()


async def make(tree: Tree, name: bytes, data: bytes) -> None:
    """Make a file, and close it."""
    file = await tree.create(name, exclusive=True)
    try:
        await file.write(0, data)
        await file.flush()
    finally:
        file.close()


async def overtaken(
    here: World, tree: Tree, name: bytes, *changes: bytes, at: int = 1000, late: float = LONG
) -> Latecomer:
    """Change the bytes from `at` on in turn, and let time pass; the first of these comes once more with the
    next WriteFile."""
    await change(tree, name, 1, b"x")
    await trio.sleep(LONG)
    copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, first=True, nth=99)
    for data in changes:
        await change(tree, name, at, data)
    await trio.sleep(late)
    copy.rearm(Opcode.WRITE_FILE)
    return copy


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_what_was_tried_out_is_not_written_to_the_users_file(profile: str, autojump: MockClock) -> None:
    """On a link that was seen to double: the few bytes are fetched before, and written back."""
    old, name = content(20_000), path(profile, "f")
    here = world(profile, DOUBLING, f=old)
    async with mounted(here, path(profile, "")[:-1]) as (connection, tree):
        while not connection.engine.stats.strays:
            await connection.store.list_directory(path(profile, "")[:-1])
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, first=True)
        await change(tree, name, 5000, b"new")
        assert copy.late is not None
        assert copy.late >= QUIET[0]
        assert here.tree.data(name) == old[:5000] + b"new" + old[5003:]


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_bytes_that_only_the_vehicle_had_are_an_error(profile: str, autojump: MockClock) -> None:
    """Where nothing had come twice before they were not fetched; the error stays until they are written."""
    old, name = content(20_000), path(profile, "f")
    here = world(profile, CLEAN, f=old)
    async with mounted(here, path(profile, "")[:-1]) as (_, tree):
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, first=True)
        file = await tree.open(name, write=True)
        await file.write(5000, b"new")
        for _ in range(2):
            with pytest.raises(DataUnproven) as caught:
                await file.flush()
            assert errno_for(caught.value) == errno.EIO
        assert "bytes 0 to 2 " in str(caught.value)
        for reader in (file, await tree.open(name)):
            with pytest.raises(DataUnproven):
                await reader.read(0, 10)
            assert await reader.read(3, 10) == old[3:13]
        assert copy.late is not None
        await file.write(0, b"own")
        await file.flush()
        file.close()
        assert here.tree.data(name) == b"own" + old[3:5000] + b"new" + old[5003:]


@pytest.mark.parametrize("link", [CLEAN, DOUBLING])
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_another_files_bytes_are_never_kept_silently(
    profile: str, link: LinkSettings, autojump: MockClock
) -> None:
    old = content(20_000)
    here = world(profile, link, f=old, g=old)
    f, g = path(profile, "f"), path(profile, "g")
    async with mounted(here, path(profile, "")[:-1]) as (_, tree):
        copy = await overtaken(here, tree, f, b"of f" * 500)
        with pytest.raises(DataUnproven):
            await change(tree, g, 9000, b"of g")
        assert copy.late is not None
        assert copy.late > LONG
        await change(tree, g, 900, b"g" * 400)  # it covers what was hit
        assert here.tree.data(g) == old[:900] + b"g" * 400 + old[1300:9000] + b"of g" + old[9004:]
        assert here.tree.data(f) == old[:1] + b"x" + old[2:1000] + b"of f" * 500 + old[3000:]


@pytest.mark.parametrize("verify", ["auto", "size", "none"])
@pytest.mark.parametrize("size", [100, 6000])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_file_that_is_sent_whole_is_right(
    profile: str, size: int, verify: str, autojump: MockClock
) -> None:
    """A copy of bytes that lie within it, or beyond its end."""
    here = world(profile, CLEAN)
    one, two = path(profile, "one"), path(profile, "two")
    async with mounted(here, path(profile, "")[:-1], verify=verify) as (_, tree):
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, nth=99)
        await make(tree, one, content(3000, 1))
        await trio.sleep(LONG)
        copy.rearm(Opcode.WRITE_FILE, nth=1 + size // 239)
        await make(tree, two, content(size, 2))
        assert copy.late is not None
        assert copy.late > LONG
        assert here.tree.data(two) == content(size, 2)


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_an_earlier_change_of_the_same_file_harms_nothing(profile: str, autojump: MockClock) -> None:
    old, name = content(20_000), path(profile, "f")
    here = world(profile, CLEAN, f=old)
    async with mounted(here, path(profile, "")[:-1]) as (_, tree):
        copy = await overtaken(here, tree, name, b"1" * 100, late=20.0)
        await change(tree, name, 1050, b"2" * 10)
        assert copy.late is not None
        new = old[:1] + b"x" + old[2:1000] + b"1" * 50 + b"2" * 10 + b"1" * 40 + old[1100:]
        assert here.tree.data(name) == new


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_change_that_was_overtaken_is_an_error(profile: str, autojump: MockClock) -> None:
    """The same file, but these bytes were written again since, and only the vehicle has them."""
    name = path(profile, "f")
    here = world(profile, CLEAN, f=content(20_000))
    async with mounted(here, path(profile, "")[:-1]) as (_, tree):
        copy = await overtaken(here, tree, name, b"1" * 100, b"2" * 100, late=20.0)
        with pytest.raises(DataUnproven):
            await change(tree, name, 5000, b"3")
        assert copy.late is not None


@pytest.mark.parametrize("verify", ["auto", "size", "none"])
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_file_that_a_copy_made_longer_gets_its_size_back(
    profile: str, verify: str, autojump: MockClock
) -> None:
    """What only the vehicle had is as it was: the copy hit what was sent, and what lies behind the end."""
    old = content(20_000)
    here = world(profile, CLEAN, f=old, g=old[:1000])
    f, g = path(profile, "f"), path(profile, "g")
    inplace = profile == "littlefs"  # it can neither cut nor rename
    async with mounted(here, path(profile, "")[:-1], verify=verify, inplace=inplace) as (_, tree):
        copy = await overtaken(here, tree, f, b"of f" * 50, at=900)
        await change(tree, g, 20, b"of g" * 245)
        assert copy.late is not None
        assert here.tree.data(g) == old[:20] + b"of g" * 245


@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_what_was_closed_and_written_again_at_once(profile: str, autojump: MockClock) -> None:
    """The copy's answer is lost, so nothing tells that it came; but this link loses and doubles."""
    old, name = content(20_000), path(profile, "f")
    here = world(profile, DOUBLING, f=old)
    async with mounted(here, path(profile, "")[:-1]) as (connection, tree):
        await change(tree, name, 1, b"x")
        await trio.sleep(LONG)
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.WRITE_FILE, first=True, nth=99, mute=True)
        await change(tree, name, 1000, b"1" * 100)
        assert connection.engine.stats.strays
        copy.rearm(Opcode.WRITE_FILE)
        await change(tree, name, 1000, b"2" * 100)
        assert copy.late is not None
        assert here.tree.data(name) == old[:1] + b"x" + old[2:1000] + b"2" * 100 + old[1100:]


@pytest.mark.parametrize("verify", ["auto", "size", "none"])
@pytest.mark.parametrize("profile", taking_turns([name for name in EVERY_PROFILE if name != "littlefs"]))
async def test_a_file_that_is_emptied_after_it_was_checked_is_sent_again(
    profile: str, verify: str, autojump: MockClock
) -> None:
    """A replacement gets its name last (LittleFS has none), and by then the answer is there."""
    name = path(profile, "f")
    here = world(profile, CLEAN, f=content(5000))
    async with mounted(here, path(profile, "")[:-1], verify=verify) as (_, tree):
        server = here.vehicle.server
        handle = server.handle
        kept: list[bytes] = []

        def on_request(wire: bytes, source: Address, now: float) -> None:
            if wire[3] == Opcode.CREATE_FILE and not kept:
                kept.append(wire)
            if wire[3] == Opcode.RENAME and len(kept) == 1:
                kept.append(wire)
                handle(kept[0], source, now)
            handle(wire, source, now)

        server.handle = on_request  # type: ignore[method-assign]
        file = await tree.open(name, write=True, truncate=True)
        await file.write(0, content(4000, 2))
        await file.flush()
        file.close()
        assert len(kept) == 2
        assert here.tree.data(name) == content(4000, 2)
