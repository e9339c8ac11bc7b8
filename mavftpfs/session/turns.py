"""Path operations and writes take turns where one spoils the other. Layer: session.

PX4 on NuttX checks each WriteFile against a scratch buffer that every path operation overwrites
(servers.md 8). Once that was seen, path operations wait until the writer has nothing in flight and says so.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import trio


class Turns:
    """Whose turn it is; free for all while nobody writes. on_wanted: asks the writer to make room."""

    def __init__(self, on_wanted: Callable[[], None]) -> None:
        self._on_wanted = on_wanted
        self._writing = False
        self._open = False
        self._waiting = 0
        self._inside = 0
        self._news = trio.Event()

    @property
    def wanted(self) -> bool:
        """Whether a path operation waits for its turn."""
        return self._writing and self._waiting > 0

    def set_writing(self, writing: bool) -> None:
        """Begin or end to keep path operations out."""
        self._writing = writing
        self._tell()

    @asynccontextmanager
    async def path_operation(self) -> AsyncIterator[None]:
        """Wait for the turn and keep it for the length of the body."""
        self._waiting += 1
        try:
            while self._writing and not self._open:
                self._on_wanted()
                await self._news.wait()
        finally:
            self._waiting -= 1
            self._tell()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1
            self._tell()

    async def give(self, seconds: float) -> None:
        """Let path operations in for at most so long, and wait until the last of them is out."""
        self._open = True
        self._tell()
        with trio.move_on_after(seconds):
            while self._waiting or self._inside:
                await self._news.wait()
        self._open = False
        while self._inside:
            await self._news.wait()

    def _tell(self) -> None:
        self._news.set()
        self._news = trio.Event()
