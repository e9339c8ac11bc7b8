"""What a link has accepted but the kernel has not. Layer: link; pure.

Bounded: what does not fit is refused whole, never in part, so that a stream is never cut inside a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

MAX_DATAGRAM = 1400
"""Bytes: below any usual MTU, and far below PX4's receive chunk (31 frames in one datagram were cut)."""


def pack(frames: Sequence[bytes]) -> Iterable[bytes]:
    """Yield datagrams of whole frames, in order, each up to 1400 bytes unless one frame is longer."""
    if len(frames) == 1:
        yield frames[0]
        return
    batch: list[bytes] = []
    size = 0
    for frame in frames:
        if batch and size + len(frame) > MAX_DATAGRAM:
            yield b"".join(batch)
            batch, size = [], 0
        batch.append(frame)
        size += len(frame)
    if batch:
        yield b"".join(batch)


class Outbox:
    """A first-in first-out of byte strings with a limit on their sum."""

    def __init__(self, limit: int) -> None:
        self.size = 0
        self._limit = limit
        self._items: deque[bytes] = deque()

    def offer(self, item: bytes, *, force: bool = False) -> bool:
        """Append an item; return False, changing nothing, where it does not fit and is not forced."""
        if not force and self.size + len(item) > self._limit:
            return False
        self._items.append(item)
        self.size += len(item)
        return True

    def head(self) -> bytes | None:
        """Return the oldest item."""
        return self._items[0] if self._items else None

    def advance(self, sent: int) -> None:
        """Drop the first `sent` bytes of the oldest item."""
        item = self._items.popleft()
        self.size -= min(sent, len(item))
        if sent < len(item):
            self._items.appendleft(item[sent:])

    def clear(self) -> int:
        """Drop everything; return how many items that were."""
        count = len(self._items)
        self._items.clear()
        self.size = 0
        return count
