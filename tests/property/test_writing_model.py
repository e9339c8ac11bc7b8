"""Random sequences of calls on a few files against a model, on every kind of server, with faults and kills.

The model is a plain file system in memory: names for files, handles that keep their file. What the tree shows
must agree with it after every call; what a close or fsync confirmed must be on the card at once, and still
after the power went; and in the end, when everything was delivered, the card must be the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import trio
import trio.testing
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.cache.asides import is_reserved
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.spool import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    FileChanged,
    FtpNak,
    MavftpfsError,
    NotFound,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.shared.model import split
from tests.support.fake_writer import KINDS, FakeWriter, make_writable

NAMES = [b"/d/a", b"/d/b", b"/d/sub/c"]
ACCENT = 5
EXAMPLES = 100

names = st.sampled_from(NAMES)
offsets = st.integers(0, 3000)
chunks = st.builds(lambda n, b: bytes([b]) * n, st.integers(1, 900), st.integers(1, 255))
which = st.integers(0, ACCENT)

operations = st.one_of(
    st.tuples(st.just("create"), names, st.booleans()),
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
    st.tuples(st.just("rename"), names, names),
    st.tuples(st.just("unlink"), names),
    st.tuples(st.just("truncate"), names, offsets),
    st.tuples(st.just("sleep"), st.sampled_from([0.1, 3.0, 30.0])),
)
faults = st.dictionaries(
    st.integers(1, 60), st.sampled_from(["lost", "silence", "refused", "unreachable"]), max_size=4
)


@dataclass(eq=False)
class File:
    """A file of the model. confirmed: its content when a close or fsync last returned 0 and nothing changed
    since, else None."""

    data: bytearray = field(default_factory=bytearray)
    confirmed: bytes | None = None

    def write(self, offset: int, data: bytes) -> None:
        """Like pwrite."""
        self.data.extend(bytes(max(0, offset - len(self.data))))
        self.data[offset : offset + len(data)] = data
        self.confirmed = None

    def resize(self, size: int) -> None:
        """Like ftruncate."""
        if size != len(self.data):
            self.confirmed = None
        del self.data[size:]
        self.data.extend(bytes(size - len(self.data)))


@dataclass(eq=False)
class Handle:
    """An open file of both."""

    real: OpenFile
    file: File
    writes: bool


class World:
    """The tree under test beside the model."""

    def __init__(self, store: FakeWriter, tree: Tree) -> None:
        self.store = store
        self.tree = tree
        self.names: dict[bytes, File] = {}
        self.handles: list[Handle] = []
        for path in NAMES[:2]:
            data = path * 300
            store.add(path, data)
            self.names[path] = File(bytearray(data), data)
        store.add_directory(b"/d/sub")

    async def do(self, call: str, *args: Any) -> None:
        """Make one call on both."""
        await getattr(self, "on_" + call)(*args)

    # --- calls

    async def on_create(self, path: bytes, exclusive: bool) -> None:
        try:
            real = await self.tree.create(path, exclusive=exclusive)
        except AlreadyExists:
            assert exclusive
            assert path in self.names
            return
        except MavftpfsError:
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
        except MavftpfsError:
            return
        file = self.names[path]
        if mode == "t":
            file.resize(0)
        self.handles.append(Handle(real, file, mode != "r"))

    async def on_write(self, index: int, offset: int, data: bytes) -> None:
        handle = self.handle(index, writes=True)
        if handle is None:
            return
        try:
            assert await handle.real.write(offset, data) == len(data)
        except MavftpfsError:
            return
        handle.file.write(offset, data)

    async def on_append(self, index: int, data: bytes) -> None:
        handle = self.handle(index, writes=True)
        if handle is not None:
            await self.on_write(index, handle.real.size, data)

    async def on_resize(self, index: int, size: int) -> None:
        handle = self.handle(index, writes=True)
        if handle is None:
            return
        try:
            await handle.real.truncate(size)
        except MavftpfsError:
            return
        handle.file.resize(size)

    async def on_read(self, index: int, offset: int, size: int) -> None:
        handle = self.handle(index)
        if handle is None:
            return
        try:
            data = bytes(await handle.real.read(offset, size))
        except (FileChanged, NotFound):
            assert handle.file not in self.names.values(), "only a file without a name may be gone"
            return
        except MavftpfsError:
            return
        assert data == handle.file.data[offset : offset + size]

    async def on_flush(self, index: int) -> None:
        await self.confirm(index, lambda handle: handle.real.flush(), empty_too=False)

    async def on_fsync(self, index: int) -> None:
        await self.confirm(index, lambda handle: handle.real.fsync())

    async def on_close(self, index: int) -> None:
        if self.handle(index) is not None:
            await self.confirm(index, lambda handle: handle.real.release())
            del self.handles[index]

    async def on_rename(self, old: bytes, new: bytes) -> None:
        before = dict(self.names)
        try:
            await self.tree.rename(old, new)
        except CrossDevice:
            return
        except NotFound:
            assert old not in self.names
            return
        except MavftpfsError:
            await self.adopt_either(before, self.renamed(old, new))
            return
        self.names = self.renamed(old, new)

    async def on_unlink(self, path: bytes) -> None:
        without = {p: f for p, f in self.names.items() if p != path}
        try:
            await self.tree.unlink(path)
        except NotFound:
            assert path not in self.names
        except MavftpfsError:
            await self.adopt_either(dict(self.names), without)
        else:
            self.names = without

    async def on_truncate(self, path: bytes, size: int) -> None:
        file = self.names.get(path)
        try:
            await self.tree.truncate(path, size)
        except NotFound:
            assert file is None
        except MavftpfsError:
            if file is not None and (await self.size(path)) == size:
                file.resize(size)  # taken or done after all
            elif file is not None:
                file.confirmed = None
        else:
            assert file is not None
            file.resize(size)

    async def on_sleep(self, seconds: float) -> None:
        await trio.sleep(seconds)

    # --- helpers

    def handle(self, index: int, *, writes: bool = False) -> Handle | None:
        if index >= len(self.handles) or (writes and not self.handles[index].writes):
            return None
        return self.handles[index]

    async def confirm(self, index: int, ask: Callable[[Handle], Any], *, empty_too: bool = True) -> None:
        """Whoever is told 0 has the bytes on the card."""
        handle = self.handle(index)
        if handle is None:
            return
        try:
            await ask(handle)
        except MavftpfsError:
            return
        named = [path for path, file in self.names.items() if file is handle.file]
        if handle.writes and named and (empty_too or handle.file.data):
            assert self.store.files[named[0]].data == handle.file.data
            handle.file.confirmed = bytes(handle.file.data)

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

    async def check(self) -> None:
        """What the tree shows is the model."""
        try:
            shown = dict(await self.tree.list(b"/d"))
            below = dict(await self.tree.list(b"/d/sub"))
        except MavftpfsError:
            return
        sizes = {b"/d/" + name: stat.size for name, stat in shown.items() if name != b"sub"}
        sizes |= {b"/d/sub/" + name: stat.size for name, stat in below.items()}
        assert sizes == {path: len(file.data) for path, file in self.names.items()}

    async def end(self) -> None:
        """Close and deliver everything: the card is the model."""
        self.store.revive()
        while self.handles:
            await self.on_close(0)
        assert await self.tree.drain(300) == []
        self.tree.forget_caches()
        await self.check()
        await self.check()
        assert {p: f.data for p, f in self.store.files.items()} == {p: f.data for p, f in self.names.items()}
        status = self.tree.status()
        assert (status["bytes_held"], status["errors"]) == (0, {})


def put_faults(store: FakeWriter, faults: dict[int, str]) -> None:
    errors: dict[str, Callable[[], MavftpfsError]] = {
        "silence": lambda: RequestTimeout("silence"),
        "refused": lambda: FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 5),
        "unreachable": lambda: VehicleLost("lost"),
    }
    for number, fault in faults.items():
        if fault == "lost":
            store.lose_reply_at.add(number)
        else:
            store.fail_at[number] = errors[fault]()


def virtually(scenario: Callable[..., Any], *args: Any) -> None:
    trio.run(scenario, *args, clock=trio.testing.MockClock(autojump_threshold=0))


async def deliver_all(kind: str, calls: list[Any], faults: dict[int, str], seed: int) -> None:
    async with trio.open_nursery() as nursery:
        store = FakeWriter(KINDS[kind], nursery)
        world = World(store, make_writable(store, seed=seed, inplace=True, dir_timeout=seed % 3 * 10.0))
        put_faults(store, faults)
        for call in calls:
            await world.do(*call)
            if not faults:
                await world.check()
        await world.end()
        assert store.crimes == []
        nursery.cancel_scope.cancel()


async def cut_power(kind: str, calls: list[Any], moment: int, directory: Path) -> None:
    async with trio.open_nursery() as nursery:
        store = FakeWriter(KINDS[kind], nursery)
        spool = SpoolDirectory(directory / "spool", Random(1))
        world = World(store, make_writable(store, spool=spool, inplace=kind == "littlefs"))
        store.freeze_at = moment
        settled = True
        for call in calls:
            confirmed = {path: file.confirmed for path, file in world.names.items()}
            try:
                with trio.fail_after(1000):
                    await world.do(*call)
            except (AssertionError, trio.TooSlowError):
                if store.requests < moment:
                    raise
                settled = False  # the call was cut in the middle, and nobody answers any more
                break
            if store.requests >= moment:
                settled = False
                break
        nursery.cancel_scope.cancel()
    if settled:
        confirmed = {path: file.confirmed for path, file in world.names.items()}
    last = calls[-1] if settled or not calls else call
    spool.close()
    store.revive()
    await check_after_power_cut(
        store,
        directory,
        confirmed,
        {arg for arg in last if isinstance(arg, bytes)} if calls and not settled else set(),
        world,
    )


async def check_after_power_cut(
    store: FakeWriter,
    directory: Path,
    confirmed: dict[bytes, bytes | None],
    touched: set[bytes],
    world: World,
) -> None:
    """The next mount finds no litter, and all that was confirmed and not being changed at that moment."""
    async with trio.open_nursery() as nursery:
        store.nursery = nursery
        spool = SpoolDirectory(directory / "spool", Random(2))
        tree = make_writable(store, spool=spool, seed=9)
        for path in (b"/d", b"/d/sub", b"/d"):
            await tree.list(path)
        assert [path for path in store.files if is_reserved(split(path)[1])] == []
        for path, data in confirmed.items():
            file = world.names.get(path)
            if data is not None and path not in touched and file is not None and file.confirmed == data:
                assert store.files[path].data == data
        spool.close()
        nursery.cancel_scope.cancel()


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, max_size=25), st.integers(0, 99))
def test_the_card_becomes_the_model(kind: str, calls: list[Any], seed: int) -> None:
    virtually(deliver_all, kind, calls, {}, seed)


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, max_size=20), faults, st.integers(0, 99))
def test_faults_cost_errors_but_no_bytes(
    kind: str, calls: list[Any], faults: dict[int, str], seed: int
) -> None:
    virtually(deliver_all, kind, calls, faults, seed)


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, min_size=1, max_size=15), st.integers(0, 60))
def test_a_power_cut_costs_nothing_that_was_confirmed(kind: str, calls: list[Any], moment: int) -> None:
    with TemporaryDirectory() as directory:
        virtually(cut_power, kind, calls, moment, Path(directory))
