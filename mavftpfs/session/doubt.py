"""Doubt: when something was noticed, and when something that concerns reads. Layer: session; pure.

Servers share session ids between clients, requests name a session and no file, and some links deliver a
request twice, the second time late. Whatever shows that this happened raises the same doubt: an answer that
nothing outstanding and no repetition of ours explains, another FTP client, a session that vanished under us,
a restart of the vehicle. For ten minutes from then on the caches compare what was written.

Where copies of requests were seen to come late, names rest between two changes (`LateCopies`).
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

LASTS = 600.0
"""Seconds for which a doubt lasts: a second radio or another client stays for a while."""

LEAST_REST = 1.0
MOST_REST = 10.0
"""Seconds between two changes of a name, at least and at most, where copies of requests come late."""


class LateCopies:
    """Tells how long a name is to rest before it is changed again. All times are of the session's clock.

    The copy of a request, carried out late, does to the name's next file what was meant for the last one: a
    REMOVE removes it, a RENAME takes it away. So a name rests after such a request: for twice the largest
    lateness, and a second at least. If no copy was seen for ten minutes, it does not rest for them any more.
    But where we repeated such a request two were on the way, and the other one may come late on any link. So
    after that the name rests for twice the time that the answer took: 1 to 10 seconds.

    A file that CreateFile made rests before it is compared, too, but without that least second. A copy of
    CreateFile that comes even later empties the file, which is found when it is compared again under its
    final name. Without this rest a link that delivers all requests twice could make an empty file under the
    old name, by the copy of CreateFile, and put it under the final name, by the copy of the rename. Where
    nothing can be renamed the file has its final name at once, and rests after any CreateFile of ours that
    was repeated.

    Names that differ by case alone count as one, as on many cards.
    """

    def __init__(self) -> None:
        self._lateness = 0.0
        self._seen_at = -inf
        # By name, the oldest in front: when a request last concerned it; until when it rests at least, where
        # copies come late; until when on any link.
        self._names: dict[bytes, tuple[float, float, float]] = {}

    def saw(self, lateness: float, now: float) -> None:
        """A copy was answered so many seconds after the request was sent first (0: that is not known)."""
        largest = self._lateness if self._is_fresh(now) else 0.0
        self._lateness, self._seen_at = max(largest, lateness), now

    def on_changed(self, path: bytes, now: float) -> None:
        """A request took the file of this name away, or may have done so."""
        self._note(path.lower(), now, now + LEAST_REST, now)

    def on_maybe_under_way(self, path: bytes, seconds: float, now: float) -> None:
        """A request that may have taken the file of this name away, or emptied it, was sent more than once
        and answered so many seconds after the first time; or it was not answered, and is not waited for any
        longer."""
        self._note(path.lower(), now, now, now + max(LEAST_REST, min(MOST_REST, 2 * seconds)))

    def on_made(self, path: bytes, now: float) -> None:
        """CreateFile made, or emptied, the file of this name."""
        self._note(path.lower(), now, now, now)

    def on_placed(self, path: bytes) -> None:
        """The name got its file by a rename: a copy of that finds nothing to rename. (An old
        NuttX removes the file then: docs/servers.md 9.)"""
        self._names.pop(path.lower(), None)

    def rest(self, path: bytes, now: float) -> float:
        """Return for how many seconds more the name is not to be changed."""
        since, least, rests_until = self._names.get(path.lower(), (-inf, -inf, -inf))
        if self._is_fresh(now):
            rests_until = max(rests_until, least, since + min(MOST_REST, 2 * self._lateness))
        return max(0.0, rests_until - now)

    def _note(self, name: bytes, now: float, least: float, on_any_link: float) -> None:
        """Note a request, and forget those that are too long ago to matter."""
        _, *before = self._names.pop(name, (now, now, now))
        self._names[name] = now, max(least, before[0]), max(on_any_link, before[1])
        while now - next(iter(self._names.values()))[0] > MOST_REST:
            del self._names[next(iter(self._names))]

    def _is_fresh(self, now: float) -> bool:
        return now - self._seen_at <= LASTS


class Doubt:
    """Whether, and since when, what was ACKed is not believed without a look.

    Attributes:
        late_copies: which names rest.
    """

    def __init__(
        self, clock: Callable[[], float], on_raised: Callable[[str], None] = lambda reason: None
    ) -> None:
        """`on_raised` is called each time that what was read is in doubt, with the reason, for people."""
        self._on_raised = on_raised
        self.late_copies = LateCopies()
        self._clock = clock
        self._at = self._reads_at = -inf

    def raise_it(self, reason: str, *, reads: bool = True) -> None:
        """Something was noticed now; reads: what was read lately may be another file's, too."""
        self._at = self._clock()
        if reads:
            self._reads_at = self._at
            self._on_raised(reason)

    def is_active(self, since: float = inf) -> bool:
        """Return whether something was noticed in the last ten minutes, or after that time."""
        return self._clock() - self._at <= LASTS or self._at > since

    def reads_arose_since(self, at: float) -> bool:
        """Return whether what was read then may be another file's."""
        return self._reads_at >= at
