"""A plain file system in memory, and a tree under test beside it: every call is made on both.

Names stand for files, handles keep their file. What the tree shows must agree with the model after every
call; what a close or fsync confirmed must be on the card at once; and in the end the card must be the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Any

import trio
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import AlreadyExists, CrossDevice, FileChanged, MavftpfsError, NotFound

NAMES = [b"/d/a", b"/d/b", b"/d/sub/c"]
START = {path: path * 300 for path in NAMES[:2]}
"""The files that are there before the first call, beside an empty directory /d/sub."""

MOST_HANDLES = 5


def noise(length: int, seed: int) -> bytes:
    """Return bytes of which no two pieces are alike."""
    return Random(seed).randbytes(length)


LONG = 70_000
"""Bytes of a write that is sent while the program goes on (more than `cache.delivery.START_AT`)."""


def calls(largest: int = 3000, chunk: int = 900) -> SearchStrategy[tuple[Any, ...]]:
    """Draw one call for `Model.do`. largest: of offsets and sizes; chunk: of what one write has."""
    names = st.sampled_from(NAMES)
    return st.one_of(
        *_on_handles(largest, chunk),
        st.tuples(st.just("create"), names, st.booleans()),
        st.tuples(st.just("rename"), names, names),
        st.tuples(st.just("unlink"), names),
    )


def rewriting_calls(largest: int, chunk: int) -> SearchStrategy[tuple[Any, ...]]:
    """Draw one call of those that make and move no name; some write much, which begins to go out at once."""
    which = st.integers(0, MOST_HANDLES)
    long = st.builds(noise, st.just(LONG), st.integers(0, 255))
    return st.one_of(*_on_handles(largest, chunk), st.tuples(st.just("write"), which, st.just(0), long))


def _on_handles(largest: int, chunk: int) -> list[SearchStrategy[tuple[Any, ...]]]:
    names = st.sampled_from(NAMES)
    offsets = st.one_of(st.sampled_from([0, 239]), st.integers(0, largest))
    chunks = st.builds(noise, st.integers(1, chunk), st.integers(0, 255))
    which = st.integers(0, MOST_HANDLES)
    return [
        st.tuples(st.just("open"), names, st.sampled_from(["r", "w", "t"])),
        st.tuples(st.just("write"), which, offsets, chunks),
        st.tuples(st.just("write"), which, offsets, chunks),
        st.tuples(st.just("append"), which, chunks),
        st.tuples(st.just("read"), which, offsets, offsets),
        st.tuples(st.just("resize"), which, offsets),
        st.tuples(st.just("flush"), which),
        st.tuples(st.just("fsync"), which),
        st.tuples(st.just("close"), which),
        st.tuples(st.just("close"), which),
        st.tuples(st.just("truncate"), names, offsets),
        st.tuples(st.just("sleep"), st.sampled_from([0.1, 3.0, 30.0])),
    ]


@dataclass(eq=False)
class File:
    """A file of the model."""

    data: bytearray = field(default_factory=bytearray)

    def write(self, offset: int, data: bytes) -> None:
        """Like pwrite."""
        self.data.extend(bytes(max(0, offset - len(self.data))))
        self.data[offset : offset + len(data)] = data

    def resize(self, size: int) -> None:
        """Like ftruncate."""
        del self.data[size:]
        self.data.extend(bytes(size - len(self.data)))


@dataclass(eq=False)
class Handle:
    """An open file of both."""

    real: OpenFile
    file: File
    writes: bool


class Model:
    """The tree under test beside the model.

    card: returns the content of each file on the vehicle's card, litter included. excused: errors that a call
    may raise though the model knows no reason; such a call must have done all or nothing, and counts as one
    of `failures`.
    """

    def __init__(
        self,
        tree: Tree,
        card: Callable[[], Mapping[bytes, bytes]],
        excused: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> None:
        self.tree = tree
        self.card = card
        self.excused = excused
        self.failures = 0
        self.names = {path: File(bytearray(data)) for path, data in START.items()}
        self.handles: list[Handle] = []

    async def do(self, call: str, *args: Any) -> None:
        """Make one call on both."""
        try:
            await getattr(self, "on_" + call)(*args)
        except self.excused:
            self.failures += 1
            self.lose_broken()

    def lose_broken(self) -> None:
        """Give the names of files of which a write failed back to what the card has there (promise 3)."""
        broken = [handle.file for handle in self.handles if handle.writes and not handle.real.has_name]
        for path in [path for path, file in self.names.items() if file in broken]:
            data = self.card().get(path)
            del self.names[path]
            if data is not None:
                self.names[path] = File(bytearray(data))

    # --- calls

    async def on_create(self, path: bytes, exclusive: bool) -> None:
        try:
            real = await self.tree.create(path, exclusive=exclusive)
        except AlreadyExists:
            assert exclusive
            assert path in self.names
            return
        assert not (exclusive and path in self.names)
        file = self.names.setdefault(path, File())
        self.handles.append(Handle(real, file, True))

    async def on_open(self, path: bytes, mode: str) -> None:
        try:
            real = await self.tree.open(path, write=mode != "r", truncate=mode == "t")
        except NotFound:
            assert path not in self.names
            return
        file = self.names[path]
        if mode == "t":
            file.resize(0)
        self.handles.append(Handle(real, file, mode != "r"))

    async def on_write(self, index: int, offset: int, data: bytes) -> None:
        handle = self.handle(index, writes=True)
        if handle is not None:
            assert await handle.real.write(offset, data) == len(data)
            handle.file.write(offset, data)

    async def on_append(self, index: int, data: bytes) -> None:
        handle = self.handle(index, writes=True)
        if handle is not None:
            await self.on_write(index, handle.real.size, data)

    async def on_resize(self, index: int, size: int) -> None:
        handle = self.handle(index, writes=True)
        if handle is not None:
            await handle.real.truncate(size)
            handle.file.resize(size)

    async def on_read(self, index: int, offset: int, size: int) -> None:
        handle = self.handle(index)
        if handle is None:
            return
        try:
            data = bytes(await handle.real.read(offset, size))
        except (FileChanged, NotFound):
            assert handle.file not in self.names.values(), "only a file without a name may be gone"
        else:
            assert data == handle.file.data[offset : offset + size]

    async def on_flush(self, index: int) -> None:
        await self.confirm(index, lambda handle: handle.real.flush(), empty_too=False)

    async def on_fsync(self, index: int) -> None:
        await self.confirm(index, lambda handle: handle.real.fsync())

    async def on_close(self, index: int) -> None:
        handle = self.handle(index)
        if handle is not None:
            try:
                others = [one for one in self.handles if one.file is handle.file and one.writes]
                await self.confirm(index, lambda handle: handle.real.release(), empty_too=others == [handle])
            finally:
                self.handles.remove(handle)

    async def on_rename(self, old: bytes, new: bytes) -> None:
        before = dict(self.names)
        try:
            await self.tree.rename(old, new)
        except CrossDevice:
            return
        except NotFound:
            assert old not in self.names
            return
        except self.excused:
            await self.adopt_either(before, self.renamed(old, new))
            raise
        self.names = self.renamed(old, new)

    async def on_unlink(self, path: bytes) -> None:
        without = {p: f for p, f in self.names.items() if p != path}
        try:
            await self.tree.unlink(path)
        except NotFound:
            assert path not in self.names
        except self.excused:
            await self.adopt_either(dict(self.names), without)
            raise
        else:
            self.names = without

    async def on_truncate(self, path: bytes, size: int) -> None:
        file = self.names.get(path)
        try:
            await self.tree.truncate(path, size)
        except NotFound:
            assert file is None
        except self.excused:
            if file is not None and (await self.size(path)) == size:
                file.resize(size)  # taken or done after all
            raise
        else:
            assert file is not None
            file.resize(size)

    async def on_sleep(self, seconds: float) -> None:
        await trio.sleep(seconds)

    # --- helpers

    def handle(self, index: int, *, writes: bool = False) -> Handle | None:
        """Return one of the handles, or of those that write; None if there is none."""
        handles = [handle for handle in self.handles if handle.writes or not writes]
        return handles[index % len(handles)] if handles else None

    async def confirm(self, index: int, ask: Callable[[Handle], Any], *, empty_too: bool = True) -> None:
        """Whoever is told 0 has the bytes on the card."""
        handle = self.handle(index)
        if handle is None:
            return
        await ask(handle)
        named = [path for path, file in self.names.items() if file is handle.file]
        if handle.writes and named and (empty_too or handle.file.data):
            assert self.card()[named[0]] == handle.file.data

    def renamed(self, old: bytes, new: bytes) -> dict[bytes, File]:
        if old == new or old not in self.names:
            return dict(self.names)
        changed = {path: file for path, file in self.names.items() if path not in (old, new)}
        return {**changed, new: self.names[old]}

    async def size(self, path: bytes) -> int | None:
        for _ in range(100):
            try:
                return (await self.tree.stat(path)).size
            except NotFound:
                return None
            except MavftpfsError:
                await trio.sleep(1)
        raise AssertionError("the vehicle never came back")

    async def adopt_either(self, before: dict[bytes, File], after: dict[bytes, File]) -> None:
        """A call that failed did all or nothing; find out which."""
        self.tree.forget_caches()
        shown = {path: await self.size(path) for path in NAMES}
        for names in (before, after):
            if shown == {path: len(names[path].data) if path in names else None for path in NAMES}:
                self.names = names
                return
        raise AssertionError(f"neither before nor after: {shown}")

    async def on_check(self) -> None:
        """Check that the tree shows the model."""
        shown = dict(await self.tree.list(b"/d"))
        below = dict(await self.tree.list(b"/d/sub"))
        sizes = {b"/d/" + name: stat.size for name, stat in shown.items() if name != b"sub"}
        sizes |= {b"/d/sub/" + name: stat.size for name, stat in below.items()}
        assert sizes == {path: len(file.data) for path, file in self.names.items()}

    async def end(self) -> None:
        """Close and deliver everything: the card is the model."""
        while self.handles:
            await self.do("close", 0)
        assert await self.tree.drain(300) == []
        for _ in range(3):  # listings, and time to clean up what they show
            self.tree.forget_caches()
            await self.do("check")
            await trio.sleep(20)
        assert self.card() == {path: file.data for path, file in self.names.items()}
        status = self.tree.status()
        assert (status["bytes_held"], status["errors"]) == (0, {})
