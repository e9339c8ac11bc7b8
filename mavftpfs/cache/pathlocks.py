"""Which paths are being changed: the second of three locks. Layer: cache.

Tasks take the locks in this order:
1. The *file's lock*, `file.File.lock`. A writer or a delivery of a file holds it, and so does a call that
   removes, renames or empties the file (`File.preempt`).
2. The *path lock*, here. A change of names (mkdir, rmdir, unlink, rename) holds the paths concerned alone. A
   call that opens or delivers a file holds its path `shared`: beside others that share it, but not during a
   change of its name, because the call would then find neither the old file nor the new one.
3. `blocks.BlockCache.reads`, which bounds the memory of reads that wait for bytes. A delivery that holds both
   takes it to fetch the bytes of the old file that stay. A read that holds it takes its path `shared`, to
   open the file. The read waits only for a call that holds the path alone, and such a call never reads
   through the cache.
Every task may list a directory, whatever it holds, because the repair that follows a listing (`repair`) waits
for none of these locks: it leaves alone a name that somebody uses.

Two changes concern one another if they name the same path, whatever its case, or one names a directory above
the other's. All other changes go on side by side, so a change that is not answered does not delay them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import trio

from mavftpfs.cache.items import Item
from mavftpfs.shared.errors import RequestTimeout

SLACK = 5.0
"""Seconds that a change may take longer than its patience, to find out what became of it."""


class PathLocks:
    """Locks on sets of paths. A call that shares a path waits for a call that holds it alone, but not for one
    that waits to hold it: a delivery, which shares the path, has to open the file once more. All others get
    the lock in the order in which they asked."""

    def __init__(self, patience: float) -> None:
        """`patience`: seconds to wait for a lock; with the change that follows SLACK more."""
        self._patience = patience
        self._held: list[_Hold] = []
        self._news = trio.Event()

    @asynccontextmanager
    async def hold(self, *paths: bytes, shared: bool = False, lasting: bool = False) -> AsyncIterator[None]:
        """Hold the paths for the length of the body. A body that had to wait has only the rest of the time.

        shared: beside others that share them. lasting: the body bounds itself (a delivery may take minutes).

        Raises:
            RequestTimeout: others took too long.
        """
        wanted = _Hold(tuple(map(bytes.lower, paths)), shared)
        began, waited = trio.current_time(), False
        with trio.CancelScope(deadline=began + self._patience) as scope:
            self._held.append(wanted)
            try:
                while self._is_blocked(wanted):
                    waited = True
                    await self._news.wait()
                wanted.granted = True
                bounded = waited and not lasting
                scope.deadline = began + self._patience + SLACK if bounded else float("inf")
                yield
            finally:
                self._held.remove(wanted)
                self._news.set()
                self._news = trio.Event()
        if scope.cancelled_caught:
            raise RequestTimeout(f"another change that concerns {paths[0]!r} took too long")

    @asynccontextmanager
    async def steady(self, file: Item, *, lasting: bool = False) -> AsyncIterator[bytes]:
        """Keep the path of a file, and those above it, unchanged for a body that opens or delivers the file.

        Yields the path, which may have changed before the body begins. lasting: see hold.

        Raises:
            RequestTimeout: a change took too long.
        """
        while True:
            known = file.path
            async with self.hold(known, shared=True, lasting=lasting):
                if file.path == known:
                    yield known
                    return

    def is_free(self, path: bytes) -> bool:
        """Return whether nobody holds a path, or waits for it: `hold` would not wait."""
        return not self._is_blocked(_Hold((path.lower(),), shared=False))

    def _is_blocked(self, wanted: _Hold) -> bool:
        """Return whether a call that has a lock, or asked for one before, is in the way."""
        came_before = True
        for held in self._held:
            if held is wanted:
                came_before = False
            if held is wanted or not (held.granted or came_before):
                continue
            if wanted.shared and (held.shared or not held.granted):
                continue
            for one in held.paths:
                for two in wanted.paths:
                    if one == two or one.startswith(two + b"/") or two.startswith(one + b"/"):
                        return True
        return False


@dataclass(slots=True, eq=False)
class _Hold:
    paths: tuple[bytes, ...]
    shared: bool
    granted: bool = False
