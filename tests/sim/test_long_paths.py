"""Paths so long that requests do not carry what short ones do, through the caches, on simulated servers."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable

import pytest
from trio.testing import MockClock

from mavftpfs.cache.reserved import RENAME_ROOM, is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import CrossDevice, MavftpfsError, PathTooLong
from mavftpfs.shared.model import join, split
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import Kind
from tests.support.fake_store import read_file
from tests.support.fake_writer import write_file
from tests.support.faults import Faults
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World

pytestmark = pytest.mark.holds("fault odd listing")

RENAMING = sorted(name for name in PROFILES if name != "littlefs")
OLD = random.Random(1).randbytes(700)
NEW = random.Random(2).randbytes(900)
CHANGING = {
    Opcode.CREATE_FILE,
    Opcode.OPEN_FILE_WO,
    Opcode.WRITE_FILE,
    Opcode.REMOVE_FILE,
    Opcode.CREATE_DIRECTORY,
    Opcode.REMOVE_DIRECTORY,
    Opcode.TRUNCATE_FILE,
    Opcode.RENAME,
}


def long_path(profile: str, length: int, last: bytes = b"x", name: int = 40) -> bytes:
    """A path of `length` bytes in many directories, with a name of at most `name` bytes."""
    path = ROOTS.get(profile, b"") + b"/d"
    while length - len(path) > name:
        path += b"/directory-%02d" % (len(path) % 100)
    return path + b"/" + b"n" * (length - len(path) - 2) + last


def everything(here: World, directory: bytes = b"/") -> list[bytes]:
    found = []
    for entry in here.tree.entries(directory):
        path = join(directory, entry.name)
        if entry.name in (b".", b".."):
            continue
        found.append(path)
        if here.tree.stat(path).kind is Kind.DIRECTORY:
            found += everything(here, path)
    return found


def watched(here: World) -> list[tuple[int, bytes]]:
    """The opcodes and data of requests from now on."""
    server = here.vehicle.server
    requests: list[tuple[int, bytes]] = []
    handle = server.handle

    def watch(wire: bytes, source: Address, now: float) -> None:
        requests.append((wire[3], wire[12 : 12 + wire[4]]))
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]
    return requests


async def append(tree: Tree, path: bytes, data: bytes) -> None:
    file = await tree.open(path, write=True)
    await file.write(file.size, data)
    await file.release()


@pytest.mark.parametrize("length", [100, 118, 119, 180, 200])
@pytest.mark.parametrize("profile", RENAMING)
async def test_everything_works_up_to_200_bytes(profile: str, length: int, autojump: MockClock) -> None:
    here = World(profile)
    path, other = long_path(profile, length), long_path(profile, length, b"y")
    here.tree.add_directory(split(path)[0])
    before = set(everything(here))
    async with mounted(here) as (_, tree):
        await write_file(tree, path, OLD)
        assert here.tree.data(path) == OLD
        await write_file(tree, path, NEW)
        assert here.tree.data(path) == NEW
        await append(tree, path, OLD)
        assert here.tree.data(path) == NEW + OLD
        await tree.truncate(path, 1000)
        assert here.tree.data(path) == (NEW + OLD)[:1000]
        await tree.truncate(path, 0)
        await write_file(tree, path, NEW)
        if 2 * length + 1 <= RENAME_ROOM:
            await tree.rename(path, other, noreplace=False)
            assert here.tree.data(other) == NEW
            assert path not in everything(here)
            await write_file(tree, path, OLD)
            await tree.rename(path, other, noreplace=False)
        else:
            with pytest.raises(CrossDevice):  # mv copies then
                await tree.rename(path, other, noreplace=False)
            await write_file(tree, other, OLD)
            await tree.unlink(path)
        reading = await tree.open(other)
        await tree.unlink(other)
        await reading.release()
        for directory in [p for p in everything(here) if here.tree.stat(p).kind is Kind.DIRECTORY]:
            await tree.list(directory)
    assert set(everything(here)) == before


@pytest.mark.parametrize("name", [16, 90])
@pytest.mark.parametrize("length", [118, 119, 200])
@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_the_first_change_may_be_an_append(
    profile: str, length: int, name: int, autojump: MockClock
) -> None:
    """What is tried out beforehand needs names of its own, in or above a directory with a long path."""
    here = World(profile)
    path = long_path(profile, length, name=name)
    here.tree.add(path, OLD)
    before = set(everything(here))
    async with mounted(here, inplace=True) as (_, tree):
        await append(tree, path, NEW)
    assert here.tree.data(path) == OLD + NEW
    assert set(everything(here)) == before


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_230_bytes_are_refused_before_anything_is_changed(profile: str, autojump: MockClock) -> None:
    here = World(profile)
    path, new = long_path(profile, 230), long_path(profile, 230, b"y")
    here.tree.add(path, OLD)
    requests = watched(here)
    short = ROOTS.get(profile, b"") + b"/d/short"
    here.tree.add(short, NEW)

    async def replace(tree: Tree) -> None:
        await write_file(tree, path, NEW)

    acts: list[Callable[[Tree], Awaitable[object]]] = [
        replace,
        lambda tree: tree.create(new, exclusive=True),
        lambda tree: append(tree, path, b"more"),
        lambda tree: tree.truncate(path, 10),
        lambda tree: tree.truncate(path, 0),
        lambda tree: tree.rename(path, short, noreplace=False),
        lambda tree: tree.rename(short, new, noreplace=False),
        lambda tree: tree.unlink(path),
        lambda tree: tree.mkdir(new),
        lambda tree: read_file(tree, path),
    ]
    async with mounted(here) as (_, tree):
        for act in acts:
            with pytest.raises(PathTooLong):
                await act(tree)
        assert tree.undelivered() == []
    assert not CHANGING & {opcode for opcode, _ in requests}
    assert here.tree.data(path) == OLD


@pytest.mark.parametrize("profile", ["px4", "mavsdk", "ardupilot"])
async def test_a_replacement_may_be_interrupted_anywhere(profile: str, autojump: MockClock) -> None:
    """The next listing by the same mount removes what was left; a directory with it can be removed."""
    path = long_path(profile, 60)
    for number in range(1, 8):
        here = World(profile)
        here.tree.add(path, OLD)
        faults = Faults(here)
        async with mounted(here) as (_, tree):
            await tree.list(split(path)[0])
            file = await tree.open(path, write=True)
            await file.write(file.size, b"more")
            faults.cut_after(number)
            with pytest.raises(MavftpfsError):
                await file.flush()
            faults.cut_after(None)
            await tree.unlink(path)
            await file.release()
            await tree.rmdir(split(path)[0])
        assert not [p for p in everything(here) if is_reserved(split(p)[1])]
