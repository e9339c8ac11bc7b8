"""How long a name that was changed is not changed again: late duplicates. Layer: session; pure.

A duplicate of a request that is executed late does to the name's next file what was meant for the last one: a
REMOVE removes it, a RENAME takes it away, a CreateFile empties it. Some links deliver a request twice, and
what this session repeats is on its way twice.
"""

from __future__ import annotations

from math import inf

LASTS = 600.0
"""Seconds for which replies stay suspect, and for which a duplicate that came late counts: a second radio or
another client stays for a while."""

MOST = 10.0
"""Seconds for which a name is in quarantine at most."""

LEAST_IF_REPEATED = 1.0
"""Seconds for which a name is in quarantine at least after a request that was repeated. The first
transmission may be held up in a buffer for longer than the repetition's answer took."""

UNKNOWN_LATENESS = 0.5
"""Seconds by which a duplicate counts as late if its request is not remembered any more."""


class Quarantine:
    """Tells for how long a name is not to be changed again. All times are of the session's clock.

    One number is measured: the largest lateness of the last ten minutes, from the first transmission of a
    request to the answer of a duplicate of it. While there is one, each name that was changed or made is in
    quarantine for twice that long. So that is at least two round trips. If this session repeated the request,
    or got no answer, it is twice the time that the answer took, or did not come, and a second at least, on
    any link.

    Names that differ by case alone count as one, as on many cards.
    """

    def __init__(self) -> None:
        self._lateness = 0.0
        self._seen_at = -inf
        # By name, the oldest in front: when it was changed, and how long the answer took if it was repeated.
        self._changed: dict[bytes, tuple[float, float]] = {}

    def saw(self, lateness: float | None, now: float) -> None:
        """Note a duplicate that was answered so many seconds after its request first went out (None: not
        known)."""
        largest = self._lateness if self._is_fresh(now) else 0.0
        self._lateness = max(largest, UNKNOWN_LATENESS if lateness is None else lateness)
        self._seen_at = now

    def on_changed(self, path: bytes, now: float, took: float = 0.0) -> None:
        """Note a request that made, emptied or took away the file of this name, or may have done so.

        took: how many seconds its answer took, or did not come, if the session repeated it; else 0.
        """
        name, took = path.lower(), min(max(took, LEAST_IF_REPEATED / 2), MOST / 2) if took else 0.0
        since, before = self._changed.pop(name, (now, 0.0))
        self._changed[name] = now, max(took, before - (now - since) / 2)  # an earlier one is not cut short
        while now - next(iter(self._changed.values()))[0] > MOST:
            del self._changed[next(iter(self._changed))]

    def left(self, path: bytes, now: float) -> float:
        """Return for how many seconds more the name is not to be changed."""
        since, took = self._changed.get(path.lower(), (-inf, 0.0))
        lateness = max(took, self._lateness if self._is_fresh(now) else 0.0)
        return max(0.0, since + min(MOST, 2 * lateness) - now)

    def _is_fresh(self, now: float) -> bool:
        return now - self._seen_at <= LASTS
