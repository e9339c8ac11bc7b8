"""The options as the caches see them. Layer: cache; pure."""

from __future__ import annotations

from dataclasses import dataclass, fields

from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import normalise
from mavftpfs.shared.options import Options

KIB = 1024
MIB = 1024 * KIB

MIN_CACHE_SIZE = MIB
"""Below this, a few of the kernel's read requests would not fit beside each other."""

DIR_TIMEOUT = 20.0
"""Seconds that a listing is fresh if the user did not set it."""

ATTRIBUTES_HOLD, ABSENCE_HOLDS = 1.0, 2.0
"""Seconds that the kernel may keep attributes, and an absent name; less if `dir_timeout` is shorter."""


@dataclass(frozen=True, slots=True)
class CacheOptions(Options):
    """The options, and the limits of the caches. Times in seconds, sizes in bytes.

    max_entries: directory entries remembered over all listings.
    at_file_limit: largest `@` file that is read; at_cache_size: how much of such snapshots is kept.
    at_stat_limit: an `@SYS` file listed as larger than this is not read to answer a stat.
    probe_time: how long listing an `@` directory may spend on finding out which entries open.
    link_rate: bytes per second that the link carries at most, where that is known before anything is
    measured. local_max: bytes that files of `localfiles` may take.

    Raises:
        UsageError: a value is out of range.
    """

    max_entries: int = 100_000
    at_file_limit: int = 4 * MIB
    at_cache_size: int = 4 * MIB
    at_stat_limit: int = 128 * KIB
    probe_time: float = 3.0
    link_rate: float | None = None
    local_max: int = 16 * MIB

    @property
    def write_armed(self) -> bool:
        """Whether things are changed in flight, too."""
        return self.when_armed == "ok"

    @property
    def proof_time(self) -> float:
        """Seconds for which the vehicle's facts about a file are valid."""
        return DIR_TIMEOUT if self.dir_timeout is None else self.dir_timeout

    @property
    def attributes_hold(self) -> float:
        """Seconds for which the kernel may keep attributes."""
        return min(ATTRIBUTES_HOLD, self.proof_time)

    @property
    def absence_holds(self) -> float:
        """Seconds for which the kernel may keep an absent name."""
        return min(ABSENCE_HOLDS, self.proof_time)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not value >= 0:
                raise UsageError(f"{field.name} may not be negative")
        if self.cache_size < MIN_CACHE_SIZE:
            raise UsageError(f"cache_size may not be less than {MIN_CACHE_SIZE} bytes")
        if normalise(self.root) != self.root:
            raise UsageError(f"root {self.root!r} is not a plain absolute path")
