"""Who goes first when several want the server's session. Layer: session; pure.

Whoever used little of it lately (an editor, `head`) goes before whoever used much (a copy), at once. Those
who used much take turns of a second or more, since changing files costs round trips. Whoever waited for long
goes first all the same: one small file after another slows a copy down, and does not stop it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from mavftpfs.shared.traits import WriteTraits

ReadMode = Literal["window", "burst"]

LIGHT_USE = 0.3
"""Seconds of use in the recent past below which a user counts as a light one."""

USE_MEMORY = 10.0
"""Seconds after which use no longer counts."""

MIN_TURN, MAX_TURN = 1.0, 4.0
TURN_TRIPS = 10.0
"""Seconds, and round trips, for which a heavy user keeps the session while another one waits."""

LONG_WAIT = 3.0
LONG_WAIT_TRIPS = 20.0
"""Seconds, and round trips, of waiting after which a heavy user is not passed over any more. Opening the file
of an upload again takes up to four round trips."""

RELIEF = 0.5
"""Seconds that whoever waited so long keeps what he got."""


@dataclass(slots=True)
class Share:
    """How much of the session one user had lately, and since when it waits.

    asked_at: when it began to wait for its turn; None while it wants nothing. It stays set during the turn.
    """

    asked_at: float | None = None
    _used: float = 0.0
    _until: float = 0.0

    def ask(self, now: float) -> None:
        """It wants a turn; it keeps its place if it waits already."""
        if self.asked_at is None:
            self.asked_at = now

    def on_turn(self, began: float, now: float) -> None:
        """It had the session until now."""
        self._used = self.used(began) + now - began
        self._until = now

    def used(self, now: float) -> float:
        """Return the seconds of use that still count: they fade, but not while it waits."""
        until = now if self.asked_at is None else min(now, self.asked_at)
        return self._used * min(1.0, max(0.0, 1.0 - (until - self._until) / USE_MEMORY))

    def waited_long(self, now: float, rtt: float | None) -> bool:
        """Return whether it is not to be passed over any more."""
        limit = max(LONG_WAIT, LONG_WAIT_TRIPS * (rtt or 0.0))
        return self.asked_at is not None and now - self.asked_at >= limit

    def rank(self, now: float, rtt: float | None) -> tuple[bool, float]:
        """Return what orders those who wait: the least goes first."""
        heavy = self.used(now) >= LIGHT_USE and not self.waited_long(now, rtt)
        return heavy, now if self.asked_at is None else self.asked_at

    def gives_way(self, rival: float, began: float, now: float, rtt: float | None) -> bool:
        """Return whether its turn, which began then, ends for whoever used so much (seconds) and waits."""
        slice_ = now - began
        if slice_ < RELIEF and self.waited_long(began, rtt):
            return False
        if rival < LIGHT_USE and max(self.used(now), slice_) >= LIGHT_USE:
            return True
        return slice_ >= min(MAX_TURN, max(MIN_TURN, TURN_TRIPS * (rtt or 0.0)))


class Queue(Protocol):
    """Those who want the session, as whoever has it sees them."""

    write_traits: WriteTraits

    def rival_use(self, user: object) -> float | None:
        """Return how much the lightest of the others who wait used lately; None if nobody waits."""
        ...

    def expire_waiters(self) -> None:
        """Fail those who have waited too long."""
        ...

    def require_link(self) -> None:
        """Raise VehicleLost while the vehicle is silent."""
        ...
