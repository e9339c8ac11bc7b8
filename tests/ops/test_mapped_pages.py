"""Pages of a mapping come by any handle, also one that appends: they belong where they lie."""

from __future__ import annotations

import mmap
import os

import pytest

from tests.ops.faketree import FakeTree
from tests.ops.test_operations import CTX, ino_of, operations

PAGE = mmap.PAGESIZE
SIZE = 2 * PAGE + 100
OLD = bytes(range(256)) * (SIZE // 256) + b"end" * 100
PAGES = {"first": (0, PAGE), "middle": (PAGE, 2 * PAGE), "last": (2 * PAGE, SIZE), "all": (0, SIZE)}


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("which", PAGES)
async def test_a_mapped_page_is_not_appended(which: str) -> None:
    start, stop = PAGES[which]
    tree = FakeTree({b"/f": OLD[:SIZE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    info = await ops.open(ino, os.O_RDWR | os.O_APPEND, CTX)
    assert await ops.write(info.fh, start, b"m" * (stop - start)) == stop - start
    assert await ops.write(info.fh, SIZE, b"appended") == 8
    await ops.flush(info.fh)
    expected = OLD[:start] + b"m" * (stop - start) + OLD[stop:SIZE] + b"appended"
    assert tree.files[b"/f"] == expected


async def test_what_is_appended_to_a_file_that_grew_follows_its_end() -> None:
    """The kernel goes on counting from the size it knew, page borders or not."""
    tree = FakeTree({b"/f": OLD[:PAGE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    tree.files[b"/f"] = OLD[: 2 * PAGE]
    info = await ops.open(ino, os.O_WRONLY | os.O_APPEND, CTX)
    await ops.write(info.fh, PAGE, b"a" * PAGE)
    await ops.write(info.fh, 2 * PAGE, b"b" * 10)
    await ops.flush(info.fh)
    assert tree.files[b"/f"] == OLD[: 2 * PAGE] + b"a" * PAGE + b"b" * 10


async def test_a_file_emptied_by_an_open_is_appended_to_from_its_start() -> None:
    tree = FakeTree({b"/f": OLD[:SIZE]}, set())
    ops = operations(tree)
    ino = await ino_of(ops, b"f")
    info = await ops.open(ino, os.O_WRONLY | os.O_APPEND | os.O_TRUNC, CTX)
    await ops.write(info.fh, 0, b"a" * PAGE)
    await ops.write(info.fh, PAGE, b"b" * PAGE)
    await ops.flush(info.fh)
    assert tree.files[b"/f"] == b"a" * PAGE + b"b" * PAGE
