"""The vehicle's bytes that are here: blocks in memory, and the budget of all. Layer: cache.

`Blocks` holds what was read of one file on the vehicle. It is the sink that the file's reader fills, and the
place where reads wait for bytes; they are woken once per batch. `BlockCache` is the byte budget over all
files: blocks of BLOCK_SIZE bytes, least recently used first out. Code between awaits is atomic (trio);
nothing here awaits while state is half changed.

Suspect bytes (promise 1): servers share session ids between clients, so a reply that matches in every field
can carry bytes of another file. When the session layer notices that this may have happened, every byte that
arrived lately is dropped, and the reader is closed (`Card.on_distrust`): the next read opens a new one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import trio

from mavftpfs.cache.readahead import MAX_WINDOW
from mavftpfs.cache.remote import Reader
from mavftpfs.shared.errors import RequestTimeout
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.speed import Speed

NEVER = float("-inf")

BLOCK_SIZE = 128 * 1024
"""Bytes. Blocks of 64 KiB, and the replies put together from them (the kernel asks for 256 KiB), left holes
in malloc's heap that nothing fitted: a quarter of the cache's size."""

PIECE = 2 * BLOCK_SIZE
"""A read is served in pieces of at most so many bytes (what the kernel asks for at once)."""

AHEAD_SECONDS = 3.0
"""Seconds: what the measured rate carries in that time may be fetched ahead of a reader."""

SMALL_SECONDS = 2.0
"""A file that the link carries in this time is small: it is wanted whole."""

SMALL_FILE = 64 * 1024
"""Bytes of a file that is small whatever the rate."""


class RateMeter:
    """Bytes per second that arrive of one file after the other. Neither pauses nor the time between two files
    count, because small files measure round trips, and not the link.

    Attributes:
        rate: bytes per second, None while too little was seen. shown: what people are told, which takes
            longer to be known.
    """

    PAUSE = 1.0
    ENOUGH = 0.2
    MEMORY = 4.0

    def __init__(self) -> None:
        self.rate: float | None = None
        self.shown = Speed()
        self._last: float | None = None
        self._file: object = None
        self._bytes = 0.0
        self._busy = 0.0

    def on_bytes(self, count: int, now: float, file: object) -> None:
        """Note that `count` bytes of a file arrived."""
        self.shown.on_bytes(count, now)
        elapsed = self.PAUSE if self._last is None else now - self._last
        begins = file is not self._file
        self._last, self._file = now, file
        if begins or elapsed >= self.PAUSE:
            return
        self._bytes += count
        self._busy += elapsed
        if self._busy > self.MEMORY:  # older traffic counts half
            self._bytes /= 2
            self._busy /= 2
        if self._busy >= self.ENOUGH:
            self.rate = self._bytes / self._busy


class BlockCache:
    """The budget that all files share."""

    def __init__(self, budget: int, *, clock: Callable[[], float], patience: float) -> None:
        """Take the budget in bytes, and after how many seconds without progress a read gives up."""
        self.budget = budget
        self.clock = clock
        self.patience = patience
        self.meter = RateMeter()
        # A small cache has shorter pieces, or one slow read would keep all others waiting.
        self.piece = PIECE if budget >= 8 * PIECE else BLOCK_SIZE
        self.reads = trio.Semaphore(max(1, budget // 2 // (self.piece + BLOCK_SIZE)))
        """Each read that waits for a piece has it: its piece is not evicted, and all such pieces take at most
        half of the budget. It is a lock, see `pathlocks`: a task that holds a path alone must not wait for
        it."""
        self.bytes_cached = 0
        self.used: OrderedDict[tuple[Blocks, int], int] = OrderedDict()

    def readahead_limits(self, streams: int) -> tuple[int, int]:
        """Return the largest readahead window, and up to which size a file is wanted whole, in bytes, while
        `streams` files are being read. All windows together fit half of the cache."""
        limit, rate = min(self.budget // (2 * (streams + 1)), MAX_WINDOW), self.meter.rate
        if rate is None:
            return limit, SMALL_FILE
        limit = min(limit, int(rate * AHEAD_SECONDS))
        return limit, max(SMALL_FILE, min(limit, int(rate * SMALL_SECONDS)))

    def add(self, owner: Blocks, index: int, size: int) -> None:
        """Account for a new block, evicting older ones that no read waits for."""
        for _ in range(len(self.used)):
            if self.bytes_cached + size <= self.budget:
                break
            self._evict_oldest()
        self.used[owner, index] = size
        self.bytes_cached += size

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self.bytes_cached == sum(self.used.values())
        assert self.bytes_cached <= self.budget
        for owner, index in self.used:
            assert owner.block(index) is not None

    def _evict_oldest(self) -> None:
        owner, index = next(iter(self.used))
        if index in owner.pinned():
            self.used.move_to_end((owner, index))  # in use after all
        else:
            owner.evict(index)


@dataclass(slots=True, eq=False)
class _Waiter:
    start: int
    stop: int
    missing: list[tuple[int, int]]
    woken: trio.Event
    scope: trio.CancelScope
    error: Exception | None = None


class Blocks:
    """The bytes read of one file on the vehicle; implements cache.remote.ReadSink.

    Attributes:
        size: bytes of the vehicle's file, by the reply to its last open.
        opened_at: when the vehicle opened the file that the present bytes come from, by the caches' clock.
        reader: where bytes come from, if the file is open there.
        received, received_at: bytes that arrived, and when.
    """

    def __init__(self, cache: BlockCache) -> None:
        self.size = 0
        self.opened_at = NEVER
        self.reader: Reader | None = None
        self.received, self.received_at = 0, NEVER
        self._cache = cache
        self._blocks: dict[int, bytearray] = {}
        self._present = ExtentSet()
        self._waiters: list[_Waiter] = []

    def block(self, index: int) -> bytearray | None:
        """Return a block if it is here."""
        return self._blocks.get(index)

    @property
    def waited_for(self) -> bool:
        """Whether a read waits for bytes."""
        return bool(self._waiters)

    @property
    def progress(self) -> int:
        """The number of the file's bytes that are here."""
        return min(self.size, max(self.received, self._present.total))

    # --- the sink

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) that are not here yet, within the file."""
        return self._present.missing(start, min(stop, self.size))

    def on_opened(self, at: float) -> None:
        """See ReadSink: the bytes from now on are of the file that was opened at that time."""
        self.opened_at = max(self.opened_at, at)

    def on_data(self, offset: int, data: bytes | memoryview) -> None:
        """Keep bytes that are not here yet, up to the opened size."""
        count = len(data)
        block = self._blocks.get(offset // BLOCK_SIZE)
        at = offset % BLOCK_SIZE
        if block is not None and at + count <= len(block) and self._present.end <= offset:
            # The usual chunk of a file that is read from front to back.
            block[at : at + count] = data
            self._present.add(offset, offset + count)
            return
        self._keep(offset, data)

    def _keep(self, offset: int, data: bytes | memoryview) -> None:
        """Keep bytes where none are here yet."""
        whole = memoryview(data)
        for at, stop in self._present.missing(offset, min(offset + len(data), self.size)):
            while at < stop:
                index = at // BLOCK_SIZE
                block_start = index * BLOCK_SIZE
                block = self._blocks.get(index)
                if block is None:
                    length = min(BLOCK_SIZE, self.size - block_start)
                    self._cache.add(self, index, length)
                    block = self._blocks[index] = bytearray(length)
                end = min(stop, block_start + BLOCK_SIZE)
                block[at - block_start : end - block_start] = whole[at - offset : end - offset]
                self._present.add(at, end)
                at = end

    def on_batch(self, count: int) -> None:
        """Wake the reads whose bytes are all here; give more time to those that got some."""
        self.received += count
        self.received_at = self._cache.clock()
        self._cache.meter.on_bytes(count, self.received_at, self)
        for waiter in self._waiters:
            missing = self.missing(waiter.start, waiter.stop)
            if not missing:
                waiter.woken.set()
            elif missing != waiter.missing:
                waiter.scope.deadline = trio.current_time() + self._cache.patience
            waiter.missing = missing

    def on_queued(self) -> None:
        """Give reads that wait more time: the reader waits for its turn."""
        for waiter in self._waiters:
            waiter.scope.deadline = trio.current_time() + self._cache.patience

    def on_failed(self, error: Exception) -> None:
        """Reads that wait get the error; later ones ask again."""
        for waiter in self._waiters:
            if not waiter.woken.is_set():
                waiter.error = error
                waiter.woken.set()

    def ask_again(self) -> None:
        """Make reads that wait ask again for their missing bytes, because their reader is gone."""
        for waiter in self._waiters:
            waiter.woken.set()

    # --- for its file

    def close_reader(self) -> None:
        """Close the remote reader; reads that wait for its bytes ask again."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()
        self.ask_again()

    def drop(self) -> None:
        """Forget every byte; reads that wait ask again."""
        for index in list(self._blocks):
            self.evict(index)
        self.ask_again()

    def end(self, error: Exception) -> None:
        """Close the reader and forget every byte, because the vehicle's file is another one; reads that wait
        get the error."""
        self.on_failed(error)
        self.close_reader()
        self.drop()

    # --- for the cache

    def pinned(self) -> set[int]:
        """Return the blocks that reads wait for."""
        found: set[int] = set()
        for waiter in self._waiters:
            found.update(range(waiter.start // BLOCK_SIZE, -(-waiter.stop // BLOCK_SIZE)))
        return found

    def evict(self, index: int) -> None:
        """Forget a block."""
        del self._blocks[index]
        self._cache.bytes_cached -= self._cache.used.pop((self, index))
        start = index * BLOCK_SIZE
        self._present.discard(start, start + BLOCK_SIZE)

    # --- reading

    def get(self, start: int, stop: int) -> bytes | memoryview | None:
        """Return [start, stop) if all of it is here; without a copy if it lies in one block.

        0 <= start < stop <= size.
        """
        if not self._present.covers(start, stop):
            return None
        parts = []
        while start < stop:
            index = start // BLOCK_SIZE
            self._cache.used.move_to_end((self, index))
            block_start = index * BLOCK_SIZE
            end = min(stop, block_start + BLOCK_SIZE)
            parts.append(
                memoryview(self._blocks[index])[start - block_start : end - block_start].toreadonly()
            )
            start = end
        return parts[0] if len(parts) == 1 else b"".join(parts)

    async def wait_for(self, start: int, stop: int) -> None:
        """Wait for the missing bytes of [start, stop), at most a piece, which the caller has just asked for.
        `get` may find nothing afterwards, if bytes were dropped. After a cancellation or a time-out, bytes
        that no other read waits for are not fetched.

        Raises:
            RequestTimeout: none of the missing bytes came for `patience` seconds. Otherwise the
                error of on_failed.
        """
        missing = self.missing(start, stop)
        if not missing:
            return
        scope = trio.CancelScope(deadline=trio.current_time() + self._cache.patience)
        waiter = _Waiter(start, stop, missing, trio.Event(), scope)
        self._waiters.append(waiter)
        try:
            with scope:
                await waiter.woken.wait()
        finally:
            self._waiters.remove(waiter)
            if not waiter.woken.is_set() and self.reader is not None:
                self.reader.drop()
                for other in self._waiters:
                    self.reader.want(other.start, other.stop, demand=True)
        if waiter.error is not None:
            raise waiter.error.with_traceback(None)
        if not waiter.woken.is_set():
            raise RequestTimeout(f"no data came for {self._cache.patience:g} s")

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self._present.end <= self.size
        for start, stop in self._present:
            assert all(i in self._blocks for i in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)))
