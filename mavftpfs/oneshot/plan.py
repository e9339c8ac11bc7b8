"""What to fetch, skip, resume and prove. Layer: top; pure functions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal

Verify = Literal["auto", "all", "none"]

PROVEN_BY_DEFAULT = 16_000_000
"""Bytes up to which a file is proven that came in one piece. A vehicle computes about a megabyte of checksum
a second, and most answer nobody meanwhile."""

LEAST_READ, LARGEST_READ = 2048, 128 * 1024
"""Bytes of one read."""
QUICK, SLOW = 0.25, 1.0
"""Seconds after which reads become larger, or smaller."""

CLOCK_SET = 946_684_800
"""2000-01-01 UTC: an earlier time is that of a clock that nobody set."""


@dataclass(frozen=True, slots=True)
class Log:
    """A file on the vehicle. below: its path below the log directory; mtime: seconds UTC, None if unknown."""

    path: bytes
    below: bytes
    size: int
    mtime: int | None


class Step(Enum):
    """What to do about one file."""

    SKIP = "it is here"
    FETCH = "from the start"
    RESUME = "go on with the .part"
    EXTEND = "the file here may be the beginning"


def known_time(mtime: int) -> int | None:
    """Return a listed time, None where it tells nothing."""
    return mtime if mtime >= CLOCK_SET else None


def decide(size: int, here: int | None, part: int | None) -> Step:
    """Say what to do about a file of `size` bytes on the vehicle.

    here: size of the local file of that name; part: of the .part beside it; None where there is none.
    """
    if here == size:
        return Step.SKIP
    if part is not None and 0 < part <= size:
        return Step.RESUME
    if here is not None and 0 < here < size:
        return Step.EXTEND
    return Step.FETCH


def proof_needed(verify: Verify, *, resumed: bool, size: int) -> bool:
    """Return whether the vehicle is asked for a checksum of the whole file."""
    if resumed or verify == "all":
        return True
    return verify == "auto" and size <= PROVEN_BY_DEFAULT


def next_read_size(size: int, took: float) -> int:
    """Return how much to read next, after `size` bytes took so many seconds.

    What was read is safe in the .part, and counts on the screen: on a radio that is to be every second or so.
    """
    if took < QUICK:
        return min(size * 2, LARGEST_READ)
    return max(size // 2, LEAST_READ) if took > SLOW else size


def newest_first(logs: Iterable[Log]) -> list[Log]:
    """Order logs: by time, then by their numbers; those without a time come last."""
    return sorted(logs, key=lambda log: (log.mtime or 0, natural(log.below)), reverse=True)


def select(logs: Sequence[Log], *, newest: int | None, since: float | None) -> list[Log]:
    """Return the newest N, of those that are not older than `since` (seconds UTC).

    A log without a time is not left out by `since`: it may be a new one.
    """
    young = [log for log in logs if since is None or log.mtime is None or log.mtime >= since]
    return young if newest is None else young[:newest]


def natural(name: bytes) -> tuple[tuple[int, int, bytes], ...]:
    """Return a key by which `log10` comes after `log9`."""
    parts = re.split(rb"(\d+)", name)
    return tuple((1, int(part), b"") if part.isdigit() else (0, 0, part) for part in parts)
