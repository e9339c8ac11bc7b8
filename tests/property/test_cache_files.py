"""Files read through the cache are the vehicle's files: whatever is evicted, lost, doubtful or cancelled."""

from __future__ import annotations

import random
from dataclasses import dataclass

import trio
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.cache.options import MIN_CACHE_SIZE
from mavftpfs.cache.readahead import MAX_WINDOW, Readahead
from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.cache.versions import BLOCK_SIZE, BlockCache, Version
from mavftpfs.shared.errors import DataUnproven, FileChanged, RequestTimeout, VehicleLost
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig, read_file, rig

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
                if step.start <= at < stop and not blocks.ignores_data:
                    held.setdefault(at, number)
        elif step.what == "begin":
            blocks.ignores_data = False
        elif step.what == "suspect":
            blocks.on_suspect("test")
            held = {}
        elif step.what == "clear" or blocks.block(step.start // BLOCK_SIZE) is None:
            blocks.clear()
        else:
            blocks.evict(step.start // BLOCK_SIZE)
        gone = {at for at in held if blocks.block(at // BLOCK_SIZE) is None}
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
    """A handle, and which contents it may be of, by what it showed so far.

    excused: the file was replaced, or the vehicle restarted and neither size nor mtime proves that it is the
    same: reading may fail.
    """

    handle: OpenFile
    contents: list[bytes]
    excused: bool = False

    def shows(self, offset: int, size: int, data: bytes) -> None:
        """Take what a read returned: all of it is of one file."""
        stop = min(offset + size, self.handle.size)
        self.contents = [content for content in self.contents if content[offset:stop] == data]
        assert self.contents


class Programs:
    """Random actions of several programs on two files, and of the vehicle and the link meanwhile."""

    PATHS = (b"/small", b"/d/large")

    def __init__(self, here: Rig, rng: random.Random) -> None:
        self.here = here
        self.rng = rng
        self.with_times = here.profile == "mavsdk"
        self.mtime = 1_700_000_000
        self.had: dict[bytes, list[bytes]] = {path: [] for path in self.PATHS}
        here.put_directory(b"/d")
        for path, sizes in zip(self.PATHS, ([0, 1, 239, 5000], [100 * KIB, 500 * KIB]), strict=True):
            self.put(path, rng.randbytes(rng.choice(sizes)))
        self.tree: Tree = here.mount(cache_size=MIN_CACHE_SIZE, dir_timeout=20.0)
        self.opened: list[tuple[bytes, Opened]] = []
        self.good = 0

    def put(self, path: bytes, data: bytes) -> None:
        self.mtime += 1
        self.here.replace(path, data, self.mtime)
        self.had[path].append(data)

    async def run(self, actions: int) -> None:
        """Act, and then see that every file can be read, and nothing is left open."""
        choices = [self.read, self.read, self.read_many, self.open, self.close, self.disturb, self.change]
        for _ in range(actions):
            await self.rng.choice(choices)()
            assert int(str(self.tree.status()["bytes_cached"])) <= MIN_CACHE_SIZE
        while self.opened:
            await self.close()
        for path in self.PATHS:
            await trio.sleep(25)
            assert await read_file(self.tree, path) == self.here.data(path)
        assert self.tree._files.open_versions == {}

    async def open(self) -> None:
        path = self.rng.choice(self.PATHS)
        handle = await self.tree.open(path)
        of_size = [data for data in self.had[path] if len(data) == handle.size]
        self.opened.append((path, Opened(handle, of_size, self.here.data(path) not in of_size[:1])))

    async def close(self) -> None:
        if self.opened:
            self.opened.pop(self.rng.randrange(len(self.opened)))[1].handle.close()

    async def read(self) -> None:
        if not self.opened:
            return await self.open()
        chosen = self.rng.choice(self.opened)[1]
        offset = self.rng.randrange(chosen.handle.size + 10)
        with trio.move_on_after(self.rng.choice([0.05, 1000])):
            await self.checked_read(chosen, offset, self.rng.choice([1, 100, 4 * KIB, 128 * KIB]))

    async def checked_read(self, chosen: Opened, offset: int, size: int) -> None:
        try:
            data = bytes(await chosen.handle.read(offset, size))
        except (VehicleLost, RequestTimeout, DataUnproven):
            return
        except FileChanged:
            assert chosen.excused
            return
        chosen.shows(offset, size, data)
        self.good += 1

    async def read_many(self) -> None:
        """Several readers at once, with trouble among them."""
        async with trio.open_nursery() as readers:
            for _, chosen in self.rng.choices(self.opened, k=4) if self.opened else []:
                start = self.rng.randrange(chosen.handle.size + 1)
                readers.start_soon(self.checked_read, chosen, start, 100_000)
            await trio.sleep(self.rng.choice([0.1, 1.0]))
            await self.disturb()

    async def disturb(self) -> None:
        trouble = self.rng.choice(["doubt", "doubt", "cut", "reboot", "pause"])
        if trouble == "doubt":
            self.here.connection.scheduler.doubt.raise_it("somebody else")
        elif trouble == "cut":
            self.here.link.cut()
            await trio.sleep(self.rng.choice([1.0, 8.0]))
            await self.here.find()
        elif trouble == "reboot":
            for path, opened in self.opened:
                opened.excused |= not self.with_times or self.here.data(path) not in opened.contents
            await self.here.reboot()
        else:
            await trio.sleep(25)

    async def change(self) -> None:
        """Append to a file, or replace it; by one of the same size only where times tell."""
        path = self.rng.choice(self.PATHS)
        old = self.here.data(path)
        appended = self.rng.random() < 0.5
        if appended:
            new = old + self.rng.randbytes(300)
        elif self.with_times:
            new = self.rng.randbytes(max(0, len(old) - self.rng.choice([0, 1, 5000])))
        else:  # a longer one would pass for one that grew
            new = self.rng.randbytes(max(0, min(map(len, self.had[path])) - 1))
        self.put(path, new)
        for other, opened in self.opened:
            if other == path:
                opened.contents += [new] * (not appended and len(new) == opened.handle.size)
                opened.excused = opened.excused or not appended or self.here.connection.vehicle.reboots > 0
        await trio.sleep(self.rng.choice([0.0, 5.0, 25.0]))


async def act(seed: int, actions: int) -> int:
    """Let programs act on a vehicle; return how many reads were right."""
    rng = random.Random(seed)
    async with rig(rng.choice(["mavsdk", "px4"]), link=LinkSettings(rate=200_000.0, delay=0.01)) as here:
        programs = Programs(here, rng)
        await programs.run(actions)
    return programs.good


@settings(max_examples=5)
@given(st.integers(0, 2**32))
@example(8)
def test_every_read_is_right_or_an_error(seed: int) -> None:
    good = trio.run(act, seed, 25, clock=MockClock(autojump_threshold=0))
    assert good > 10 or seed != 8  # some are right


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
