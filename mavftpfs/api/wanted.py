"""The files that a program chooses, checked before anything is sent. Layer: api."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import get_args

from mavftpfs.client.compare import Verify
from mavftpfs.client.selection import Selection, parse_date
from mavftpfs.shared.errors import UsageError

Patterns = str | Iterable[str]
"""A pattern, or several."""

Since = float | str | datetime
"""Seconds since 1970 UTC, a date as `mavftpfs sync --since` takes it, or a datetime (local if it names no
zone)."""


def selection_of(
    *,
    newest: int | None = None,
    since: Since | None = None,
    include: Patterns = (),
    exclude: Patterns = (),
) -> Selection:
    """Return the selection that the arguments of a call describe.

    Raises:
        UsageError: an argument is invalid; the text names it.
    """
    if newest is not None and newest < 1:
        raise UsageError(f"newest={newest!r} is not a number of logs: give an int above 0")
    return Selection(newest, _seconds(since), _patterns(include), _patterns(exclude))


def verify_of(verify: str) -> Verify:
    """Return the way to verify files.

    Raises:
        UsageError: there is no such way.
    """
    for known in get_args(Verify):
        if verify == known:
            return known  # type: ignore[no-any-return]
    raise UsageError(f"verify={verify!r} is none of {', '.join(map(repr, get_args(Verify)))}")


def _seconds(since: Since | None) -> float | None:
    if since is None:
        return None
    if isinstance(since, str):
        return parse_date(since, datetime.now(), "since")
    return since.timestamp() if isinstance(since, datetime) else float(since)


def _patterns(given: Patterns) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)
