"""The bytes of a file that are to be sent, in flight, or on the card. Layer: shared; pure.

The cache makes a `SendBuffer` for each attempt to send a file, and reports changes to it. The session takes
chunks from the buffer, and reports their fate. Each attempt has its own buffer, so an upload of an earlier
attempt cannot change the present one.
"""

from __future__ import annotations

from collections.abc import Callable

from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.ranges import Ranges

AHEAD = 64 * 1024
"""Bytes fetched at once, since chunks are small."""

FULL = 239
"""Bytes of a full request (servers.md 1)."""


class SendBuffer:
    """One attempt to send a file of `size` bytes, which `read(start, stop)` returns; it raises MavftpfsError.

    The buffer hands out chunks from the file's beginning to its end. Bytes that were handed out may not
    change, because two copies of one byte could reach the card in the wrong order.

    Attributes:
        ranges: bytes that are to be sent, and bytes in flight. acked: bytes ACKed since the file was last
            closed. proven: bytes ACKed before the file was last closed.
        has_checkpoint: a Terminate was ACKed since the file was begun, so the card has the proven bytes.
        begun: CreateFile was sent, so the file was made, or emptied, for this attempt.
        handed_out: one past the highest byte that was ever handed out.
        invalidated: bytes changed, or were cut off, after they were handed out, so the file must be sent
            again.
        growing: more bytes may follow. Meanwhile the last bytes wait if they do not fill a request.
    """

    def __init__(
        self, read: Callable[[int, int], bytes], size: int, progress: Callable[[int], None] | None = None
    ) -> None:
        """Make a buffer; it calls `progress(count)` for each ACK, with its number of bytes."""
        self.size = size
        self.ranges = Ranges()
        self.ranges.todo.add(0, size)
        self.acked = ExtentSet()
        self.proven = ExtentSet()
        self.begun = self.has_checkpoint = self.invalidated = self.growing = False
        self._progress = progress
        self._read = read
        self.handed_out = 0
        self._ahead = (0, b"")

    @property
    def unacked(self) -> int:
        """Bytes not ACKed yet."""
        return self.size - self.acked.total - self.proven.total

    @property
    def reached(self) -> int:
        """One past the highest byte that was ACKed and not rolled back."""
        return max(self.acked.end, self.proven.end)

    def on_changed(self, start: int, size: int) -> None:
        """Note that the file changed from `start` on, perhaps to its end, and has `size` bytes now."""
        self.invalidated |= start < self.handed_out
        if size > self.size:
            self.ranges.todo.add(self.size, size)
        else:
            self.ranges.on_done(size, self.size)
        self.size = size
        if start < self._ahead[0] + len(self._ahead[1]):
            self._ahead = (0, b"")

    def has_more(self) -> bool:
        """Return whether there are bytes to send now."""
        return self._next(FULL) is not None

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """Return (offset, at most `limit` bytes), which count as in flight; None: nothing for now.

        Raises:
            MavftpfsError: the bytes could not be read. The next call tries again.
        """
        found = self._next(limit)
        if found is None:
            return None
        start, stop = found
        at, ahead = self._ahead
        if start < at or at + len(ahead) < stop:
            first = self.ranges.todo.first()
            assert first is not None
            at, ahead = start, self._read(start, max(stop, min(first[1], start + AHEAD)))
            self._ahead = (at, ahead)
        self.ranges.take(start, stop)
        self.handed_out = max(self.handed_out, stop)
        return start, ahead[start - at : stop - at]

    def on_acked(self, start: int, stop: int) -> None:
        """Note that these bytes were ACKed as written. Bytes ACKed for the first time are progress."""
        before = self.acked.total
        self.ranges.on_done(start, stop)
        self.acked.add(start, stop)
        if self._progress is not None:
            self._progress(self.acked.total - before)

    def check_point(self) -> None:
        """Note that Terminate was ACKed: all bytes ACKed before are proven written (not yet verified)."""
        self.has_checkpoint = True
        for start, stop in self.acked:
            self.proven.add(start, stop)
        self.acked = ExtentSet()

    def roll_back(self) -> None:
        """Note that the session was lost: all bytes without proof must be sent again."""
        self.acked = ExtentSet()
        self.ranges = Ranges()
        for start, stop in self.proven.missing(0, self.size):
            self.ranges.todo.add(start, stop)

    def start_over(self) -> None:
        """Note that the file is made anew, so no byte is proven."""
        self.begun, self.has_checkpoint, self.proven = True, False, ExtentSet()
        self.roll_back()

    def _next(self, limit: int) -> tuple[int, int] | None:
        """Return the next bytes to hand out."""
        found = self.ranges.todo.first()
        if found is None or self.invalidated:
            return None
        start, stop = found[0], min(found[1], found[0] + limit)
        if self.growing and stop == self.size:
            stop -= (stop - start) % FULL
        return (start, stop) if start < stop else None
