"""A gate that all FTP traffic passes, and that can be held shut. Layer: session.

A stale session of ArduPilot's dies only if *nothing* is answered for 3 s, NAKs included (servers.md 1), so
waiting for it means that everybody waits.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio


class Gate:
    """Counts who is inside; while shut nobody enters."""

    def __init__(self) -> None:
        self._inside = 0
        self._shut = 0
        self._changed = trio.Event()

    @property
    def shut(self) -> bool:
        """Whether entering would wait."""
        return self._shut > 0

    @asynccontextmanager
    async def passing(self) -> AsyncIterator[None]:
        """Hold this while requests may be on the wire."""
        while self._shut:
            await self._changed.wait()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1
            self._notify()

    @asynccontextmanager
    async def held_shut(self, patience: float) -> AsyncIterator[bool]:
        """Let nobody in, and stay shut for the body once everybody is out.

        Yields False, no longer holding it, if somebody was still inside after `patience` seconds: a sweep
        of a huge directory must not keep everybody else out until it ends. The last who holds it opens it.
        """
        self._shut += 1
        holding = True
        try:
            with trio.move_on_after(patience):
                while self._inside:
                    await self._changed.wait()
            if self._inside:
                holding = False
                self._open()
            yield holding
        finally:
            if holding:
                self._open()

    def _open(self) -> None:
        """One of those who hold it shut lets go."""
        self._shut -= 1
        self._notify()

    def _notify(self) -> None:
        self._changed.set()
        self._changed = trio.Event()
