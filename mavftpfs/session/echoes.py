"""Names that a request may change again, when the network delivers it late once more. Layer: session.

Requests that carry names are carried out whenever they come: one that was held back for longer than a round
trip, and repeated meanwhile, moves, removes, makes, empties or cuts whatever has the name by then (servers
replay the last answer only, MAVSDK none; servers.md 4). So a name that was taken away is not given to
something new, one that was given, or opened to be written, is not taken away, and a file that was cut or
emptied is not changed, before such a request is dead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import trio

from mavftpfs.protocol.engine import Engine

QUIET = (0.25, 1.0)
QUIET_ROUND_TRIPS = 4.0
"""Seconds for which a second execution is feared (at least, at most, round trips), or, where copies were seen
to come later than that, ..."""

MARGIN = 1.25
"""... so many times as long as the latest took."""


def feared_for(engine: Engine, now: float) -> float:
    """Return for how many seconds a copy of a request may yet come, on a path that makes copies."""
    least, most = QUIET
    quiet = min(most, max(least, QUIET_ROUND_TRIPS * (engine.rtt or 0.0)))
    return max(quiet, MARGIN * engine.stats.lateness.seen(now))


class Echoes:
    """What was changed lately. Names that differ by case alone count as one, as on many cards."""

    def __init__(self, engine: Engine, clock: Callable[[], float]) -> None:
        self._engine = engine
        self._clock = clock
        self._until: dict[bytes, float] = {}
        self._opened: dict[bytes, float] = {}

    @contextmanager
    def noted(self, path: bytes, *, opens: bool = False) -> Iterator[None]:
        """The body sends a request that changes what has a name; a second execution of it may follow,
        whatever became of the first. opens: OpenFileWO, which only brings back what was taken away."""
        before = self._engine.stats.retransmissions
        try:
            yield
        finally:
            repeated = self._engine.stats.retransmissions > before  # ours or another's: better too often
            self._note(self._opened if opens else self._until, path, repeated=repeated)

    def _note(self, times: dict[bytes, float], path: bytes, *, repeated: bool) -> None:
        now = self._clock()
        for name in [name for name, until in times.items() if until <= now]:
            del times[name]
        if repeated or self._engine.stats.strays:
            times[path.lower()] = now + feared_for(self._engine, now)

    async def let_pass(self, path: bytes, *, taken: bool = False) -> None:
        """Wait until no such request changes what has the name any more; taken: it is about to be free."""
        until = self._until.get(path.lower(), 0.0)
        if taken:
            until = max(until, self._opened.get(path.lower(), 0.0))
        rest = until - self._clock()
        if rest > 0.0:
            await trio.sleep(rest)
