"""The queue of frames for the port, and which one is next. Layer: hub; pure.

Each side has a queue, and the sides take turns: a frame of a ground station waits for one frame of each other
side, however many are queued there. On a serial port the hub hands the kernel only what the line carries in
50 ms, because a frame cannot overtake those in the kernel.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import NamedTuple

from mavftpfs.hub.senders import Place

LINE_TIME = 0.05
"""Seconds of a serial line's rate that may be queued in the kernel."""
_BITS_PER_BYTE = 10


class Waiting(NamedTuple):
    """A frame and its destination."""

    place: Place
    frame: bytes


class Outbox:
    """A queue for each side. limit: bytes that may wait for one side; the queue drops frames beyond it."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._sizes: Counter[int] = Counter()
        self._queues: OrderedDict[int, deque[Waiting]] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._queues)

    def push(self, side: int, waiting: Waiting) -> None:
        """Append a frame from a side, or drop it where there is no room."""
        size = self._sizes[side] + len(waiting.frame)
        if size <= self._limit:
            self._sizes[side] = size
            self._queues.setdefault(side, deque()).append(waiting)

    def pop(self) -> Waiting:
        """Remove and return the next frame. The outbox must not be empty."""
        side, queue = next(iter(self._queues.items()))
        waiting = queue.popleft()
        self._sizes[side] -= len(waiting.frame)
        if queue:
            self._queues.move_to_end(side)
        else:
            del self._queues[side], self._sizes[side]
        return waiting


class LinePace:
    """The times at which a line takes more bytes. baud: None where the kernel itself tells (sockets, USB)."""

    def __init__(self, baud: int | None) -> None:
        self._rate = None if baud is None else baud / _BITS_PER_BYTE
        self._busy_until = 0.0

    def ready_at(self) -> float:
        """Return the time from which the kernel may be handed a frame."""
        return self._busy_until - LINE_TIME

    def sent(self, size: int, now: float) -> None:
        """Note that the kernel was handed so many bytes."""
        if self._rate is not None:
            self._busy_until = max(now, self._busy_until) + size / self._rate
