"""The policy of the watch: when to download the logs of a vehicle. Layer: client; pure.

A flight ends when the vehicle is disarmed. Then the watch lists the logs, and downloads each that has not
grown for QUIET. If a log still grows PATIENCE after the end of the flight, the watch downloads it up to its
present size, and looks at it again with growing pauses. While the vehicle is armed, is lost, or just refused
to be armed, the watch asks it for nothing. All times are of one clock, in seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf
from typing import NamedTuple

QUIET = 10.0
"""Seconds without growth after which a log counts as whole."""
PATIENCE = 60.0
"""Seconds after the end of a flight in which a log may grow. ArduPilot logs for 15 s more."""
REFUSED = 60.0
"""Seconds without a transfer after a vehicle refused to arm: the load of a transfer may be the reason (MAVSDK
issue 1636)."""
LOST = 10.0
"""Seconds without a heartbeat after which a vehicle is lost."""
RETRY, MOST_RETRY = 30.0, 600.0
"""Seconds until the watch lists the logs again after a failure: the first time, and at most."""
GROWN, MOST_GROWN = 60.0, 3600.0
"""The least and most seconds until the watch looks again at a log that keeps growing; between them, as long
as the flight is over."""


class Log(NamedTuple):
    """A missing log: its path, and its size as listed."""

    path: bytes
    size: int


class _Sighting(NamedTuple):
    """A listed log. since: the time when its size was listed first."""

    size: int
    since: float


class Policy:
    """Decides for one vehicle.

    The watch calls `begin`, `choose` with the new logs that it listed, and `synced`. If a sync is cancelled
    before that, it stays due.

    Attributes:
        uid: the vehicle's unique id, None while unknown. unchanged: logs without a time whose first bytes
            need not be compared again.
    """

    def __init__(self) -> None:
        self.uid: str | None = None
        self.unchanged: set[str] = set()
        self._armed: bool | None = None
        self._heard_at = -inf
        self._lost = False
        self._ended_at = -inf
        self._sync_at = self._next_at = inf
        self._paused_until = -inf
        self._failures = 0
        self._seen: dict[bytes, _Sighting] = {}
        self._growing: set[bytes] = set()

    # --- what the watch hears

    def heard(self, armed: bool, now: float) -> str:
        """Take a heartbeat; return the news: "here", "back", "armed", "disarmed", or ""."""
        before, was_lost = self._armed, self._lost
        self._armed, self._heard_at, self._lost = armed, now, False
        if before is armed and not was_lost:
            return ""
        if before is None or was_lost:
            self.unchanged.clear()
        if not armed:
            self._flight_ended(now)
        if was_lost:
            return "back"
        return "here" if before is None else "armed" if armed else "disarmed"

    def restarted(self, now: float) -> None:
        """Note a restart: the vehicle may have other logs, and has closed those that grew."""
        self.unchanged.clear()
        self._flight_ended(now)

    def refused(self, now: float) -> None:
        """Note that the vehicle refused to arm."""
        self._paused_until = now + REFUSED

    def newly_lost(self, now: float) -> bool:
        """Return whether the vehicle was lost since the last call."""
        if self._lost or now - self._heard_at <= LOST:
            return False
        self._lost = True
        return True

    # --- what the watch does

    @property
    def state(self) -> str:
        """The state of the vehicle, in a word."""
        return "lost" if self._lost else "armed" if self._armed else "disarmed"

    def may_transfer(self, now: float) -> bool:
        """Return whether the watch may send requests to the vehicle; if not, the watch cancels a sync."""
        return not self._lost and self._armed is False and now >= self._paused_until

    def due(self, now: float) -> bool:
        """Return whether a sync of the logs is due."""
        return self.may_transfer(now) and self._sync_at <= now

    def begin(self) -> None:
        """Note that a sync begins: later events decide when the next one is due."""
        self._next_at = inf

    def choose(self, logs: Iterable[Log], now: float) -> dict[bytes, bool]:
        """Take the listed logs that are not here; return those to download now, each with whether it still
        grows."""
        before, self._seen = self._seen, {}
        chosen = {}
        for log in logs:
            seen = before.get(log.path)
            if seen is None or seen.size != log.size:
                seen = _Sighting(log.size, now)
            self._seen[log.path] = seen
            quiet = now - seen.since >= QUIET
            impatient = now - self._ended_at >= PATIENCE and log.path not in self._growing
            if quiet or impatient:
                chosen[log.path] = not quiet
            if not quiet:
                if impatient:
                    self._growing.add(log.path)
                self._look_again(log.path, now)
        self._growing &= self._seen.keys()
        return chosen

    def grew(self, path: bytes, now: float) -> None:
        """Note that a log was incomplete when it was downloaded."""
        self._seen[path] = _Sighting(-1, now)
        self._look_again(path, now)

    def failed(self, now: float) -> None:
        """Note that the logs could not be listed, or one could not be downloaded."""
        self._next_at = min(self._next_at, now + min(RETRY * 2**self._failures, MOST_RETRY))
        self._failures = min(self._failures + 1, 10)

    def local_trouble(self, now: float) -> None:
        """Note that the local disk refuses data now."""
        self._next_at = min(self._next_at, now + RETRY)

    def arrived(self) -> None:
        """Note that a log was downloaded."""
        self._failures = 0

    def synced(self) -> None:
        """Note that a sync came to its end, with or without failures."""
        self._sync_at = self._next_at

    # --- inside

    def _flight_ended(self, now: float) -> None:
        """Count all logs as new from now on."""
        self._ended_at = self._sync_at = self._next_at = now
        self._failures = 0
        self._seen.clear()
        self._growing.clear()

    def _look_again(self, path: bytes, now: float) -> None:
        """Plan a listing for the time when this log may have stopped growing."""
        if path in self._growing:
            again = now + min(max(now - self._ended_at, GROWN), MOST_GROWN)
        else:
            again = self._seen[path].since + QUIET
        self._next_at = min(self._next_at, again)
