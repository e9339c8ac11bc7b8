"""Selects files of the vehicle: by pattern, by time, the newest N. Layer: client; silent."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase

from mavftpfs.client.fetch import Wanted
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.readable import readable_size

NO_LOG = b"LASTLOG.TXT"
"""The file in which ArduPilot keeps the number of its last log."""

_DATE = re.compile(rb"(?<!\d)(20\d\d)-(\d\d)-(\d\d)(?:[/_T -](\d\d)[_:.-](\d\d)[_:.-](\d\d))?(?!\d)")
_DAY_END = (23, 59, 59)

_AGO = re.compile(r"(\d{1,6})(min|h|d|w)", re.ASCII)
_UNITS = {"min": "minutes", "h": "hours", "d": "days", "w": "weeks"}


@dataclass(frozen=True, slots=True)
class Selection:
    """The files that a user wants.

    newest: the largest number of files; since: the oldest time, seconds UTC. include: a file must match one
    of these patterns if there are any; exclude: a file may match none of these.
    """

    newest: int | None = None
    since: float | None = None
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    @property
    def by_name(self) -> bool:
        """Whether patterns decide."""
        return bool(self.include or self.exclude)

    def takes(self, below: bytes) -> bool:
        """Return whether the patterns select a file; below: its path below the downloaded directory."""
        path = os.fsdecode(below)
        taken = not self.include or _matches_one(path, self.include)
        return taken and not _matches_one(path, self.exclude)

    def of_logs(self, logs: Iterable[Wanted]) -> list[Wanted]:
        """Return the logs that are new enough, the newest first.

        `since` leaves a log out only if the time of the log is known, because another one may be new.
        """
        young = [log for log in newest_first(logs) if not self._is_older(log)]
        return young if self.newest is None else young[: self.newest]

    def _is_older(self, log: Wanted) -> bool:
        when = time_of(log)
        return self.since is not None and when is not None and when < self.since

    def warning(self, logs: Sequence[Wanted]) -> str:
        """Return a line about logs that are downloaded although `since` may mean to leave them out, or ""."""
        undated = [log for log in logs if time_of(log) is None and not log.here and not is_no_log(log)]
        if self.since is None or not undated:
            return ""
        size = readable_size(sum(log.size - log.begun for log in undated))
        return (
            f"--since does not leave out {len(undated)} of {len(logs)} logs ({size}), because the vehicle "
            "reports no time for them; use --newest N to download fewer"
        )


EVERYTHING = Selection()


def _matches_one(below: str, patterns: Sequence[str]) -> bool:
    name = below.rpartition("/")[2]
    return any(fnmatchcase(below, pattern) or fnmatchcase(name, pattern) for pattern in patterns)


def is_no_log(log: Wanted) -> bool:
    """Return whether a file among the logs is something else."""
    return log.remote.endswith(NO_LOG)


def time_of(log: Wanted) -> int | None:
    """Return the time of a log, seconds UTC, from its listing or its path; None if neither has one."""
    return latest_in(log.remote) if log.mtime is None else log.mtime


def latest_in(path: bytes) -> int | None:
    """Return the time in a path, such as `2026-11-20/12_30_00.ulg` of PX4: seconds UTC, None without a date.

    A date alone counts as the end of that day.
    """
    for found in reversed(list(_DATE.finditer(path))):
        year, month, day, *clock = found.groups()
        hour, minute, second = _DAY_END if clock[0] is None else map(int, clock)
        with suppress(ValueError):
            told = datetime(int(year), int(month), int(day), hour, minute, second, tzinfo=UTC)
            return int(told.timestamp())
    return None


def newest_first(logs: Iterable[Wanted]) -> list[Wanted]:
    """Order logs by time, then by their numbers. Logs without a time follow, and files that are not logs come
    last."""

    def age(log: Wanted) -> tuple[bool, int, object]:
        return not is_no_log(log), time_of(log) or 0, natural(log.remote)

    return sorted(logs, key=age, reverse=True)


def natural(name: bytes) -> tuple[tuple[int, int, bytes], ...]:
    """Return a key that sorts `log10` behind `log9`."""
    parts = re.split(rb"(\d+)", name)
    return tuple((1, int(part), b"") if part.isdigit() else (0, 0, part) for part in parts)


def parse_date(text: str, now: datetime, name: str) -> float:
    """Return the seconds UTC of a date, or a date and time, which is local if it names no zone; of `today`,
    `yesterday`, or a time ago (`90min`, `2h`, `3d`, `1w`).

    Raises:
        UsageError: the text is not a date; name: the option or argument in the message.
    """
    midnight = datetime(now.year, now.month, now.day)
    ago = _AGO.fullmatch(text)
    try:
        if text in ("today", "yesterday"):
            return (midnight - timedelta(days=text == "yesterday")).timestamp()
        if ago is not None:
            return now.timestamp() - timedelta(**{_UNITS[ago[2]]: int(ago[1])}).total_seconds()
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        raise UsageError(
            f"{name} {text!r} is not a date; write for example 2026-05-01, 2026-05-01T14:30, today, "
            "yesterday, 2h or 3d"
        ) from None
