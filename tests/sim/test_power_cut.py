"""The power, or the link and the mount, go after any request of a change, on every simulated server.

The next mount finds the old file or the new one, whole, and leaves nothing of ours behind.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from random import Random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.spool import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import Faults
from tests.support.mounting import writable_tree
from tests.support.trees import content
from tests.support.worlds import ROOTS, World

OLD, NEW = content("old", 900), content("new", 700)
CUT = 300
CHANGED = OLD[:200] + NEW[:100] + OLD[300:]
QUICK = ConnectOptions(op_deadline=8.0)
MOST_REQUESTS = 60
NO_RENAME = "littlefs"
"""Without rename nothing can be replaced in one step: whoever mounts it inplace has chosen that."""


async def bring(file: OpenFile, at: int, data: bytes) -> None:
    """Write, and close, which fails if the card does not get it."""
    try:
        await file.write(at, data)
        await file.flush()
    finally:
        await file.release()


async def replace(tree: Tree, path: bytes) -> None:
    """What cp does to a file that exists."""
    await bring(await tree.open(path, write=True, truncate=True), 0, NEW)


async def create(tree: Tree, path: bytes) -> None:
    """What cp does to a new file; it never had another content than none or this."""
    await tree.unlink(path)
    await bring(await tree.create(path, exclusive=True), 0, NEW)


async def change(tree: Tree, path: bytes) -> None:
    """A few bytes in the middle."""
    await bring(await tree.open(path, write=True), 200, NEW[:100])


async def cut(tree: Tree, path: bytes) -> None:
    """truncate(2)."""
    await tree.truncate(path, CUT)


JOBS: dict[str, tuple[Callable[[Tree, bytes], Awaitable[None]], bytes]] = {
    "replace": (replace, NEW),
    "create": (create, NEW),
    "change": (change, CHANGED),
    "truncate": (cut, OLD[:CUT]),
}


def is_allowed(job: str, kept: bytes | None) -> bool:
    """Return whether a file may be left like this, None: not there."""
    if job == "create":
        return kept is None or kept == OLD or NEW.startswith(kept)
    if job == "change" and kept is not None:  # in place, byte by byte, as on a local disk
        return len(kept) == len(OLD) and all(k in (o, c) for k, o, c in zip(kept, OLD, CHANGED, strict=True))
    return kept in (OLD, JOBS[job][1])


@asynccontextmanager
async def mounted(connection: Connection, place: Path, seed: int, *, inplace: bool) -> AsyncIterator[Tree]:
    """What a mount has over a connection; its end is that of the process."""
    spool = SpoolDirectory(place, Random(seed))
    async with trio.open_nursery() as nursery:
        yield writable_tree(connection, nursery, seed=seed, spool=spool, inplace=inplace, op_deadline=8.0)
        nursery.cancel_scope.cancel()
    spool.close()


def kept_by(here: World, path: bytes) -> bytes | None:
    """Return what is on the card."""
    try:
        return here.tree.data(path)
    except FileNotFoundError:
        return None


async def cut_after(count: int, profile: str, job: str, place: Path) -> bool:
    """Make a change of which `count` requests arrive, mount anew and look; return whether it was done."""
    here = World(profile)
    folder = ROOTS.get(profile, b"") + b"/d"
    path = folder + b"/file"
    here.tree.add(path, OLD)
    faults = Faults(here)
    inplace = profile == NO_RENAME
    async with here.connection(QUICK) as connection, mounted(connection, place, 1, inplace=inplace) as tree:
        await tree.list(folder)
        faults.cut_after(count)
        try:
            await JOBS[job][0](tree, path)
            done = True
        except MavftpfsError:
            done = False
        here.link.cut()  # or leaving would tidy up
    faults.cut_after(None)
    here.vehicle.reboot(trio.current_time())
    here.link.restore()
    async with here.connection(seed=9) as connection, mounted(connection, place, 2, inplace=inplace) as tree:
        for _ in range(2):
            await tree.list(folder)
            await trio.sleep(5)
            tree.forget_caches()
        shown = [name for name, _ in await tree.list(folder)]
    names = [entry.name for entry in here.tree.entries(folder) if not entry.name.startswith(b"..")]
    assert [name for name in names if is_reserved(name)] == [], f"after request {count}"
    kept = kept_by(here, path)
    assert is_allowed(job, kept) or inplace, f"after request {count}: {kept and len(kept)} bytes"
    assert shown == ([b"file"] if kept is not None else [])
    if done:
        assert kept == JOBS[job][1], f"success was said after request {count}"
    return done


SHORT = {("px4", "replace"), ("px4-nuttx", "replace"), ("mavsdk", "replace"), ("ardupilot", "truncate")}
CASES = [
    pytest.param(profile, job, marks=() if (profile, job) in SHORT else pytest.mark.soak)
    for profile in sorted(PROFILES)
    for job in JOBS
]


@pytest.mark.holds("promise 3", "fault power")
@pytest.mark.parametrize(("profile", "job"), CASES)
async def test_the_next_mount_finds_one_whole_file(
    profile: str, job: str, tmp_path: Path, autojump: MockClock
) -> None:
    for count in range(MOST_REQUESTS):
        if await cut_after(count, profile, job, tmp_path / str(count)):
            return
    raise AssertionError("it was never done")
