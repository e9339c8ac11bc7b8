"""Which names are being changed: changes that concern one another wait for each other. Layer: cache.

Two changes concern one another if they name the same path, in any case, or one names a directory above the
other's. All others go on side by side, so that one that is not answered holds up nobody else. Files are
opened between changes of their names, not during one: else who opened would hold neither the old file nor
the new one. Opening holds its path `shared`.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import trio

from mavftpfs.shared.errors import RequestTimeout

SLACK = 5.0
"""Seconds that a change may take longer than its patience: to look what became of it."""


class PathLocks:
    """Locks on sets of paths, given in the order in which they were asked for."""

    def __init__(self, patience: float) -> None:
        """`patience`: seconds to wait for a lock; with the change that follows SLACK more."""
        self._patience = patience
        self._held: list[_Hold] = []
        self._news = trio.Event()

    @asynccontextmanager
    async def hold(self, *paths: bytes, shared: bool = False) -> AsyncIterator[None]:
        """Hold the paths for the length of the body; one that had to wait may not last its full time.

        shared: beside others that share them.

        Raises:
            RequestTimeout: others took too long.
        """
        wanted = _Hold(tuple(path.lower() for path in paths), shared)
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

    @asynccontextmanager
    async def steady(self, path: Callable[[], bytes]) -> AsyncIterator[bytes]:
        """Open a file in the body: its path, which is yielded, and those above it keep their names.

        `path()`: what it is called by now, since it may change until that begins.

        Raises:
            RequestTimeout: a change took too long.
        """
        while True:
            known = path()
            async with self.hold(known, shared=True):
                if path() == known:
                    yield known
                    return

    async def _wait(self, wanted: _Hold) -> bool:
        """Wait until none that came before is in the way; return whether any was."""
        waited = False
        while any(held.concerns(wanted) for held in self._before(wanted)):
            waited = True
            await self._news.wait()
        return waited

    def _before(self, wanted: _Hold) -> list[_Hold]:
        places = [place for place, held in enumerate(self._held) if held is wanted]
        return self._held[: places[0]]


@dataclass(frozen=True, slots=True, eq=False)
class _Hold:
    paths: tuple[bytes, ...]
    shared: bool

    def concerns(self, other: _Hold) -> bool:
        """Return whether one has to wait for the other."""
        return not (self.shared and other.shared) and any(
            one == two or one.startswith(two + b"/") or two.startswith(one + b"/")
            for one in self.paths
            for two in other.paths
        )
