"""Calls that overlap, as random calls on a real mount met them: each test is one such meeting."""

from __future__ import annotations

import trio

from tests.support.fake_writer import KINDS, FakeWriter, make_writable, write_file

FILE = b"/d/file"


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
