"""Modification times that no server can be told. Layer: cache; pure.

What a user set (utimens) is shown until the file changes: until a listing shows another size or another
mtime than the first one that was seen with it.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

MAX_TIMES = 100_000
SECOND = 1_000_000_000


@dataclass(slots=True)
class _Time:
    nanoseconds: int
    size: int | None = None  # None: not seen in a listing yet
    listed: int | None = None


class Times:
    """mtimes by path, the least recently set forgotten first."""

    def __init__(self) -> None:
        self._times: OrderedDict[bytes, _Time] = OrderedDict()

    def set(self, path: bytes, nanoseconds: int) -> None:
        """Show this mtime from now on."""
        self._times.pop(path, None)
        self._times[path] = _Time(nanoseconds)
        if len(self._times) > MAX_TIMES:
            self._times.popitem(last=False)

    def peek(self, path: bytes) -> int | None:
        """Return what was set, in nanoseconds; for a file of which more is known than any listing tells."""
        known = self._times.get(path)
        return None if known is None else known.nanoseconds

    def get(self, path: bytes, size: int, listed: int | None) -> int | None:
        """Return what was set, in nanoseconds, if a listing that says this still shows the same file."""
        known = self._times.get(path)
        if known is None:
            return None
        if known.size is None:
            known.size = size
        if known.listed is None:  # our own writing left it unknown until the next listing
            known.listed = listed
        if (known.size, known.listed) != (size, listed if listed is not None else known.listed):
            del self._times[path]
            return None
        return known.nanoseconds

    def forget(self, path: bytes) -> None:
        """The file changed, or is gone."""
        self._times.pop(path, None)

    def rename(self, old: bytes, new: bytes) -> None:
        """A file or directory with all below it has another path."""
        self._times.pop(new, None)
        for path in [p for p in self._times if p == old or p.startswith(old + b"/")]:
            self._times[new + path[len(old) :]] = self._times.pop(path)


def shown(nanoseconds: int) -> tuple[int, int]:
    """Return (seconds, nanoseconds within the second)."""
    return divmod(nanoseconds, SECOND)
