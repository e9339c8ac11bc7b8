"""Who wants the server's session, and who goes first. Layer: session.

Whoever used little of it lately (an editor, `head`) goes before whoever used much (a copy), at once. Those
who used much take turns of a second or more, since changing files costs round trips. Whoever waited for long
goes first all the same: one small file after another slows a copy down, and does not stop it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import inf

from mavftpfs.protocol.engine import Engine
from mavftpfs.session.serversession import ServerSession
from mavftpfs.shared.errors import MavftpfsError, RequestTimeout

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


class SessionUser(ABC):
    """Somebody who wants the session now and then: a reader, an upload, a single request.

    Attributes:
        path: of the file it uses.
        asked_at: when it began to wait for its turn; None while it wants nothing. It stays set in the turn.
    """

    def __init__(self, path: bytes, asked_at: float | None = None) -> None:
        self.path = path
        self.asked_at = asked_at
        self._used = 0.0
        self._until = 0.0

    @abstractmethod
    def due_at(self) -> float:
        """Return when it can use the session: 0 for now, inf if nothing is wanted that somebody waits for."""

    @abstractmethod
    def fail(self, error: MavftpfsError) -> None:
        """Tell whoever waits that what it wants cannot be had now."""

    def prefetches(self) -> bool:
        """Return whether it wants something that nobody waits for."""
        return False

    def expire(self, error: MavftpfsError) -> None:
        """It waited too long. Who asks again waits anew."""
        self.asked_at = None
        self.fail(error)

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


class Queue:
    """Those who want the session, now or later.

    op_deadline: seconds after which whoever waits is told that the session is not to be had.
    """

    def __init__(
        self, server: ServerSession, engine: Engine, clock: Callable[[], float], op_deadline: float
    ) -> None:
        self.users: dict[SessionUser, None] = {}
        self._server = server
        self._engine = engine
        self._clock = clock
        self._op_deadline = op_deadline

    def add(self, user: SessionUser) -> None:
        """Let somebody want the session from now on."""
        self.users[user] = None
        self._server.wake()

    def remove(self, user: SessionUser) -> None:
        """It wants nothing any more; harmless if that is known."""
        self.users.pop(user, None)
        self._server.wake()

    def waiting(self, now: float) -> list[SessionUser]:
        """Return all who wait for the session and could use it now."""
        waiting = []
        for user in self.users:
            if user.due_at() <= now and not self._server.is_excluded(user.path):
                waiting.append(user)
        return waiting

    def first(self) -> SessionUser | None:
        """Return whoever is to use the session now. Readahead comes only if nobody waits for anything, and
        that of the open file first."""
        now, rtt = self._clock(), self._engine.rtt
        first, best = None, (True, inf)
        for user in self.waiting(now):
            rank = user.rank(now, rtt)
            if first is None or rank < best:
                first, best = user, rank
        if first is not None:
            return first
        session = self._server.session
        for user in self.users:
            if user.prefetches() and not self._server.is_excluded(user.path):
                if session is not None and user.path == session.path:
                    return user
                first = first or user
        return first

    def next_due(self, now: float) -> float:
        """Return when somebody comes who cannot use the session yet; inf if nobody will by itself."""
        next_due = inf
        for user in self.users:
            if now < user.due_at() < next_due:
                next_due = user.due_at()
        return next_due

    def rival_use(self, user: SessionUser) -> float | None:
        """Return how much the lightest of the others who wait used lately (seconds); None if nobody waits."""
        now = self._clock()
        least: float | None = None
        for other in self.waiting(now):
            if other is not user and (least is None or other.used(now) < least):
                least = other.used(now)
        return least

    def expire_waiters(self) -> None:
        """Somebody holds the session and cannot be interrupted: do not let others wait for ever."""
        now = self._clock()
        error = RequestTimeout("the vehicle's only session is taken by an upload that cannot be interrupted")
        for user in self.waiting(now):
            if user.asked_at is not None and user.asked_at < now - self._op_deadline:
                user.expire(error)
