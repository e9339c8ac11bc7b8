"""Versions of remote files: what is known of them, their bytes, and the budget of all. Layer: cache.

A `Version` is a file as it was when it was opened: its size, and its time where listings tell it. Handles of
one version share its bytes and its remote reader. When another file turns out to have the path, or we
write it, the version is REPLACED: its handles get FileChanged, and later opens start a new version.

A version is the sink that its reader fills; reads that wait for bytes are woken once per batch. `BlockCache`
is the byte budget over all: blocks of BLOCK_SIZE bytes, least recently used first out. Code between awaits is
atomic (trio); nothing here awaits while state is half changed.

Bytes in doubt (promise 1). Servers share session ids between clients, so a reply that matches in every field
can carry bytes of another file. When the session layer notices that this may have happened (`on_suspect`),
every byte is dropped, and bytes that still come from the present reader are ignored: the next read opens a
new one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import trio

from mavftpfs.cache.readahead import MAX_WINDOW
from mavftpfs.cache.remote import Reader
from mavftpfs.shared.errors import FileChanged, RequestTimeout
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.sameness import Known
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
    """How many bytes per second come of one file after the other. Neither pauses count, nor the time between
    two files: small files tell of round trips, and not of the link.

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
        self.used: OrderedDict[tuple[Version, int], int] = OrderedDict()

    def readahead_limits(self, streams: int) -> tuple[int, int]:
        """Return the largest readahead window, and up to which size a file is wanted whole, in bytes, while
        `streams` files are being read. All windows together fit half of the cache."""
        limit, rate = min(self.budget // (2 * (streams + 1)), MAX_WINDOW), self.meter.rate
        if rate is None:
            return limit, SMALL_FILE
        limit = min(limit, int(rate * AHEAD_SECONDS))
        return limit, max(SMALL_FILE, min(limit, int(rate * SMALL_SECONDS)))

    def add(self, owner: Version, index: int, size: int) -> None:
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


class VersionState(Enum):
    """What is known of a version."""

    CURRENT = "current"
    """The path was proven to be this file since the server last opened it."""
    UNPROVEN = "unproven"
    """The server opened the path again after the last proof, or restarted."""
    REPLACED = "replaced"
    """Another file has the path now. This state is final."""


class Version:
    """A file as it was when it was opened; implements cache.remote.ReadSink. Times are those of the caches'
    clock.

    Attributes:
        path: its present path. size: in bytes, by the open reply. mtime: None if not known to belong to this
            size.
        proven_at: when the path was last proven to be this file; NEVER after the vehicle restarted.
        opened_at: when the server opened the file for the present session.
        compare_after: until then no listing is asked for only to compare it.
        reader: where its bytes come from, if it is open. handles: how many are open. in_kernel: the kernel
            may have pages of it, and all of them are right.
        ignores_data: what comes from the present reader is ignored, until a new one is opened.
        doubts: how often all bytes were dropped because they were in doubt.
    """

    def __init__(
        self,
        cache: BlockCache,
        path: bytes,
        size: int = 0,
        mtime: int | None = None,
        *,
        on_doubt: Callable[[Version], None] = lambda version: None,
    ) -> None:
        """`on_doubt` is called when its bytes are dropped in doubt: the kernel may have copies."""
        self.path = path
        self.size = size
        self.mtime = mtime
        self.reader: Reader | None = None
        self.handles = 0
        self.proven_at = cache.clock()
        self.opened_at = self.compare_after = NEVER
        self.in_kernel = self.ignores_data = False
        self.doubts = 0
        self._why = ""  # it was replaced
        self._on_doubt = on_doubt
        self._cache = cache
        self._blocks: dict[int, bytearray] = {}
        self._present = ExtentSet()
        self._waiters: list[_Waiter] = []
        self.received = 0
        self.received_at = NEVER

    def block(self, index: int) -> bytearray | None:
        """Return a block if it is here."""
        return self._blocks.get(index)

    @property
    def waited_for(self) -> bool:
        """Whether a read waits for bytes."""
        return bool(self._waiters)

    @property
    def progress(self) -> int:
        """How many of the file's bytes came, or were here before."""
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
        if self.ignores_data:
            return
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

    def on_suspect(self, reason: str) -> None:
        """Drop every byte, given out or not; reads that wait ask again."""
        if self.ignores_data:
            return
        self.ignores_data = True
        self.doubts += 1
        for index in list(self._blocks):
            self.evict(index)
        self.ask_again()
        self._on_doubt(self)

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

    # --- life of the version

    @property
    def state(self) -> VersionState:
        """See VersionState."""
        if self._why:
            return VersionState.REPLACED
        return VersionState.CURRENT if self.proven_at >= self.opened_at else VersionState.UNPROVEN

    @property
    def current(self) -> bool:
        """Whether it is in the state CURRENT."""
        return self.state is VersionState.CURRENT

    @property
    def replaced(self) -> bool:
        """Whether it is in the state REPLACED."""
        return self.state is VersionState.REPLACED

    @property
    def known(self) -> Known:
        """What it is compared by."""
        restarted = self.proven_at == NEVER
        return Known(self.size, self.mtime, restarted=restarted)

    def require_not_replaced(self) -> None:
        """Raise FileChanged if another file has the path."""
        if self.replaced:
            raise FileChanged(self._why)

    def prove(self, at: float) -> None:
        """Note a proof that the path was this file at that time."""
        self.proven_at = max(self.proven_at, at)

    def on_restart(self, at: float) -> None:
        """Forget all proofs, because the vehicle restarted."""
        self.proven_at = self.compare_after = NEVER
        self.on_opened(at)

    def close_reader(self) -> None:
        """Close the remote reader. What is wanted of it does not come any more."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()

    def mark_replaced(self, why: str) -> None:
        """Become REPLACED: another file has the path. Reads that wait get FileChanged with this reason."""
        self._why = why
        self.close_reader()
        self.on_failed(FileChanged(why))
        self.clear()

    def clear(self) -> None:
        """Forget every block that no read waits for."""
        pinned = self.pinned()
        for index in list(self._blocks):
            if index not in pinned:
                self.evict(index)

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
        `get` may find nothing afterwards, if bytes were dropped. Bytes for which no read waits any more,
        after a cancellation or a time-out, are not fetched.

        Raises:
            RequestTimeout: none of the missing bytes came for `patience` seconds. Else what on_failed got.
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
