"""Names that a request may take away again, when the network delivers it late once more. Layer: session.

RENAME, REMOVE and REMOVE DIRECTORY carry names, and servers carry out what they get: a request that was held
back for longer than a round trip, and repeated meanwhile, moves or removes whatever has the name by then
(servers replay the last answer only, MAVSDK none; servers.md 4). So a name that was taken away is not given
to something new before such a request is dead.
"""

from __future__ import annotations

from collections.abc import Callable

import trio

from mavftpfs.protocol.engine import Engine

QUIET = (0.25, 1.0)
QUIET_ROUND_TRIPS = 4.0
"""Seconds for which a second execution is feared (at least, at most, round trips)."""


class Echoes:
    """What was taken away lately. Names that differ by case alone count as one, as on many cards."""

    def __init__(self, engine: Engine, clock: Callable[[], float]) -> None:
        self._engine = engine
        self._clock = clock
        self._until: dict[bytes, float] = {}

    def took(self, path: bytes, *, repeated: bool) -> None:
        """A request that takes a name away was answered or given up; repeated: it was sent more than once."""
        now = self._clock()
        self._until = {name: until for name, until in self._until.items() if until > now}
        if repeated or self._engine.stats.strays:
            least, most = QUIET
            quiet = min(most, max(least, QUIET_ROUND_TRIPS * (self._engine.rtt or 0.0)))
            self._until[path.lower()] = now + quiet

    async def let_pass(self, path: bytes) -> None:
        """Wait until nothing takes the name away any more, one second at most; call before it is given."""
        rest = self._until.get(path.lower(), 0.0) - self._clock()
        if rest > 0.0:
            await trio.sleep(rest)
