"""The queue of frames for the port, and which one is next. Layer: hub; pure.

Each side has a queue, and the sides take turns: a frame of a ground station waits for one frame of each other
side, whatever is queued there. On a serial port no more is handed to the kernel than the line carries in
50 ms, since nothing overtakes what the kernel has.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import NamedTuple

from mavftpfs.hub.senders import Place

LINE_TIME = 0.05
"""Seconds of a serial line's rate that may be queued in the kernel."""
_BITS_PER_BYTE = 10


class Waiting(NamedTuple):
    """A frame, and where it goes."""

    place: Place
    frame: bytes


class Outbox:
    """A queue for each side. limit: bytes that one side may have waiting; what does not fit is dropped."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._sizes: Counter[int] = Counter()
        self._queues: OrderedDict[int, deque[Waiting]] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._queues)

    def push(self, side: int, waiting: Waiting) -> None:
        """Append a frame that came from a side."""
        size = self._sizes[side] + len(waiting.frame)
        if size <= self._limit:
            self._sizes[side] = size
            self._queues.setdefault(side, deque()).append(waiting)

    def pop(self) -> Waiting:
        """Take the next frame. There must be one."""
        side, queue = next(iter(self._queues.items()))
        waiting = queue.popleft()
        self._sizes[side] -= len(waiting.frame)
        if queue:
            self._queues.move_to_end(side)
        else:
            del self._queues[side], self._sizes[side]
        return waiting


class Line:
    """When a line takes more. baud: None where the kernel itself tells (sockets, USB)."""

    def __init__(self, baud: int | None) -> None:
        self._rate = None if baud is None else baud / _BITS_PER_BYTE
        self._busy_until = 0.0

    def ready_at(self) -> float:
        """Return from when on a frame may be handed to the kernel."""
        return self._busy_until - LINE_TIME

    def sent(self, size: int, now: float) -> None:
        """Note that so many bytes were handed to the kernel."""
        if self._rate is not None:
            self._busy_until = max(now, self._busy_until) + size / self._rate
