"""Whole contents of `@` files, and handles on them. Layer: cache; pure."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from mavftpfs.cache.readonly import ReadOnlyHandle
from mavftpfs.shared.errors import LocalProtocolError

MAX_SIZES = 4096
"""Of how many files the true size is remembered."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A whole `@` file. good_until: when it no longer answers stat."""

    data: bytes
    good_until: float


class Snapshots:
    """Remembered snapshots within a budget of bytes, and the true sizes of more."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._snapshots: OrderedDict[bytes, Snapshot] = OrderedDict()
        self._sizes: OrderedDict[bytes, int] = OrderedDict()
        self.bytes_cached = 0

    def get(self, path: bytes, now: float) -> Snapshot | None:
        """Return a snapshot that is good at `now`."""
        snapshot = self._snapshots.get(path)
        return snapshot if snapshot is not None and now < snapshot.good_until else None

    def size_of(self, path: bytes) -> int | None:
        """Return the size that the last snapshot had, in bytes."""
        return self._sizes.get(path)

    def put(self, path: bytes, snapshot: Snapshot) -> None:
        """Remember a snapshot; one that exceeds the budget leaves only its size."""
        self._drop(path)
        self._sizes.pop(path, None)
        self._sizes[path] = len(snapshot.data)
        if len(self._sizes) > MAX_SIZES:
            self._drop(self._sizes.popitem(last=False)[0])
        self._snapshots[path] = snapshot
        self.bytes_cached += len(snapshot.data)
        while self.bytes_cached > self._budget:
            self._drop(next(iter(self._snapshots)))

    def clear(self) -> None:
        """Forget everything."""
        self._snapshots.clear()
        self._sizes.clear()
        self.bytes_cached = 0

    def _drop(self, path: bytes) -> None:
        snapshot = self._snapshots.pop(path, None)
        if snapshot is not None:
            self.bytes_cached -= len(snapshot.data)


class SnapshotHandle(ReadOnlyHandle):
    """One open() of an `@` file (see cache.openfile.OpenFile)."""

    direct_io = True
    keep_cache = False

    def __init__(self, data: bytes, on_close: Callable[[], None]) -> None:
        self._data = memoryview(data)
        self._on_close: Callable[[], None] | None = on_close
        self.size = len(data)

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end.

        Raises:
            LocalProtocolError: the handle was closed.
        """
        if self._on_close is None:
            raise LocalProtocolError("read of a closed handle")
        return self._data[offset : offset + size]

    def close(self) -> None:
        """Release the handle."""
        if self._on_close is not None:
            self._on_close()
            self._on_close = None
