"""Times that programs set and no server stores, at files that are written."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import Tree
from tests.support.rigs import EPOCH, Rig, card, write_file

SECOND = 10**9
DATA = bytes(range(256)) * 3
FOLDER, FILE, NEW, OTHER = b"/d", b"/d/file.bin", b"/d/new", b"/other"

here = card({FILE: DATA}, profiles=["px4", "mavsdk"])


@pytest.fixture
def tree(here: Rig) -> Tree:
    """A mount; listings tell times on one of the servers."""
    return here.mount()


async def seconds(tree: Tree, path: bytes) -> int | None:
    mtime = (await tree.stat(path)).mtime_ns
    return None if mtime is None else mtime // SECOND


@pytest.mark.parametrize("data", [b"", b"data"])
async def test_times_are_kept_until_the_file_changes(here: Rig, tree: Tree, data: bytes) -> None:
    """`cp -p` and `tar` set the time before they close; a listing meanwhile shows the file as it was."""
    time = 1_234_567_890_123_456_789
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, data)
    await tree.set_times(FILE, time)
    tree.forget_caches()
    await tree.list(FOLDER)
    await file.release()
    for _ in range(2):
        assert (await tree.stat(FILE)).mtime_ns == time
        assert dict(await tree.list(FOLDER))[b"file.bin"].mtime_ns == time
        tree.forget_caches()
    if here.profile != "px4":
        here.put(FILE, data, 1_600_000_000)  # a server that tells mtimes has its own idea
        tree.forget_caches()
        assert await seconds(tree, FILE) == 1_600_000_000


async def test_times_follow_a_rename_and_end_with_another_size(here: Rig, tree: Tree) -> None:
    await write_file(tree, NEW, b"data")
    await tree.set_times(NEW, 5 * SECOND)
    await tree.rename(NEW, FILE)
    assert await seconds(tree, FILE) == 5
    here.put(FILE, b"data and more")
    tree.forget_caches()
    assert await seconds(tree, FILE) != 5


@pytest.mark.parametrize("data", [b"", b"data"])
async def test_what_is_made_and_written_shows_the_time_of_day(here: Rig, tree: Tree, data: bytes) -> None:
    """The mount shows that time where the vehicle tells none, because make(1) compares times, and `git gc`
    removes objects of 1980 at once."""
    await trio.sleep(100)
    now = EPOCH + trio.current_time()
    file = await tree.create(NEW, exclusive=True)
    assert await seconds(tree, NEW) == pytest.approx(now, abs=2)
    if data:
        await file.write(0, data)
    await file.release()
    await write_file(tree, FILE, data)
    await tree.rename(NEW, OTHER)
    for _ in range(2):
        for path in (FILE, OTHER):
            assert await seconds(tree, path) == pytest.approx(now, abs=2)
        tree.forget_caches()
