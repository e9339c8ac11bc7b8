"""What is shown of an entry whose listing says too little or too much. Layer: cache; pure."""

from __future__ import annotations

import calendar
import re
from dataclasses import dataclass, replace

from mavftpfs.shared.model import DirEntry, EntryKind

UNKNOWN_MTIME = 315532800
"""1980-01-01 UTC: the same in every mount, so that rsync and make do not see changes that are none."""

MAX_SIZE = 2**63 - 1
"""The largest size the kernel can be told; a listing may claim anything (promise 10)."""

MAX_MTIME = 9_000_000_000
"""Year 2255; nanoseconds since 1970 must fit 63 bits."""

_LOG_DATE = re.compile(rb"/log/(\d{4})-(\d{2})-(\d{2})(?:/(\d{2})_(\d{2})_(\d{2})[^/]*\.ulg)?")


@dataclass(frozen=True, slots=True)
class Stat:
    """What is known of one path.

    size: bytes, 0 <= size < 2**63. mtime: seconds UTC, never unknown. valid_for: seconds the kernel
    may keep these attributes; 0 means ask again. mtime_nsec: nanoseconds to add to mtime, not 0 only
    where a user set it.
    """

    kind: EntryKind
    size: int
    mtime: int
    valid_for: float
    mtime_nsec: int = 0


def tidy(entry: DirEntry) -> DirEntry:
    """Return the entry with size and mtime in the kernel's ranges; an mtime out of range is unknown."""
    size, mtime = entry.size, entry.mtime
    if size is not None and not 0 <= size <= MAX_SIZE:
        size = min(max(size, 0), MAX_SIZE)
    if mtime is not None and not 0 < mtime <= MAX_MTIME:
        mtime = None
    if (size, mtime) == (entry.size, entry.mtime):
        return entry
    return replace(entry, size=size, mtime=mtime)


def shown_mtime(path: bytes, mtime: int | None) -> int:
    """Return the mtime to show, seconds UTC.

    Where the server told none, PX4's logs carry theirs in the path (`log/2024-05-01/12_34_56.ulg`, UTC);
    everything else is UNKNOWN_MTIME (logs without a clock lie in `log/sess001/`).
    """
    if mtime is not None:
        return mtime
    match = _LOG_DATE.search(path)
    if match is None or match.end() != len(path):
        return UNKNOWN_MTIME
    return _utc(*(int(part or 0) for part in match.groups()))


def _utc(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int:
    plausible = (
        year >= 1980 and 1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second < 60
    )
    if not plausible:
        return UNKNOWN_MTIME
    return min(calendar.timegm((year, month, day, hour, minute, second)), MAX_MTIME)
