"""mount.toldfiles: what the kernel is told, and when, of what commands do."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import cast

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.mount.handles import InodeTable, Presentation
from mavftpfs.mount.invalidator import Invalidator
from mavftpfs.mount.operations import Operations
from mavftpfs.mount.toldfiles import TELLING_TIME, ToldFiles
from mavftpfs.shared.errors import NotSupported, ReadOnly
from tests.ops.faketree import FakeTree

LOOK = Presentation(1000, 1000, 0o644, 0o755, op_deadline=30.0)


class Kernel:
    """Notes what it is told among the calls of the tree. gate: holds it up."""

    def __init__(self, tree: FakeTree) -> None:
        self.tree = tree
        self.inodes = InodeTable()
        self.gate = threading.Event()
        self.gate.set()
        self.invalidator = Invalidator(self.inodes, self._pages, self._name)
        operations = Operations(cast(Tree, tree), LOOK, inodes=self.inodes)
        self.files = ToldFiles(cast(Tree, tree), operations, self.invalidator)

    def _pages(self, ino: int, attr_only: bool) -> None:
        self.gate.wait(60)
        self.tree.calls.append(("pages", b"%d" % ino))

    def _name(self, parent: int, name: bytes) -> None:
        self.gate.wait(60)
        self.tree.calls.append(("name", name))

    def told(self) -> list[str]:
        """Return the kinds of calls until now, and forget them."""
        kinds = [kind for kind, _ in self.tree.calls]
        self.tree.calls.clear()
        return kinds


@asynccontextmanager
async def knowing(*paths: bytes) -> AsyncIterator[Kernel]:
    """Give a kernel that knows files."""
    kernel = Kernel(FakeTree({b"/f": b"old"}, {b"/d"}))
    for path in paths:
        kernel.inodes.lookup(path)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(kernel.invalidator.run)
        yield kernel
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 1")
async def test_pages_are_dropped_before_a_file_is_opened() -> None:
    """To the tree whoever opens a file has its pages, and so the kernel would keep those of an older file."""
    async with knowing(b"/f") as kernel:
        await kernel.files.open(b"/f")
        assert kernel.told() == ["pages", "open"]


async def test_names_are_told_after_the_change_and_before_the_answer() -> None:
    async with knowing(b"/", b"/f") as kernel:
        files = kernel.files
        await files.mkdir(b"/e")
        assert kernel.told() == ["mkdir", "name"]
        await files.rmdir(b"/e")
        assert kernel.told() == ["rmdir", "name"]
        await files.create(b"/n", exclusive=True)
        assert kernel.told()[-1] == "name"
        await files.rename(b"/n", b"/m")
        assert kernel.told() == ["rename", "name", "name"]
        await files.unlink(b"/m")
        assert kernel.told() == ["unlink", "name"]


async def test_a_write_drops_pages_and_the_end_waits_for_that() -> None:
    async with knowing(b"/f") as kernel:
        file = await kernel.files.open(b"/f", write=True)
        kernel.told()
        await file.write(0, b"new")
        with trio.fail_after(60):
            while "pages" not in kernel.told():  # noqa: ASYNC110
                await trio.sleep(0.01)
        kernel.tree.calls.clear()
        await file.fsync()
        calls = kernel.told()
        assert calls[0] == "fsync"
        assert {"pages", "name"} <= set(calls)


async def test_a_kernel_that_waits_holds_no_answer_up_for_long() -> None:
    async with knowing(b"/", b"/f") as kernel:
        kernel.gate.clear()
        try:
            began = trio.current_time()
            await kernel.files.mkdir(b"/e")
            assert TELLING_TIME <= trio.current_time() - began < TELLING_TIME + 5
        finally:
            kernel.gate.set()


async def test_what_is_gone_loses_its_number() -> None:
    async with knowing(b"/f") as kernel:
        await kernel.files.rename(b"/f", b"/g")
        assert kernel.inodes.known(b"/g") is not None
        await kernel.files.unlink(b"/g")
        assert kernel.inodes.known(b"/g") is None


async def test_a_refused_change_is_no_change() -> None:
    async with knowing(b"/", b"/f") as kernel:
        kernel.tree.error = ReadOnly("armed")
        with pytest.raises(ReadOnly):
            await kernel.files.unlink(b"/f")
        assert kernel.inodes.known(b"/f") is not None
        kernel.tree.error = None
        for change in (
            kernel.files.create(b"/.x.swp", exclusive=True),
            kernel.files.rename(b"/f", b"/.f.swp"),
        ):
            with pytest.raises(NotSupported, match="never reach the card"):
                await change
        assert kernel.tree.files == {b"/f": b"old"}
