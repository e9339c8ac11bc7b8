"""The attributes of an entry whose listing says too little or too much. Layer: cache; pure.

That includes mtimes that users set, because no server can be told one. Such an mtime is shown until the file
changes: until a listing shows another size or mtime than the first listing after it was set.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from mavftpfs.shared.model import DirEntry, EntryKind

UNKNOWN_MTIME = 315532800
"""1980-01-01 UTC: the same in every mount, so that rsync and make do not see changes that are none."""

MAX_SIZE = 2**63 - 1
"""The largest size the kernel can be told; a listing may claim anything (promise 10)."""

MAX_MTIME = 9_000_000_000
"""Year 2255; nanoseconds since 1970 must fit 63 bits."""

SECOND = 1_000_000_000
"""Nanoseconds."""

_LOG_DATE = re.compile(rb"/log/(\d{4})-(\d{2})-(\d{2})(?:/(\d{2})_(\d{2})_(\d{2})[^/]*\.ulg)?\Z")


@dataclass(frozen=True, slots=True)
class Stat:
    """The attributes of one path, as far as they are known.

    size: bytes, 0 <= size < 2**63. mtime_ns: nanoseconds since 1970 UTC, never unknown. valid_for: seconds
    the kernel may keep these attributes; 0 means ask again.
    """

    kind: EntryKind
    size: int
    mtime_ns: int
    valid_for: float

    @property
    def mtime(self) -> int:
        """Seconds since 1970 UTC."""
        return self.mtime_ns // SECOND


def tidy(entry: DirEntry) -> DirEntry:
    """Return the entry with size and mtime in the kernel's ranges; an mtime out of range is unknown."""
    size, mtime = min(entry.size, MAX_SIZE), entry.mtime
    if mtime is not None and not 0 < mtime <= MAX_MTIME:
        mtime = None
    if (size, mtime) == (entry.size, entry.mtime):
        return entry
    return replace(entry, size=size, mtime=mtime)


def shown_mtime(path: bytes, mtime: int | None) -> int:
    """Return the mtime to show, in nanoseconds since 1970 UTC; mtime: in seconds, as the server told it.

    Where it told none, PX4's logs carry theirs in the path (`log/2024-05-01/12_34_56.ulg`, UTC); everything
    else is UNKNOWN_MTIME (logs without a clock lie in `log/sess001/`).
    """
    match = _LOG_DATE.search(path) if mtime is None else None
    if match is not None:
        year, month, day, hour, minute, second = [int(part or 0) for part in match.groups()]
        with suppress(ValueError):
            told = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
            mtime = min(max(told, UNKNOWN_MTIME), MAX_MTIME)
    return (UNKNOWN_MTIME if mtime is None else mtime) * SECOND


@dataclass(slots=True)
class _Time:
    nanoseconds: int
    size: int | None = None  # None: not seen in a listing yet
    listed: int | None = None


class Times:
    """mtimes that users set in one folder, by name."""

    def __init__(self) -> None:
        self._times: dict[bytes, _Time] = {}

    def __len__(self) -> int:
        return len(self._times)

    def set(self, name: bytes, nanoseconds: int) -> None:
        """Show this mtime from now on."""
        self._times[name] = _Time(nanoseconds)

    def peek(self, name: bytes) -> int | None:
        """Return the mtime that was set, in nanoseconds, whatever a listing says; for a file with pending
        changes."""
        known = self._times.get(name)
        return None if known is None else known.nanoseconds

    def get(self, name: bytes, size: int, listed: int | None) -> int | None:
        """Return the mtime that was set, in nanoseconds, if the listed size and mtime still show the same
        file."""
        known = self._times.get(name)
        if known is None:
            return None
        if known.size is None:
            known.size = size
        if known.listed is None:  # this mount's writing left it unknown until the next listing
            known.listed = listed
        if (known.size, known.listed) != (size, listed if listed is not None else known.listed):
            del self._times[name]
            return None
        return known.nanoseconds

    def forget(self, name: bytes) -> None:
        """The file changed, or is gone."""
        self._times.pop(name, None)

    def move(self, name: bytes, target: Times, new: bytes) -> None:
        """A file or directory has another name, perhaps in another folder."""
        known = self._times.pop(name, None)
        target.forget(new)
        if known is not None:
            target._times[new] = known
