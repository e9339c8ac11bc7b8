"""Admission of bytes to a bounded memory. Layer: cache."""

from __future__ import annotations

from collections import deque

import trio


class Room:
    """First come, first served admission of pinned bytes, so that waiting readers cannot fill the memory."""

    def __init__(self, limit: int) -> None:
        """`limit`: bytes."""
        self._limit = limit
        self._queue: deque[tuple[int, trio.Event]] = deque()
        self.used = 0

    async def enter(self, count: int) -> None:
        """Wait for `count` bytes; one that is larger than the limit goes alone."""
        if not self._queue and self._fits(count):
            self.used += count
            return
        ticket = (count, trio.Event())
        self._queue.append(ticket)
        try:
            await ticket[1].wait()
        except BaseException:
            if ticket[1].is_set():
                self.leave(count)
            else:
                self._queue.remove(ticket)
                self._admit()
            raise

    def leave(self, count: int) -> None:
        """Give `count` bytes back."""
        self.used -= count
        self._admit()

    def _admit(self) -> None:
        while self._queue and self._fits(self._queue[0][0]):
            count, event = self._queue.popleft()
            self.used += count
            event.set()

    def _fits(self, count: int) -> bool:
        return self.used == 0 or self.used + count <= self._limit
