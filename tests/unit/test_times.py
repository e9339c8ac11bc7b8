"""Times that programs set and no server stores, at files that are written."""

from __future__ import annotations

import pytest

from mavftpfs.cache.tree import Tree
from tests.support.fake_writer import FakeWriter, card, write_file

DATA = bytes(range(256)) * 300
FILE = b"/card/dir/file.bin"


store = card({FILE: DATA})


async def test_times_are_kept_until_the_file_changes(store: FakeWriter, tree: Tree) -> None:
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, b"data")
    await tree.set_times(FILE, 1_234_567_890_123_456_789)
    await file.release()
    for _ in range(2):
        stat = await tree.stat(FILE)
        assert stat.mtime_ns == 1_234_567_890_123_456_789
        tree.forget_caches()
    store.files[FILE].mtime = 1_600_000_000  # a server that tells mtimes has its own idea
    tree.forget_caches()
    assert (await tree.stat(FILE)).mtime == 1_234_567_890
    store.files[FILE].mtime = 1_600_000_001
    tree.forget_caches()
    assert (await tree.stat(FILE)).mtime == 1_600_000_001


async def test_times_follow_a_rename_and_end_with_another_size(store: FakeWriter, tree: Tree) -> None:
    await write_file(tree, b"/card/.file.tmp", b"data")
    await tree.set_times(b"/card/.file.tmp", 5 * 10**9)
    await tree.rename(b"/card/.file.tmp", FILE)
    assert (await tree.stat(FILE)).mtime == 5
    store.files[FILE].data += b"x"
    tree.forget_caches()
    assert (await tree.stat(FILE)).mtime != 5


@pytest.mark.parametrize("listed", [None, 1_500_000_000])
@pytest.mark.parametrize("data", [b"", b"data"])
async def test_what_is_made_and_written_shows_the_time_of_day(
    store: FakeWriter, tree: Tree, data: bytes, listed: int | None
) -> None:
    """Where the vehicle tells none, too: make(1) compares them, `git gc` removes at once what is of 1980."""
    store.files[FILE].mtime = listed
    file = await tree.create(b"/card/dir/new", exclusive=True)
    assert (await tree.stat(b"/card/dir/new")).mtime == 1_700_000_000
    if data:
        await file.write(0, data)
    await file.release()
    file.close()
    await write_file(tree, FILE, data)
    await tree.rename(b"/card/dir/new", b"/card/other")
    for _ in range(2):
        for path in (FILE, b"/card/other"):
            assert (await tree.stat(path)).mtime == 1_700_000_000
        tree.forget_caches()


@pytest.mark.parametrize("data", [b"", b"data"])
@pytest.mark.parametrize("listed", [None, 1_500_000_000])
async def test_a_listing_while_a_file_is_written_does_not_end_its_time(
    store: FakeWriter, tree: Tree, data: bytes, listed: int | None
) -> None:
    """It shows the file as it was; `cp -p` and `tar` set the time before they close."""
    store.files[FILE].mtime = listed
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, data)
    await tree.set_times(FILE, 5 * 10**9)
    await tree.list(b"/card/dir")
    await file.release()
    file.close()
    assert (await tree.stat(FILE)).mtime == 5
    tree.forget_caches()
    assert dict(await tree.list(b"/card/dir"))[b"file.bin"].mtime == 5
