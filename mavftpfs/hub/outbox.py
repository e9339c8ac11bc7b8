"""What waits to go out over the port, and which frame is next. Layer: hub; pure.

Forwarded frames and frames of our own programs go out alternately, and so do the sides among each. So a
forwarded frame waits for at most one frame of ours, whatever is queued. On a serial port no more is handed to
the kernel than the line carries in 50 ms, since nothing overtakes what the kernel has.
"""

from __future__ import annotations

from collections import OrderedDict, deque
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
    """A queue for each side. limit: bytes that one side may have waiting; what does not fit is refused.

    Attributes:
        dropped: frames refused.
    """

    def __init__(self, limit: int) -> None:
        self.dropped = 0
        self._limit = limit
        self._sizes: dict[int, int] = {}
        self._queues: dict[bool, OrderedDict[int, deque[Waiting]]] = {
            True: OrderedDict(),
            False: OrderedDict(),
        }
        self._forwarded_next = True

    def __bool__(self) -> bool:
        return any(self._queues.values())

    def push(self, side: int, waiting: Waiting, *, forwarded: bool) -> None:
        """Append a frame that came from a side."""
        size = self._sizes.get(side, 0)
        if size + len(waiting.frame) > self._limit:
            self.dropped += 1
            return
        self._sizes[side] = size + len(waiting.frame)
        self._queues[forwarded].setdefault(side, deque()).append(waiting)

    def pop(self) -> Waiting:
        """Take the next frame. There must be one."""
        first = self._forwarded_next
        queues = self._queues[first] or self._queues[not first]
        self._forwarded_next = queues is not self._queues[True]
        side, queue = next(iter(queues.items()))
        waiting = queue.popleft()
        self._sizes[side] -= len(waiting.frame)
        if queue:
            queues.move_to_end(side)
        else:
            del queues[side], self._sizes[side]
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
