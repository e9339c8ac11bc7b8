"""Which bytes of a draft a new file on the vehicle has. Layer: cache; pure. Implements remote.UploadSource.

A byte is dirty, in flight, acked or proven (a Terminate was ACKed after it). It may be written again while
it is in flight; then it is dirty *and* in flight, and is not handed out before the older copy was accounted
for: two copies under way at once may reach the card in the wrong order.

One `Sending` serves one attempt at one remote file. A new attempt gets a new one, so whatever a late
upload still says of the old attempt changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from mavftpfs.shared.extents import ExtentSet

AHEAD = 64 * 1024
"""Bytes fetched from the spool at once, since chunks are small."""

FULL = 239
"""Bytes of a full request (servers.md 1)."""


class Sending:
    """One attempt to send a file of `size` bytes, which `read(start, stop)` returns.

    Attributes:
        unacked: bytes not ACKed yet.
        reached: one past the highest byte that may have been written to the remote file.
        progress: told how many bytes were ACKed.
        overtaken: the file was cut below `reached`, so the remote file is too long: it is to be given up.
        rewritten: bytes changed after they may have been sent, so that an older copy of them may come late.
        growing: more may be written behind the last byte; what fills no request there waits for it.
    """

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read = read
        self.overtaken = self.rewritten = self.growing = False
        self.progress: Callable[[int], None] | None = None
        self.reached = 0
        self._dirty = ExtentSet([(0, size)] if size else [])
        self._in_flight = ExtentSet()
        self._acked = ExtentSet()
        self._proven = ExtentSet()
        self._ahead = (0, b"")
        self._clear = 0  # nothing under way lies in the lowest dirty extent, if that begins below
        # ACKed in a row, and not entered yet: ACKs come one by one, a hundred thousand a second
        self._run = (0, 0)

    @property
    def unacked(self) -> int:
        """Bytes that are dirty or in flight."""
        self._enter_run()
        total = self._dirty.total
        for a, b in self._in_flight:
            total += sum([stop - start for start, stop in self._dirty.missing(a, b)])
        return total

    # --- the program's side

    def on_write(self, start: int, stop: int) -> None:
        """The draft's bytes [start, stop) changed: they go (again)."""
        self._enter_run()
        self._clear = 0
        self.rewritten |= start < self.reached
        self._dirty.add(start, stop)
        self._acked.discard(start, stop)
        self._proven.discard(start, stop)
        at, data = self._ahead
        if start < at + len(data) and at < stop:
            self._ahead = (0, b"")

    def on_cut(self, size: int) -> None:
        """The draft ends at `size` now."""
        self._enter_run()
        self._clear = 0
        self.overtaken |= size < self.reached
        for extents in (self._dirty, self._in_flight, self._acked, self._proven):
            extents.discard(size, max(extents.end, size))
        self._ahead = (0, b"")

    # --- the upload's side

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See cache.remote.UploadSource."""
        found = self._dirty.first()
        if found is None or self.overtaken:
            return None
        start, stop = found
        if self._run[1] > start:
            self._enter_run()  # an ACK of these bytes was not for the copy that goes now
        if start < self._clear:
            stop = min(stop, start + limit)
        elif (found := self._next_extent(limit)) is None:
            return None
        else:
            start, stop = found
        if self.growing and stop == self._dirty.end:
            stop -= (stop - start) % FULL
            if start == stop:
                return None
        at, ahead = self._ahead
        if at <= start and stop <= at + len(ahead):
            data = ahead[start - at : stop - at]
        else:
            data = self._fetch(start, stop)
        self._dirty.discard(start, stop)
        self._in_flight.add(start, stop)
        if stop > self.reached:
            self.reached = stop
        return start, data

    def on_acked(self, offset: int, count: int) -> None:
        """See cache.remote.UploadSource."""
        begin, end = self._run
        if offset == end:
            self._run = (begin, end + count)
        else:
            self._enter_run()
            self._run = (offset, offset + count)
        if self.progress is not None:
            self.progress(count)

    def on_unsent(self, offset: int, count: int) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._clear = 0
        self._move_back(self._in_flight.intersection(offset, offset + count))

    def on_checkpoint(self) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._move(self._acked, self._proven)

    def on_rollback(self, everything: bool) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._clear = 0
        self._move(self._in_flight, self._dirty)
        self._move(self._acked, self._dirty)
        if everything:
            self._move(self._proven, self._dirty)

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        for one, other in (
            (self._dirty, self._acked),
            (self._dirty, self._proven),
            (self._in_flight, self._acked),
            (self._in_flight, self._proven),
            (self._acked, self._proven),
        ):
            assert not any(other.overlaps(start, stop) for start, stop in one)

    # --- inside

    def _enter_run(self) -> None:
        offset, end = self._run
        if offset == end:
            return
        self._run = (0, 0)
        for start, stop in self._in_flight.intersection(offset, end):
            self._in_flight.discard(start, stop)
            for a, b in self._dirty.missing(start, stop):
                self._acked.add(a, b)

    def _next_extent(self, limit: int) -> tuple[int, int] | None:
        self._enter_run()
        first = self._dirty.first()
        if first is None:
            return None
        if not self._in_flight.overlaps(*first):
            self._clear = first[1]
            return first[0], min(first[1], first[0] + limit)
        for start, stop in self._dirty:
            for a, b in self._in_flight.missing(start, stop):
                return a, min(b, a + limit)
        return None

    def _fetch(self, start: int, stop: int) -> bytes:
        extent = next(iter(self._dirty.intersection(start, start + AHEAD)))
        data = self._read(start, max(stop, extent[1]))
        self._ahead = (start, data)
        return data[: stop - start]

    def _move(self, source: ExtentSet, target: ExtentSet) -> None:
        for start, stop in source:
            target.add(start, stop)
        source.clear()

    def _move_back(self, extents: list[tuple[int, int]]) -> None:
        for start, stop in extents:
            self._in_flight.discard(start, stop)
            self._dirty.add(start, stop)
