"""Files read through the cache are the vehicle's files: whatever is evicted, lost, doubtful or cancelled."""

from __future__ import annotations

import random
from dataclasses import dataclass

import trio
from hypothesis import given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.cache.options import MIN_CACHE_SIZE
from mavftpfs.cache.readahead import MAX_WINDOW, Readahead
from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.cache.versions import BLOCK_SIZE, BlockCache, Version
from mavftpfs.shared.errors import DataUnproven, FileChanged, RequestTimeout, VehicleLost
from tests.support.fake_store import FakeStore, make_tree

KIB = 1024


# --- one file's blocks against bytes


@dataclass
class Step:
    """What happens to the blocks next."""

    what: str
    start: int = 0
    size: int = 0


steps = st.builds(
    Step,
    st.sampled_from(["data", "data", "data", "evict", "begin", "suspect", "clear"]),
    st.integers(0, 3 * BLOCK_SIZE),
    st.one_of(st.integers(0, 300), st.integers(0, 2 * BLOCK_SIZE)),
)


@given(st.integers(0, 3 * BLOCK_SIZE), st.lists(steps, max_size=40), st.integers())
def test_blocks_hold_what_came_first_and_only_that(size: int, script: list[Step], seed: int) -> None:
    """After each step, what is readable equals a model of bytes."""
    cache = BlockCache(2 * BLOCK_SIZE, clock=lambda: 0.0, patience=30)
    blocks = Version(cache, b"/f", size)
    held: dict[int, int] = {}
    rng = random.Random(seed)
    sample = sorted({0, size - 1, BLOCK_SIZE - 1, BLOCK_SIZE, *(rng.randrange(size or 1) for _ in range(30))})
    for number, step in enumerate(script):
        stop = min(step.start + step.size, size)
        if step.what == "data":
            blocks.on_data(step.start, bytes([number]) * step.size)
            blocks.on_batch(step.size)
            for at in sample:
                if step.start <= at < stop and not blocks.doubted:
                    held.setdefault(at, number)
        elif step.what == "begin":
            blocks.doubted = False
        elif step.what == "suspect":
            blocks.on_suspect("test")
            held = {}
        elif step.what == "clear" or step.start // BLOCK_SIZE not in blocks:
            blocks.clear()
        else:
            blocks.evict(step.start // BLOCK_SIZE)
        gone = {at for at in held if at // BLOCK_SIZE not in blocks}
        held = {at: byte for at, byte in held.items() if at not in gone}
        blocks.check_invariants()
        cache.check_invariants()
        for at in sample:
            if 0 <= at < size:
                view = blocks.get(at, at + 1)
                assert (None if view is None else view[0]) == held.get(at)


# --- whole trees on virtual time


@dataclass
class Opened:
    """A handle and the bytes it must show; None after its file was replaced under it.

    doubtful: the vehicle restarted since, and neither size nor mtime proves that the file is the same.
    """

    handle: OpenFile
    data: bytes | None
    doubtful: bool = False


class Session:
    """Random actions of several programs on two files, and of the vehicle and the link meanwhile."""

    PATHS = (b"/small", b"/d/large")

    def __init__(self, seed: int, nursery: trio.Nursery) -> None:
        self.rng = random.Random(seed)
        self.store = FakeStore(nursery)
        self.store.chunk = self.rng.choice([1000, 4 * KIB, 64 * KIB])
        self.store.spoil = lambda path, offset, data: bytes(byte ^ 0x55 for byte in data)
        self.with_times = self.rng.random() < 0.5
        self.mtime = 1000
        self.store.add(b"/small", self.rng.randbytes(self.rng.choice([0, 1, 239, 5000])), self.next_mtime())
        self.store.add(
            b"/d/large", self.rng.randbytes(self.rng.choice([200, 900, 1500]) * KIB), self.next_mtime()
        )
        self.tree: Tree = make_tree(self.store, cache_size=MIN_CACHE_SIZE)
        self.opened: dict[bytes, list[Opened]] = {path: [] for path in self.PATHS}
        self.good = 0

    def next_mtime(self) -> int | None:
        self.mtime += 1
        return self.mtime if self.with_times else None

    async def run(self, actions: int) -> None:
        for _ in range(actions):
            action = self.rng.choice(
                [
                    self.read,
                    self.read,
                    self.read,
                    self.read_many,
                    self.open,
                    self.close,
                    self.disturb,
                    self.change,
                ]
            )
            await action()
            assert int(str(self.tree.status()["bytes_cached"])) <= MIN_CACHE_SIZE
        await self.settle()

    async def open(self) -> None:
        path = self.rng.choice(self.PATHS)
        try:
            handle = await self.tree.open(path)
        except VehicleLost:
            return
        self.opened[path].append(Opened(handle, self.store.files[path].data))
        assert handle.size == len(self.store.files[path].data)

    async def close(self) -> None:
        path = self.rng.choice(self.PATHS)
        if self.opened[path]:
            self.opened[path].pop(self.rng.randrange(len(self.opened[path]))).handle.close()

    async def read(self) -> None:
        handles = self.opened[self.rng.choice(self.PATHS)]
        if not handles:
            return await self.open()
        chosen = self.rng.choice(handles)
        offset = self.rng.randrange(chosen.handle.size + 10)
        size = self.rng.choice([1, 100, 4 * KIB, 128 * KIB, 400 * KIB])
        with trio.move_on_after(self.rng.choice([0.002, 1000])):
            await self.checked_read(chosen, offset, size)
        return None

    async def checked_read(self, chosen: Opened, offset: int, size: int) -> None:
        try:
            data = bytes(await chosen.handle.read(offset, size))
        except (VehicleLost, RequestTimeout, DataUnproven):
            return
        except FileChanged:
            assert chosen.data is None or chosen.doubtful
            return
        if chosen.data is not None:
            assert data == chosen.data[offset : offset + size]
            self.good += 1

    async def read_many(self) -> None:
        """Several readers at once, one of them sequential."""
        everyone = [opened for handles in self.opened.values() for opened in handles]
        if not everyone:
            return
        async with trio.open_nursery() as readers:
            for _ in range(4):
                chosen = self.rng.choice(everyone)
                readers.start_soon(
                    self.checked_read, chosen, self.rng.randrange(chosen.handle.size + 1), 100_000
                )
            readers.start_soon(self.read_through, self.rng.choice(everyone))

    async def read_through(self, chosen: Opened) -> None:
        for offset in range(0, min(chosen.handle.size, 700 * KIB), 128 * KIB):
            await self.checked_read(chosen, offset, 128 * KIB)

    async def disturb(self) -> None:
        trouble = self.rng.choice(["fail", "suspect", "suspect", "armed", "pause", "lost", "reboot"])
        if trouble == "fail":
            self.store.fail_chunks = [self.rng.choice([VehicleLost("gone"), RequestTimeout("silence")])]
        elif trouble == "suspect":
            self.store.suspect_chunks = self.rng.choice([1, 2, 5])
        elif trouble == "armed":
            self.store.armed = not self.store.armed
        elif trouble == "pause":
            await trio.sleep(self.rng.choice([1, 25]))
        elif trouble == "lost":
            self.store.lost = not self.store.lost
        else:
            self.reboot()

    def reboot(self) -> None:
        """Restart the vehicle; its files are the same, but the client cannot always prove it."""
        self.tree.rebooted()
        for path, handles in self.opened.items():
            for opened in handles:
                opened.doubtful |= not self.with_times or opened.data != self.store.files[path].data

    async def change(self) -> None:
        """Append to a file, or replace it, and let every proof run out."""
        path = self.rng.choice(self.PATHS)
        data = self.store.files[path].data
        if self.rng.random() < 0.5:
            self.store.add(path, data + self.rng.randbytes(300), self.next_mtime())
        elif self.rng.random() < 0.2:
            self.store.add(
                path, self.rng.randbytes(max(0, len(data) - self.rng.choice([0, 1, 5000]))), self.next_mtime()
            )
            for opened in self.opened[path]:
                opened.data = None
        await trio.sleep(25)
        if self.store.lost:
            self.store.lost = False
            self.tree.link_back()

    async def settle(self) -> None:
        """When everything is well again every file can be read, and nothing is left open."""
        self.store.lost, self.store.armed, self.store.suspect_chunks = False, False, 0
        self.store.fail_chunks = []
        self.tree.link_back()
        for path in self.PATHS:
            for opened in self.opened[path]:
                opened.handle.close()
            await trio.sleep(25)
            handle = await self.tree.open(path)
            assert bytes(await handle.read(0, handle.size)) == self.store.files[path].data
            handle.close()
        assert all(reader.closed for reader in self.store.readers)
        assert self.tree._files.open_versions == {}
        assert self.store.crimes == []


@settings(max_examples=60)
@given(st.integers(0, 2**32))
def test_every_read_is_right_or_an_error(seed: int) -> None:
    async def main() -> None:
        async with trio.open_nursery() as nursery:
            await Session(seed, nursery).run(30)
            nursery.cancel_scope.cancel()

    trio.run(main, clock=MockClock(autojump_threshold=0))


def test_the_session_above_reads_something() -> None:
    """Guards the property against being vacuous."""

    async def main() -> int:
        async with trio.open_nursery() as nursery:
            session = Session(1, nursery)
            await session.run(60)
            nursery.cancel_scope.cancel()
        return session.good

    assert trio.run(main, clock=MockClock(autojump_threshold=0)) > 20


# --- readahead


@given(
    st.integers(0, 10**7),
    st.lists(st.tuples(st.integers(0, 10**7), st.integers(1, 300_000)), max_size=30),
    st.integers(0, MAX_WINDOW),
    st.integers(0, MAX_WINDOW),
)
def test_readahead_stays_within_the_file_and_its_bounds(
    size: int, reads: list[tuple[int, int]], limit: int, small: int
) -> None:
    ahead = Readahead(size)
    for start, length in reads:
        stop = min(start + length, size)
        if start >= stop:
            continue
        plan = ahead.on_read(start, stop, limit=limit, small=small)
        assert 0 <= plan.start <= plan.stop <= size
        assert plan.stop - plan.start <= MAX_WINDOW
        if plan.start < plan.stop:
            assert plan.start >= stop
            assert plan.stop <= max(stop + limit, small)


@given(st.integers(1, 10**7), st.integers(1, 256 * KIB))
def test_a_sequential_reader_is_never_asked_for_the_same_byte_twice(size: int, step: int) -> None:
    ahead = Readahead(size)
    step = max(step, size // 200)
    asked = 0
    for start in range(0, size, step):
        plan = ahead.on_read(start, min(start + step, size), limit=MAX_WINDOW, small=64 * KIB)
        assert not plan.seeked
        if plan.start < plan.stop:
            assert plan.start >= asked
            asked = plan.stop
