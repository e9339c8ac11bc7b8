"""The quarantine of a name: for how long a changed name is not changed again. Layer: session; pure.

If the server executes a late duplicate of a request, the request hits the name's next file: REMOVE removes
it, RENAME moves it away, CreateFile empties it. Some links deliver a request twice, and a request that this
session repeated is in flight twice.
"""

from __future__ import annotations

from math import inf

LASTS = 600.0
"""Seconds for which replies stay suspect, and for which a measured lateness counts, because a second radio or
another client stays for a while."""

MOST = 10.0
"""The most seconds for which a name is in quarantine."""

LEAST_IF_REPEATED = 1.0
"""Seconds for which a name is in quarantine at least after a request that was repeated, because a buffer may
hold up the first transmission for longer than the answer to the repetition took."""

UNKNOWN_LATENESS = 0.5
"""Seconds by which a duplicate counts as late if the engine has forgotten its request."""


class Quarantine:
    """Tells for how long each name stays in quarantine. All times are of the session's clock.

    | the change | seconds in quarantine, 10 at most |
    |---|---|
    | answered, sent once | none; twice the lateness, if duplicates were seen in the last ten minutes |
    | repeated, or not answered | the same, and at least 1 and twice the time that was waited |

    The lateness is the largest time, in the last ten minutes, from the first transmission of a request to the
    answer to a duplicate of it.

    Names that differ by case alone count as one, because many cards treat them so.
    """

    def __init__(self) -> None:
        self._lateness = 0.0
        self._seen_at = -inf
        # By name, the oldest first: the time of the last change, and the end of the quarantine if no
        # duplicate is seen.
        self._changed: dict[bytes, tuple[float, float]] = {}

    def saw(self, lateness: float | None, now: float) -> None:
        """Note the answer to a duplicate. lateness: seconds since its request first went out, None if that is
        not known."""
        largest = self._lateness if self._is_fresh(now) else 0.0
        self._lateness = max(largest, UNKNOWN_LATENESS if lateness is None else lateness)
        self._seen_at = now

    def on_changed(self, path: bytes, now: float, took: float = 0.0) -> None:
        """Note a request that made, emptied or removed the file of this name, or may have done so.

        took: seconds from its first transmission to its answer or time-out, if the session repeated it or
            got no answer; otherwise 0.
        """
        name = path.lower()
        until = now + min(max(2 * took, LEAST_IF_REPEATED), MOST) if took else now
        _, before = self._changed.pop(name, (now, now))
        self._changed[name] = now, max(until, before)
        while now - next(iter(self._changed.values()))[0] > MOST:
            del self._changed[next(iter(self._changed))]

    def left(self, path: bytes, now: float) -> float:
        """Return the seconds for which the name is still in quarantine."""
        changed_at, until = self._changed.get(path.lower(), (-inf, -inf))
        lateness = self._lateness if self._is_fresh(now) else 0.0
        return max(0.0, until - now, changed_at + min(MOST, 2 * lateness) - now)

    def _is_fresh(self, now: float) -> bool:
        return now - self._seen_at <= LASTS
