"""Late copies of requests: how long a name rests before it is changed again. Layer: session; pure."""

from __future__ import annotations

from math import inf

LASTS = 600.0
"""Seconds for which a doubt lasts: a second radio or another client stays for a while."""

MOST_REST = 10.0
"""Seconds for which a name rests between two changes at most, where copies of requests come late."""

LEAST_REST = 1.0
"""Seconds for which a name rests at least after a request that may still be on its way."""

UNKNOWN_LATENESS = 0.5
"""Seconds by which a copy counts as late if its request is not remembered any more."""


class LateCopies:
    """Tells how long a name is to rest before it is changed again. All times are of the session's clock.

    The copy of a request, carried out late, does to the name's next file what was meant for the last one: a
    REMOVE removes it, a RENAME takes it away, a CreateFile empties it. So a name that was changed or made
    rests for twice the largest lateness that was seen in the last ten minutes. An answer's lateness counts
    from the time when its request first went out, so this is never less than two round trips.

    If this session repeated a request, two copies were on the way, and the other one may come late on any
    link. The only copy may come late, too, if its caller was cancelled. After that the name rests for twice
    the time that the answer took, and for a second at least, because a cancelled caller waited for no answer.

    Names that differ by case alone count as one, as on many cards.
    """

    def __init__(self) -> None:
        self._lateness = 0.0
        self._seen_at = -inf
        # By name, the oldest in front: when a request last concerned it; until when it rests on any link.
        self._names: dict[bytes, tuple[float, float]] = {}

    def saw(self, lateness: float | None, now: float) -> None:
        """Note a copy that was answered so many seconds after its request first went out (None: unknown)."""
        largest = self._lateness if self._is_fresh(now) else 0.0
        self._lateness = max(largest, UNKNOWN_LATENESS if lateness is None else lateness)
        self._seen_at = now

    def on_changed(self, path: bytes, now: float) -> None:
        """Note a request that made, emptied or took away the file of this name, or may have done so."""
        self._note(path.lower(), now, now)

    def on_maybe_under_way(self, path: bytes, seconds: float, now: float) -> None:
        """Note a request that made, emptied or took away the file of this name and may come once more.

        The session sent it several times, and it was answered so many seconds after the first time; or the
        session stopped waiting for its answer.
        """
        self._note(path.lower(), now, now + max(LEAST_REST, min(MOST_REST, 2 * seconds)))

    def on_placed(self, path: bytes) -> None:
        """Let the name be changed at once: it got its file by a rename, and a copy of that finds nothing to
        rename. (An old NuttX removes the file then: docs/servers.md 9.)"""
        self._names.pop(path.lower(), None)

    def rest(self, path: bytes, now: float) -> float:
        """Return for how many seconds more the name is not to be changed."""
        since, until = self._names.get(path.lower(), (-inf, -inf))
        if self._is_fresh(now):
            until = max(until, since + min(MOST_REST, 2 * self._lateness))
        return max(0.0, until - now)

    def _note(self, name: bytes, now: float, until: float) -> None:
        """Note a request, and forget those that are too long ago to matter."""
        _, before = self._names.pop(name, (now, now))
        self._names[name] = now, max(until, before)
        while now - next(iter(self._names.values()))[0] > MOST_REST:
            del self._names[next(iter(self._names))]

    def _is_fresh(self, now: float) -> bool:
        return now - self._seen_at <= LASTS
