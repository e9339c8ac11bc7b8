"""The vehicle's checksums of files, asked once. Layer: cache."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from mavftpfs.cache.directories import Found
from mavftpfs.cache.flights import Flights
from mavftpfs.cache.remote import RemoteStore

MAX_CHECKSUMS = 1024


@dataclass(frozen=True, slots=True)
class _Checksum:
    size: int
    mtime: int | None
    value: int
    asked_at: float


class Checksums:
    """CRC32s by path, each good for the size and mtime it was asked at."""

    def __init__(self, store: RemoteStore, *, clock: Callable[[], float], lifetime: float) -> None:
        """`lifetime`: seconds that a checksum holds where no mtime tells more."""
        self._store = store
        self._clock = clock
        self._lifetime = lifetime
        self._known: OrderedDict[bytes, _Checksum] = OrderedDict()
        self._asking: Flights[bytes, int] = Flights()

    async def get(self, path: bytes, found: Found) -> int:
        """Return a listed file's checksum.

        Raises:
            As RemoteStore.crc32.
        """
        known = self._known.get(path)
        if known is not None and self._still_holds(known, found):
            return known.value
        return await self._asking.run(path, partial(self._ask, path, found))

    def forget_below(self, path: bytes) -> None:
        """The path, or what lies below it, changed."""
        for known in [p for p in self._known if p == path or p.startswith(path + b"/")]:
            del self._known[known]

    def clear(self) -> None:
        """Nothing known holds any more."""
        self._known.clear()

    def _still_holds(self, known: _Checksum, found: Found) -> bool:
        if known.size != found.size:
            return False
        if known.mtime is not None and known.mtime == found.entry.mtime:
            return True
        same = known.mtime == found.entry.mtime
        return same and self._clock() - known.asked_at < self._lifetime

    async def _ask(self, path: bytes, found: Found) -> int:
        value = await self._store.crc32(path, size=found.size)
        if found.size is not None:
            self._known.pop(path, None)
            self._known[path] = _Checksum(found.size, found.entry.mtime, value, self._clock())
        if len(self._known) > MAX_CHECKSUMS:
            self._known.popitem(last=False)
        return value
