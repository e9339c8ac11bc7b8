"""Calls that overlap, as random calls on a real mount met them: each test is one such meeting."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, NotFound, NotSupported
from tests.support.fake_writer import KINDS, FakeWriter, make_writable, write_file

FILE = b"/d/file"


@pytest.mark.holds("fault overlap")
async def test_a_truncation_while_the_last_writer_is_being_released(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    """The kernel releases a file after close() returned: the next call may overlap with it."""
    for kind in KINDS.values():
        for pause in (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5):
            store = FakeWriter(kind, nursery)
            store.add_directory(b"/d")
            store.write_delay = 0.1
            tree = make_writable(store, inplace=True)
            await write_file(tree, FILE, b"x" * 700)
            file = await tree.open(FILE, write=True)
            await file.write(100, b"y" * 300)
            async with trio.open_nursery() as both:
                both.start_soon(file.release)
                await trio.sleep(pause)
                await tree.truncate(FILE, 250)
            assert (await tree.stat(FILE)).size == 250
            assert await tree.drain(60) == []
            assert store.files[FILE].data == b"x" * 100 + b"y" * 150
            assert tree.status()["files_undelivered"] == 0


class StaleErrno(FakeWriter):
    """LittleFS below ArduPilot: no rename, and its refusal says what an earlier request failed of."""

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        await self.request("rename", old, new)
        raise FtpNak(Opcode.RENAME, NakCode.FILE_EXISTS)


async def test_a_stale_refusal_shows_too_that_there_is_no_rename(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    store = StaleErrno(KINDS["littlefs"], nursery)
    store.add_directory(b"/d")
    store.add(FILE, b"old" * 100)
    tree = make_writable(store, inplace=True)
    await write_file(tree, FILE, b"new" * 200)
    assert store.files[FILE].data == b"new" * 200
    assert (store.traits.rename_works, store.traits.rename_replaces) == (False, None)
    careful = make_writable(store)
    with pytest.raises(NotSupported):
        await write_file(careful, FILE, b"newer")
    assert store.files[FILE].data == b"new" * 200


@pytest.mark.holds("fault full card")
async def test_overwriting_in_place_that_failed_goes_on_later(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    """What lies there is the old file, or a part of the new one: nobody else's."""
    store = FakeWriter(KINDS["littlefs"], nursery)
    store.add_directory(b"/d")
    store.add(FILE, b"old" * 300)
    tree = make_writable(store, inplace=True)
    await write_file(tree, FILE, b"newer" * 200)
    for number in range(1, 4):
        store.fail_at[store.requests + number] = FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 5)
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, b"%d" % number * 700)
        with pytest.raises(FtpNak):
            await file.flush()
        await trio.sleep(100)
        await file.flush()
        assert store.files[FILE].data == b"%d" % number * 700
        await file.release()


OPENINGS = {
    "reader": lambda tree: tree.open(FILE),
    "writer": lambda tree: tree.open(FILE, write=True),
    "emptier": lambda tree: tree.open(FILE, write=True, truncate=True),
}
OTHER, NEW = b"/d/other", b"new" * 300
"""As long as the old content: no size tells them apart."""


async def program(tree: Tree, opening: Callable[[Tree], Awaitable[OpenFile]], later: float) -> None:
    """Open at that time, use it and close; that there is no such file is the only excuse."""
    await trio.sleep(later)
    try:
        file = await opening(tree)
    except NotFound:
        return
    old = bytes(await file.read(0, 900))
    assert old in (b"old" * 300, NEW, b"")
    if file.writable:
        await file.write(3, b"mid")
        assert await file.read(0, 900) == old[:3].ljust(3, b"\0") + b"mid" + old[6:]
    await file.release()


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("change", ["unlink", "rename over", "rename"])
@pytest.mark.parametrize("opening", sorted(OPENINGS))
@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"littlefs"}))
async def test_a_file_is_opened_before_or_after_its_name_is_changed(
    nursery: trio.Nursery, autojump_clock: object, kind: str, opening: str, change: str
) -> None:
    """Not meanwhile: who opened would hold neither the old file nor the new one."""
    for later in range(-10, 14):
        store = FakeWriter(KINDS[kind], nursery)
        store.add(FILE, b"old" * 300)
        store.add(OTHER, NEW)
        tree = make_writable(store)
        await tree.list(b"/d")
        store.write_delay = store.list_delay = 0.1
        store.open_delay = 0.25
        async with trio.open_nursery() as both:
            both.start_soon(program, tree, OPENINGS[opening], max(later, 0) * 0.05)
            await trio.sleep(max(-later, 0) * 0.05 + 0.001)
            if change == "unlink":
                await tree.unlink(FILE)
            elif change == "rename":
                await tree.rename(FILE, OTHER)
            else:
                await tree.rename(OTHER, FILE)
        await trio.sleep(60)
        assert tree.undelivered() == []
        left = {path: file.data for path, file in store.files.items()}
        there = {"unlink": OTHER, "rename": OTHER, "rename over": FILE}[change]
        assert sorted(left) == [there]
        base = {"unlink": NEW, "rename": b"old" * 300, "rename over": NEW}[change]
        written = () if change == "unlink" else (base[:3] + b"mid" + base[6:], b"\0\0\0mid")
        assert left[there] in (base, *written)
        assert store.crimes == []


# --- reading while names change


async def read_slowly(store: FakeWriter, file: OpenFile, expected: bytes) -> None:
    """Read what takes a while, as a program that copies does."""
    store.chunk_delay = 0.1
    assert bytes(await file.read(0, len(expected))) == expected
    store.chunk_delay = 0.0


@pytest.mark.parametrize("kind", ["posix", "fat"])
async def test_a_read_under_way_goes_on_when_the_file_is_renamed(
    nursery: trio.Nursery, autojump_clock: object, kind: str
) -> None:
    old = bytes(range(256)) * 100
    for later in range(20):
        store = FakeWriter(KINDS[kind], nursery)
        store.add(FILE, old)
        store.add(OTHER, b"n" * len(old))
        tree = make_writable(store)
        store.chunk, store.write_delay = 4096, 0.1
        file, replaced = await tree.open(FILE), await tree.open(OTHER)
        began = trio.current_time()
        async with trio.open_nursery() as both:
            both.start_soon(read_slowly, store, file, old)
            both.start_soon(read_slowly, store, replaced, b"n" * len(old))
            await trio.sleep(later * 0.05)
            await tree.rename(FILE, OTHER)
        assert trio.current_time() - began < 10
        for handle in (file, replaced):
            await handle.release()
        await trio.sleep(5)
        assert list(store.files) == [OTHER]


@pytest.mark.holds("fault overlap")
async def test_a_reader_never_gets_bytes_of_what_replaces_its_file(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    """Its file was delivered by another handle, so it opens it anew at the next read: at any moment."""
    for later in range(30):
        store = FakeWriter(KINDS["posix"], nursery)
        store.add(FILE, b"old" * 300)
        store.add(OTHER, NEW)
        tree = make_writable(store)
        writer, reader = await tree.open(FILE, write=True), await tree.open(FILE)
        await writer.write(0, b"O")
        await writer.release()
        store.write_delay, store.open_delay = 0.1, 0.25
        async with trio.open_nursery() as both:
            both.start_soon(tree.rename, OTHER, FILE)
            await trio.sleep(later * 0.02 + 0.001)
            assert bytes(await reader.read(0, 900)) == b"Old" + b"old" * 299
        await reader.release()


async def test_who_opened_an_older_version_follows_the_renames_too(
    nursery: trio.Nursery, autojump_clock: object
) -> None:
    """Logs are rotated, and are as long as each other."""
    store = FakeWriter(KINDS["posix"], nursery)
    store.add(FILE, b"old" * 300)
    tree = make_writable(store, dir_timeout=0.0)
    first = await tree.open(FILE)
    await tree.rename(FILE, OTHER)
    last = await tree.open(OTHER)
    await tree.rename(OTHER, b"/d/third")
    for name in (FILE, OTHER):
        store.add(name, NEW)
    for file in (first, last):
        assert bytes(await file.read(0, 900)) == b"old" * 300
        await file.release()
