"""Which names are being changed: changes that concern one another wait for each other. Layer: cache.

Two changes concern one another if they name the same path, in any case, or one names a directory above the
other's. All others go on side by side, so that one that is not answered holds up nobody else.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.shared.errors import RequestTimeout

SLACK = 5.0
"""Seconds that a change may take longer than its patience: to look what became of it."""


class PathLocks:
    """Locks on sets of paths, given in the order in which they were asked for."""

    def __init__(self, patience: float) -> None:
        """`patience`: seconds to wait for a lock; with the change that follows SLACK more."""
        self._patience = patience
        self._held: list[tuple[bytes, ...]] = []
        self._news = trio.Event()

    @asynccontextmanager
    async def hold(self, *paths: bytes) -> AsyncIterator[None]:
        """Hold the paths for the length of the body; one that had to wait may not last its full time.

        Raises:
            RequestTimeout: others took too long.
        """
        wanted = tuple(path.lower() for path in paths)
        began = trio.current_time()
        with trio.CancelScope(deadline=began + self._patience) as scope:
            self._held.append(wanted)
            try:
                waited = await self._wait(wanted)
                scope.deadline = began + self._patience + SLACK if waited else float("inf")
                yield
            finally:
                self._held = [held for held in self._held if held is not wanted]
                self._news.set()
                self._news = trio.Event()
        if scope.cancelled_caught:
            raise RequestTimeout(f"another change that concerns {paths[0]!r} took too long")

    async def _wait(self, wanted: tuple[bytes, ...]) -> bool:
        """Wait until none that came before is in the way; return whether any was."""
        waited = False
        while any(_concern(held, wanted) for held in self._before(wanted)):
            waited = True
            await self._news.wait()
        return waited

    def _before(self, wanted: tuple[bytes, ...]) -> list[tuple[bytes, ...]]:
        places = [place for place, held in enumerate(self._held) if held is wanted]
        return self._held[: places[0]]


def _concern(some: tuple[bytes, ...], others: tuple[bytes, ...]) -> bool:
    return any(
        one == other or one.startswith(other + b"/") or other.startswith(one + b"/")
        for one in some
        for other in others
    )
