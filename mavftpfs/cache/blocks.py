"""Cached bytes of remote files. Layer: cache.

`BlockCache` is the byte budget over all files: blocks of BLOCK_SIZE bytes, least recently used first out.
`FileBlocks` holds one version of one file; it is the sink that a remote reader fills, and wakes readers
once per batch. Code between awaits is atomic (trio); nothing here awaits while state is half changed.

Proven and provisional bytes (promise 1). Servers share session ids between clients, so perfectly matching
replies can carry another file. When the session layer notices that this may have happened (`on_suspect`),
every byte that came since the current reader was opened is provisional, and so is what still comes, until
`accept` (size and CRC32 agreed) or `drop_unproven`. Provisional bytes are never returned. Bytes returned
before the suspicion arose cannot be taken back; but as long as all of them are held (`intact`), a CRC32 of
the file still tells whether they are its bytes.
"""

from __future__ import annotations

import zlib
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import trio

from mavftpfs.cache.openings import Openings
from mavftpfs.cache.readahead import Pace, RateMeter
from mavftpfs.cache.room import Room
from mavftpfs.shared.errors import RequestTimeout
from mavftpfs.shared.extents import ExtentSet

BLOCK_SIZE = 128 * 1024
"""Bytes: what malloc still keeps apart well. Blocks of 64 KiB, and the replies put together from them (the
kernel asks for 256 KiB), left a quarter of the cache's size in unusable holes."""

Gaps = list[tuple[int, int]]


class BlockCache:
    """The budget that all files share."""

    def __init__(self, budget: int, *, clock: Callable[[], float], patience: float) -> None:
        """Take the budget in bytes, and after how many seconds without progress a read gives up."""
        self.budget = budget
        self.clock = clock
        self.patience = patience
        self.meter = RateMeter()
        self.room = Room(budget // 2)
        self.bytes_cached = 0
        self.evictions = 0
        self._blocks: OrderedDict[tuple[FileBlocks, int], int] = OrderedDict()

    @property
    def provable(self) -> int:
        """The largest file that can be held whole beside the others, in bytes."""
        return self.budget // 2

    def pace(self, streams: int) -> Pace:
        """Return the bounds for readahead while `streams` files are being read."""
        return Pace(self.budget, streams, self.meter.rate)

    def add(self, owner: FileBlocks, index: int, size: int) -> None:
        """Account for a new block, evicting older ones that nobody waits on."""
        for _ in range(len(self._blocks)):
            if self.bytes_cached + size <= self.budget:
                break
            self._evict_oldest()
        self._blocks[owner, index] = size
        self.bytes_cached += size

    def touch(self, owner: FileBlocks, index: int) -> None:
        """Note that a block was read."""
        self._blocks.move_to_end((owner, index))

    def remove(self, owner: FileBlocks, index: int) -> None:
        """A block is gone."""
        self.bytes_cached -= self._blocks.pop((owner, index))

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self.bytes_cached == sum(self._blocks.values())
        assert self.bytes_cached <= self.budget
        for owner, index in self._blocks:
            assert index in owner

    def _evict_oldest(self) -> None:
        owner, index = next(iter(self._blocks))
        if owner.pinned(index):
            self.touch(owner, index)  # in use after all
        else:
            self.evictions += 1
            owner.evict(index)


@dataclass(slots=True, eq=False)
class _Waiter:
    start: int
    stop: int
    lacking: int
    done: trio.Event
    scope: trio.CancelScope
    error: Exception | None = None


class FileBlocks:
    """The cached bytes of one version of a file; implements cache.remote.ReadSink."""

    def __init__(self, cache: BlockCache, size: int = 0) -> None:
        self._cache = cache
        self.size = size
        self.suspicion: str | None = None
        self._blocks: dict[int, bytearray] = {}
        self._present = ExtentSet()
        self._proven = ExtentSet()  # INVARIANT: a subset of _present
        self._given = ExtentSet()
        self._pins: dict[int, int] = {}
        self._waiters: list[_Waiter] = []
        self._arrived = 0
        self.received = 0
        self.received_at = float("-inf")
        self.intact = True
        self.openings = Openings()
        self._pristine = True

    def __contains__(self, index: int) -> bool:
        """Return whether the block is held."""
        return index in self._blocks

    @property
    def empty(self) -> bool:
        """Whether no byte is held."""
        return not self._blocks

    @property
    def waited_for(self) -> bool:
        """Whether somebody waits for bytes."""
        return bool(self._waiters)

    @property
    def done(self) -> int:
        """How many of the file's bytes came, or are held from before."""
        return min(self.size, max(self.received, self._present.total))

    @property
    def complete(self) -> bool:
        """Whether every byte is held, none of them provisional."""
        return self._usable(0, self.size)

    @property
    def given(self) -> bool:
        """Whether a program got any of the bytes."""
        return not self._given.empty

    # --- the sink

    def missing(self, start: int, stop: int) -> Gaps:
        """Return the parts of [start, stop) not yet held, within the file."""
        return self._present.missing(start, min(stop, self.size))

    def on_opened(self, at: float) -> None:
        """What comes from now on is of the file that was opened at that time."""
        self.openings.on_opened(at, first=self._pristine and not self.given)

    def on_data(self, offset: int, data: bytes | memoryview) -> None:
        """Keep what is not held yet; what lies beyond the opened size is dropped."""
        count = len(data)
        block = self._blocks.get(offset // BLOCK_SIZE)
        at = offset % BLOCK_SIZE
        if block is not None and at + count <= len(block) and self._present.end <= offset:
            # The usual chunk of a file that is read from front to back.
            block[at : at + count] = data
            self._present.add(offset, offset + count)
            self._arrived += count
            return
        stop = min(offset + count, self.size)
        for start, end in self._present.missing(offset, stop):
            self._write(start, end, memoryview(data)[start - offset : end - offset])
            self._arrived += end - start

    def preload(self, offset: int, data: bytes | memoryview) -> None:
        """Keep bytes that did not come over the link."""
        for start, end in self._present.missing(offset, min(offset + len(data), self.size)):
            self._write(start, end, memoryview(data)[start - offset : end - offset])

    def on_batch(self) -> None:
        """Wake those whose range is complete; give those whose range grew more time."""
        if self._arrived:
            self.received += self._arrived
            self.received_at = self._cache.clock()
            self._cache.meter.on_bytes(self._arrived, self._cache.clock())
            self._arrived = 0
        for waiter in self._waiters:
            lacking = self._lacking(waiter.start, waiter.stop)
            if lacking == 0:
                waiter.done.set()
            elif lacking < waiter.lacking:
                waiter.scope.deadline = trio.current_time() + self._cache.patience
            waiter.lacking = lacking

    def on_suspect(self, reason: str) -> None:
        """Bytes that came since the reader was opened, and that still come, are provisional."""
        if self.suspicion is None:
            self.suspicion = reason

    def on_failed(self, error: Exception) -> None:
        """Those who wait get the error; later reads ask again."""
        for waiter in self._waiters:
            if not waiter.done.is_set():
                waiter.error = error
                waiter.done.set()

    def ask_again(self) -> None:
        """Those who wait look again, and ask anew for what is missing: their reader is gone."""
        for waiter in self._waiters:
            waiter.done.set()

    # --- life of the version

    def begin_reading(self) -> None:
        """A reader is about to be opened: what is held now did not come from it."""
        if self.suspicion is None:
            self._proven = self._present.copy()

    def accept(self) -> None:
        """Everything held is the vehicle's: size and CRC32 agreed."""
        self.suspicion = None
        self._proven = self._present.copy()

    def on_given(self, start: int, stop: int) -> None:
        """A program, or the kernel for it, got [start, stop)."""
        self._given.add(start, stop)

    def start_over(self) -> None:
        """Forget every byte, proven or not; whoever waits starts anew."""
        self._proven.clear()
        self.drop_unproven()
        self._pristine = True

    def drop_unproven(self) -> None:
        """Forget provisional bytes; whoever waits starts anew."""
        self.suspicion = None
        self._present = self._proven.copy()
        self.intact = self.intact and all(self._present.covers(*extent) for extent in self._given)
        for index in list(self._blocks):
            if self._present.overlaps(*self._extent(index)):
                self._blocks[index] = bytearray(self._blocks[index])  # a view of the old one may be in use
            else:
                self._forget_block(index)
        for waiter in self._waiters:
            waiter.done.set()

    def clear(self) -> None:
        """Forget every block that no reader waits on."""
        for index in list(self._blocks):
            if not self.pinned(index):
                self.evict(index)

    # --- for the cache

    def pinned(self, index: int) -> bool:
        """Return whether somebody waits on the block."""
        return index in self._pins

    def evict(self, index: int) -> None:
        """Forget a block."""
        self._forget_block(index)
        start, stop = self._extent(index)
        self.intact = self.intact and not self._given.overlaps(start, stop)
        self._present.discard(start, stop)
        self._proven.discard(start, stop)

    # --- reading

    def get(self, start: int, stop: int) -> bytes | memoryview | None:
        """Return [start, stop) if it is held and not provisional. 0 <= start < stop <= size."""
        return self._view(start, stop) if self._usable(start, stop) else None

    async def fill(self, start: int, stop: int, want: Callable[[Gaps], None]) -> None:
        """Ask `want` for what is missing of [start, stop), which must be held, and wait for it.

        `get` may find nothing afterwards: the bytes came provisional, or were dropped. `want` is called
        before anything is awaited.

        Raises:
            RequestTimeout: none of the missing bytes came for `patience` seconds. Else what on_failed got.
        """
        gaps = self.missing(start, stop)
        if not gaps:
            return
        want(gaps)
        scope = trio.CancelScope(deadline=trio.current_time() + self._cache.patience)
        waiter = _Waiter(start, stop, self._lacking(start, stop), trio.Event(), scope)
        self._waiters.append(waiter)
        try:
            with scope:
                await waiter.done.wait()
        finally:
            self._waiters.remove(waiter)
        if waiter.error is not None:
            raise waiter.error.with_traceback(None)
        if not waiter.done.is_set():
            raise RequestTimeout(f"no data came for {self._cache.patience:g} s")

    @asynccontextmanager
    async def held(self, start: int, stop: int) -> AsyncIterator[None]:
        """Keep the blocks of [start, stop) from being evicted; waits for room.

        Raises:
            RequestTimeout: other readers kept the room for `patience` seconds.
        """
        indices = range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE))
        count = len(indices) * BLOCK_SIZE
        with trio.move_on_after(self._cache.patience) as scope:
            await self._cache.room.enter(count)
        if scope.cancelled_caught:
            raise RequestTimeout(f"no room for a read within {self._cache.patience:g} s")
        for index in indices:
            self._pins[index] = self._pins.get(index, 0) + 1
        try:
            yield
        finally:
            for index in indices:
                self._unpin(index)
            self._cache.room.leave(count)

    async def crc32(self) -> int:
        """Return the CRC32 (start value 0, no final xor: servers.md 10) of all bytes, which must be held."""
        value = 0xFFFFFFFF
        for index in sorted(self._blocks):
            value = zlib.crc32(self._blocks[index], value)
            await trio.lowlevel.checkpoint()
        return value ^ 0xFFFFFFFF

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self._present.end <= self.size
        for start, stop in self._proven:
            assert self._present.covers(start, stop)
        for start, stop in self._present:
            assert all(i in self._blocks for i in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)))
        assert len(self._waiters) <= sum(self._pins.values())

    # --- inside

    def _usable(self, start: int, stop: int) -> bool:
        return (self._present if self.suspicion is None else self._proven).covers(start, stop)

    def _lacking(self, start: int, stop: int) -> int:
        return sum(end - begin for begin, end in self._present.missing(start, stop))

    def _extent(self, index: int) -> tuple[int, int]:
        start = index * BLOCK_SIZE
        return start, min(start + BLOCK_SIZE, self.size)

    def _write(self, start: int, stop: int, data: memoryview) -> None:
        while start < stop:
            index = start // BLOCK_SIZE
            block = self._blocks.get(index)
            if block is None:
                block = self._new_block(index)
            base = index * BLOCK_SIZE
            end = min(stop, base + BLOCK_SIZE)
            block[start - base : end - base] = data[: end - start]
            self._present.add(start, end)
            data = data[end - start :]
            start = end

    def _new_block(self, index: int) -> bytearray:
        self._pristine = False
        start, stop = self._extent(index)
        self._cache.add(self, index, stop - start)
        block = self._blocks[index] = bytearray(stop - start)
        return block

    def _forget_block(self, index: int) -> None:
        del self._blocks[index]
        self._cache.remove(self, index)

    def _unpin(self, index: int) -> None:
        self._pins[index] -= 1
        if not self._pins[index]:
            del self._pins[index]

    def _view(self, start: int, stop: int) -> bytes | memoryview:
        """Return the bytes; without a copy if they lie in one block."""
        parts = []
        while start < stop:
            index = start // BLOCK_SIZE
            self._cache.touch(self, index)
            base = index * BLOCK_SIZE
            end = min(stop, base + BLOCK_SIZE)
            parts.append(memoryview(self._blocks[index])[start - base : end - base].toreadonly())
            start = end
        return parts[0] if len(parts) == 1 else b"".join(parts)
