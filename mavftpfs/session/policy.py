"""Decisions of the session layer as pure functions of what was measured. Layer: session; pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from mavftpfs.shared.traits import WriteTraits

ReadMode = Literal["window", "burst"]

LIGHT_USE = 0.3
"""Seconds of service in the recent past below which a file counts as an interactive one."""

USE_MEMORY = 10.0
"""Seconds after which a file's service no longer counts."""

MIN_QUANTUM = 1.0
"""Seconds a bulk reader keeps the server's session while another bulk reader waits."""

MAX_QUANTUM = 4.0

STARVING = 3.0
"""Seconds of waiting after which a bulk reader is not passed over any more."""

STARVING_TRIPS = 20.0
"""The same in round trips, for an upload: opening its file again takes up to four."""

RELIEF = 0.5
"""Seconds of service that ends starving."""


class Queue(Protocol):
    """The others who want the session, as whoever has it sees them."""

    write_traits: WriteTraits

    def rival_use(self, user: object) -> float | None:
        """Return how much the lightest of those who wait used of the session lately; None if nobody waits."""
        ...

    def expire_waiters(self) -> None:
        """Fail those who have waited too long."""
        ...

    def require_link(self) -> None:
        """Raise VehicleLost while the vehicle is silent."""
        ...


def quantum(rtt: float | None) -> float:
    """Return the seconds two bulk readers alternate by: changing files costs two round trips."""
    return min(MAX_QUANTUM, max(MIN_QUANTUM, 10.0 * (rtt or 0.0)))


@dataclass(slots=True)
class Service:
    """How much of the session a file had lately: seconds of service."""

    seconds: float = 0.0
    until: float = 0.0

    def add(self, seconds: float, now: float) -> None:
        """Count service that ended now."""
        self.seconds = self.recent(now) + seconds
        self.until = now

    def recent(self, now: float) -> float:
        """Return the service that still counts; it fades linearly within USE_MEMORY."""
        faded = min(1.0, max(0.0, 1.0 - (now - self.until) / USE_MEMORY))
        return self.seconds * faded


def is_starving(waited: float, rtt: float | None = None) -> bool:
    """Return whether who waited so long (seconds) goes before newcomers: one small file after another must
    slow a copy down, not stop it. rtt: where that depends on it, for an upload."""
    return waited >= max(STARVING, STARVING_TRIPS * (rtt or 0.0))


def should_switch(
    *,
    current_has_demand: bool,
    current_slice: float,
    current_use: float,
    waiting_use: float,
    rtt: float | None,
    current_waited: float = 0.0,
) -> bool:
    """Return whether the session should pass to a file that waits with demand.

    A file that used little lately (an editor, `head`) goes before one that used much, at once; equals
    alternate by quantum. Who had to wait long (current_waited) keeps what it got for a while.
    """
    if not current_has_demand:
        return True
    if is_starving(current_waited) and current_slice < RELIEF:
        return False
    if waiting_use < LIGHT_USE and max(current_use, current_slice) >= LIGHT_USE:
        return True
    return current_slice >= quantum(rtt)
