"""Gives the one server session to one user after another. Layer: session.

    async with scheduler.turn(user) as turn:
        session = await turn.open()

A task that waits for a turn checks itself whether it is next: whenever something changed
(`ServerSession.changed`), and when its own timer ends. Readers and uploads have a task each; a single request
runs in the caller's task. Between turns the janitor closes files that nobody needs open. The janitor has a
task of its own, so that no cancelled caller interrupts a Terminate.

The user with the least score is next. Its score is its recent usage in seconds, at most 0.3, less a tenth of
the seconds that it waited. So an editor or `head` goes before a copy at once, and beside small files a copy
gets its next turn after about three seconds. If its turn began earlier, the next small read ends it at once,
so beside small reads every few round trips little of a copy arrives.
"""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from math import inf
from typing import Literal

import trio

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.driver import Driver
from mavftpfs.session.serversession import OpenSession, ServerSession
from mavftpfs.session.tries import Tries
from mavftpfs.shared.errors import (
    LocalProtocolError,
    MavftpfsError,
    RequestTimeout,
    SessionBusy,
    SessionLost,
    SessionTaken,
)
from mavftpfs.shared.model import renamed

ReadMode = Literal["window", "burst"]

MOST_USE = 0.3
"""Seconds of recent usage that count at most."""

USE_MEMORY = 10.0
"""Seconds after which usage no longer counts."""

WAITED = 0.1
"""Seconds of usage that a second of waiting makes up for."""

LEAST_TURN, LONGEST_TURN = 0.5, 2.5
TURN_TRIPS = 10.0
"""Seconds, and round trips, of a turn among equals; changing files costs up to five round trips."""

IDLE_CLOSE = 1.5
"""Seconds for which a file stays open on the server without being read. PX4 frees its buffers after 2 s, and
ArduPilot gives the session away after 3 s, so a session that is still open here is open there, too."""

MAYBE_OPEN_CLOSE = 5.0
"""Seconds after the last turn, or the last try, after which the janitor closes the files in `maybe_open`."""

LONGEST_BARREN = 20.0
"""Seconds without progress after which a turn does not end before it brought something. That costs an
interactive user a round trip, so it must be seldom."""

_KEPT = "the vehicle's only session is kept by another transfer"
_UNANSWERED = "the vehicle did not answer while a file was to be opened"
_OTHERS = (
    "another client of the vehicle, or another mavftpfs (see: mavftpfs hub), may have a file open, and "
    "opening one could end its transfer"
)


class Future:
    """Lets tasks wait for the end of another task's work."""

    def __init__(self) -> None:
        self._event = trio.Event()
        self._error: MavftpfsError | None = None

    @property
    def ended(self) -> bool:
        """Whether the work ended, well or not."""
        return self._event.is_set()

    def end(self, error: MavftpfsError | None = None) -> None:
        """Wake the tasks that wait, with an error if the work failed; only the first call counts."""
        if not self.ended:
            self._error = error
            self._event.set()

    async def wait(self) -> None:
        """Wait for the end, and raise the error if there is one."""
        await self._event.wait()
        if self._error is not None:
            raise self._error.with_traceback(None)


class SessionUser:
    """A reader, an upload or a single request, with its order among the waiting users.

    Attributes:
        path: of the file it uses.
        waiting_since: when it was first `pressing` since its last turn; None if it is not.
        writing: its turns are refused while nothing may be written.
        tries: its turns without progress.
    """

    def __init__(self, path: bytes, *, writing: bool = False) -> None:
        self.path = path
        self.waiting_since: float | None = None
        self.writing = writing
        self.tries = Tries()
        self._used = 0.0
        self._until = 0.0

    @property
    def awaited_since(self) -> float | None:
        """When a caller began to wait for this user, so that it gets a turn or an error in time. None if no
        caller waits: an upload in the background has only `waiting_since`, and readahead neither."""
        return self.waiting_since

    @property
    def pressing(self) -> bool:
        """Whether the user needs a turn for more than readahead."""
        return True

    def note_pressing(self, now: float) -> None:
        """Note since when this user is `pressing`. Called whenever that may have changed."""
        if not self.pressing:
            self.waiting_since = None
        elif self.waiting_since is None:
            self.waiting_since = now

    @property
    def idle(self) -> bool:
        """Whether the user needs no turn, though it may be in the queue."""
        return False

    def goes_on(self, session: OpenSession) -> bool:
        """Return whether the user continues with the open file and opens nothing."""
        return False

    def on_queued(self) -> None:
        """Note that this user still waits for its turn. Called at least each quarter of `op_deadline`, so
        that the reads that wait for it do not time out."""

    def on_removed(self) -> None:
        """Note that the file of its path was removed or replaced."""

    def on_armed_changed(self) -> None:
        """Note that the vehicle was armed or disarmed."""

    def on_turn(self, began: float, now: float) -> None:
        """Note that this user's turn began then and ends now."""
        self._used = self.used(began) + now - began
        self._until = now

    def used(self, now: float) -> float:
        """Return the recent usage in seconds: it fades within USE_MEMORY, but not while the user waits."""
        until = now if self.waiting_since is None else min(now, self.waiting_since)
        return self._used * min(1.0, max(0.0, 1.0 - (until - self._until) / USE_MEMORY))

    def waited(self, now: float) -> float:
        """Return for how many seconds the user has waited for a turn."""
        return 0.0 if self.waiting_since is None else max(0.0, now - self.waiting_since)

    def score(self, now: float) -> float:
        """Return the score by which waiting users are ordered: the least is next."""
        return min(self.used(now), MOST_USE) - WAITED * self.waited(now)


class Turn:
    """The session, while one user has it.

    Attributes:
        user, task: whose turn it is. granted_at: when it began. began: when its file was opened; that is
        granted_at if the file was open already.
    """

    def __init__(self, scheduler: Scheduler, user: SessionUser) -> None:
        self.user = user
        self.task = trio.lowlevel.current_task()
        self.granted_at = self.began = scheduler.clock()
        self._scheduler = scheduler

    async def open(self, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close the open file and open the user's. While another client has a file open, other users may have
        the turn.

        Raises:
            RequestTimeout: no answer for `op_deadline`, in which the closing of other files and the wait for
                the turn count. Everything that ServerSession.open and Scheduler.turn raise.
        """
        scheduler = self._scheduler
        while True:
            assert scheduler.holder is self
            left = scheduler.deadline(self.user) - scheduler.clock()
            try:
                with trio.move_on_after(max(0.0, left)):
                    session = await scheduler.server.open(self.user.path, opcode)
                    self.began = session.opened_at
                    return session
            except SessionTaken:
                await scheduler.wait_again(self)
            else:
                scheduler.server.vehicle.note_timeout()
                raise RequestTimeout(_UNANSWERED)

    @property
    def contended(self) -> bool:
        """Whether another waiting user could use the session now."""
        return bool(self._scheduler.waiting(self._scheduler.clock()))

    @property
    def interactive_waits(self) -> bool:
        """Whether an interactive user waits, one with little recent usage, so that this turn is short."""
        now = self._scheduler.clock()
        return any(rival.used(now) < MOST_USE for rival in self._scheduler.waiting(now))

    def is_over(self) -> bool:
        """Return whether another user is next now, or the path is about to change.

        A user whose turns brought nothing for LONGEST_BARREN keeps its turn until it brought something, at
        most for `longest_silence`, because over a slow link nothing would ever arrive in a shorter one. A
        turn that lasted long (ten round trips, 0.5 to 2.5 s) ends for any user with a lower score; a shorter
        one only for an interactive user. In the first half second of a turn, the time that its user waited
        before still lowers its score, because otherwise the next small file would end a copy's turn at once.
        """
        scheduler, user = self._scheduler, self.user
        now, rtt = scheduler.clock(), scheduler.server.engine.rtt
        if scheduler.is_excluded(user.path):
            return True
        lasted = now - self.began
        barren = user.tries.barren_for(now) >= LONGEST_BARREN
        if barren and lasted < scheduler.server.longest_silence:
            return False
        used, rivals = user.used(self.began) + lasted, scheduler.waiting(now)
        score = min(used, MOST_USE)
        if lasted < LEAST_TURN:
            score -= WAITED * user.waited(self.granted_at)
        if lasted < min(LONGEST_TURN, max(LEAST_TURN, TURN_TRIPS * (rtt or 0.0))):
            if score <= 0.0 or used < MOST_USE:
                return False
            rivals = [rival for rival in rivals if rival.used(now) < MOST_USE]
        return any(rival.score(now) < score for rival in rivals)


@dataclass(eq=False)
class _Excluded:
    """Paths that are about to change. below: all paths below the first, too. b"" may be any path."""

    paths: tuple[bytes, ...]
    below: bool

    def covers(self, path: bytes) -> bool:
        return (
            not path
            or path in self.paths
            or (self.below and path.startswith(self.paths[0].rstrip(b"/") + b"/"))
        )


class Scheduler:
    """Serialises all use of the server session.

    op_deadline: seconds in which a user that a caller waits for gets the session, or an error.
    patient: see ConnectOptions.
    chunk: bytes that a request carries, 1..239; None: see ChunkSize.

    Attributes:
        users: the readers and uploads that are registered.
        holder: the turn that was granted and is not over. serving: set once `serve` runs.
        read_mode: the requests that read files. read_chunks, write_chunks: the size of requests.
    """

    def __init__(
        self,
        driver: Driver,
        *,
        clock: Callable[[], float],
        rng: random.Random,
        op_deadline: float = 30.0,
        patient: bool = False,
        read_mode: ReadMode = "window",
        chunk: int | None = None,
    ) -> None:
        self.read_mode: ReadMode = read_mode
        self.read_chunks, self.write_chunks = ChunkSize(chunk), ChunkSize(chunk)
        self.server = ServerSession(driver, clock, rng, op_deadline, patient=patient)
        self.clock = clock
        self.users: dict[SessionUser, None] = {}
        self.serving = trio.Event()
        self.holder: Turn | None = None
        self._driver = driver
        self._op_deadline = op_deadline
        self._longest_wait = 1.02 * op_deadline  # so that a request's own time-out, which says more, is first
        self._queue: dict[SessionUser, MavftpfsError | None] = {}  # with the reason to refuse it a turn
        self._excluded: list[_Excluded] = []
        self._nursery: trio.Nursery | None = None
        self._tidying = False
        self._used_at = clock()  # end of the last turn, or the janitor's last try
        self._answered_at = -inf  # see `_answered_in_turn_at`

    # --- turns

    def add(self, user: SessionUser, run: Callable[[], Awaitable[None]]) -> None:
        """Register a reader or an upload, and run its task until that or the connection ends."""
        assert self._nursery is not None
        self.users[user] = None
        self._nursery.start_soon(run)

    def remove(self, user: SessionUser) -> None:
        """Unregister a reader or an upload. Calling this twice is harmless."""
        self.users.pop(user, None)
        self.refuse(user, LocalProtocolError("the file was closed"))

    def refuse(self, user: SessionUser, error: MavftpfsError) -> None:
        """Raise an error in a user that waits for a turn; harmless for others."""
        if user in self._queue:
            self._queue[user] = error
        self.server.wake()

    @asynccontextmanager
    async def turn(self, user: SessionUser) -> AsyncIterator[Turn]:
        """Wait for the session, and keep it for the length of the body.

        The body must not wait for a path, a file or memory for reads, because a task that holds one of these
        may be waiting for the session. If the body is cancelled while it opens or closes a file, the janitor
        closes the files in `maybe_open`.

        Raises:
            VehicleLost, Armed: the session cannot be used now. RequestTimeout: other users keep it.
            SessionBusy: another client may have a file open.
        """
        turn: Turn | None = None
        try:
            user.note_pressing(self.clock())
            await trio.lowlevel.checkpoint()
            await self._wait(user)
            turn = Turn(self, user)
            self._set_holder(turn)
            self.server.vehicle.require(self.clock(), writing=user.writing)
            user.tries.on_turn(turn.granted_at)
            yield turn
        finally:
            if turn is not None and self.holder is turn:
                now = self.clock()
                user.on_turn(turn.began, now)
                self._answered_at, self._used_at = self._answered_in_turn_at, now
                self._set_holder(None)
            user.waiting_since = None

    async def wait_again(self, turn: Turn) -> None:
        """Give a turn up, and wait until the user is next again; raises the errors of `turn`."""
        self._set_holder(None)
        await self._wait(turn.user)
        turn.granted_at = self.clock()
        self._set_holder(turn)
        self.server.vehicle.require(self.clock(), writing=turn.user.writing)

    async def _wait(self, user: SessionUser) -> None:
        """Wait in the queue until a user is next."""
        self._queue[user] = None
        self.server.wake()
        try:
            while not self._is_next(user):
                if (refusal := self._queue[user]) is not None:
                    raise refusal
                now, others_until = self.clock(), self.server.others_until
                if now >= self.deadline(user):
                    raise SessionBusy(_OTHERS) if now < others_until else RequestTimeout(_KEPT)
                user.on_queued()
                until = min(self.deadline(user), now + self._op_deadline / 4)  # for the next `on_queued`
                await self.server.sleep((min(until, others_until) if others_until > now else until) - now)
        finally:
            del self._queue[user]
            self.server.wake()

    def deadline(self, user: SessionUser) -> float:
        """Return when a user that waits for its turn, or for its file to be opened, gets an error:
        `op_deadline` after the vehicle last answered in a turn, or after another client last had a file open;
        never if no caller waits."""
        if user.awaited_since is None:
            return inf
        since = max(user.awaited_since, self._answered_in_turn_at)
        if self.clock() < self.server.others_until:
            return self.server.busy_at(since)
        return max(since, self.server.others_until) + self._longest_wait

    def failure(self, user: SessionUser) -> MavftpfsError | None:
        """Return the error of a user that made no progress for `op_deadline`."""
        return user.tries.failure(self.clock(), self._op_deadline)

    def lose(self, user: SessionUser, lost: SessionLost) -> None:
        """Leave the session that its user found lost. The user tries again."""
        self.server.lose(lost)
        user.tries.on_lost(lost, self.clock(), self._op_deadline)

    @property
    def _answered_in_turn_at(self) -> float:
        """When the vehicle last answered during a turn. Answers to listings outside of turns do not count."""
        answered_at, holder = self._driver.last_reply_at, self.holder
        return answered_at if holder is not None and answered_at >= holder.granted_at else self._answered_at

    def _set_holder(self, turn: Turn | None) -> None:
        self.holder = turn
        self.server.wake()

    def assert_no_turn(self) -> None:
        """Assert that the caller has no turn, because it would wait for itself, or keep others waiting."""
        assert self.holder is None or self.holder.task is not trio.lowlevel.current_task(), "not in a turn"

    @property
    def waits_for(self) -> str | None:
        """The cause that holds requests up now: "client", another one that may have a file open; "session",
        one that an earlier client left open; None: neither."""
        if (self._queue or self.server.held_up) and self.clock() < self.server.others_until:
            return "client"
        return "session" if self._driver.silent else None

    def waiting(self, now: float) -> list[SessionUser]:
        """Return the users that need more than readahead, and could use the session now."""
        return [user for user in self._queue if user.waiting_since is not None and self._may_use(user, now)]

    def _is_next(self, user: SessionUser) -> bool:
        """Return whether a user's turn begins now: it is next, nobody has a turn, no other file is open."""
        session = self.server.opened
        closed = session is None or session.path == user.path
        return closed and self.holder is None and not self._tidying and self.next_user() is user

    def next_user(self) -> SessionUser | None:
        """Return the user that gets the session next. Readahead runs only if no user waits, that of the open
        file first."""
        now = self.clock()
        if waiting := self.waiting(now):
            return min(waiting, key=lambda user: user.score(now))
        session = self.server.opened
        first = None
        for user in self._queue:
            if not user.idle and self._may_use(user, now):
                if session is not None and user.path == session.path:
                    return user
                first = first or user
        return first

    def _may_use(self, user: SessionUser, now: float) -> bool:
        """Return whether a user may use its file now: no change of names and no other client's file bars
        it."""
        if self._queue.get(user) is not None or self.is_excluded(user.path):
            return False
        session = self.server.opened
        return now >= self.server.others_until or (session is not None and user.goes_on(session))

    # --- paths that are about to change

    def is_excluded(self, path: bytes) -> bool:
        """Return whether this path is about to change."""
        return bool(self._excluded) and any(excluded.covers(path) for excluded in self._excluded)

    @asynccontextmanager
    async def excluded(self, *paths: bytes, below: bool = False) -> AsyncIterator[None]:
        """Keep files with these paths closed for the length of the body; below: all below the first, too.

        Raises:
            RequestTimeout: an open one could not be closed in time.
        """
        self.assert_no_turn()
        excluded, server = _Excluded(paths, below), self.server
        self._excluded.append(excluded)
        server.wake()
        try:
            with trio.move_on_after(self._op_deadline) as scope:
                while any(map(excluded.covers, self._used_paths())):
                    await server.changed.park()
            if scope.cancelled_caught:
                raise RequestTimeout("a file with this path, or below it, is open and could not be closed")
            yield
        finally:
            self._excluded.remove(excluded)
            server.wake()

    def _used_paths(self) -> list[bytes]:
        """Return the paths of files that are open, may be open, or may be opened at any time."""
        used = self.server.maybe_open.copy()
        if self.server.opened is not None:
            used.append(self.server.opened.path)
        if self.holder is not None:
            used.append(self.holder.user.path)
        return used

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """Note that a file or directory was renamed.

        Users of it, and of files in it, continue under the new path. A file that had the new name can no
        longer be read.
        """
        for user in list(self.users):  # a copy, because this may close a user
            if user.path == new:
                user.on_removed()
            else:
                user.path = renamed(user.path, old, new)

    def on_removed(self, path: bytes) -> None:
        """Note that the file of this name was removed or replaced, so its readers get an error."""
        for user in list(self.users):  # a user may be closed by that
            if user.path == path:
                user.on_removed()

    # --- news

    def on_armed_changed(self) -> None:
        """Stop uploads when the vehicle arms, and resume them when it disarms (promise 9)."""
        for user in self.users:
            user.on_armed_changed()
        self.server.wake()

    # --- the janitor

    async def serve(self) -> None:
        """Run the janitor, and the tasks of readers and uploads, until cancelled."""
        async with trio.open_nursery() as self._nursery:
            self.serving.set()
            while True:
                await trio.lowlevel.checkpoint()
                if self._queue and self.clock() < self.server.others_until:
                    await self.server.learn_several_sessions()
                now, wait = self.clock(), self._closes_in(self.clock())
                if now < self.server.others_until:  # after which another user may be next
                    wait = min(wait, self.server.others_until - now)
                if wait > 0.0:
                    await self.server.sleep(wait)
                else:
                    await self.tidy()

    async def tidy(self) -> None:
        """Close the open file, or those in `maybe_open`. If that fails, tasks that wait for it time out."""
        server = self.server
        self._tidying = True
        try:
            if server.opened is not None:
                await server.close_quietly()
            else:
                await server.close_maybe_open()
        finally:
            self._tidying, self._used_at = False, self.clock()
            server.wake()

    def _closes_in(self, now: float) -> float:
        """Return in how many seconds the janitor closes the open file, or those in `maybe_open`.

        The janitor closes at once if another user is next, or the path is about to change. Otherwise the wait
        is counted from the last turn, not from the last wake-up: wake-ups may never cease, and an orphaned
        session keeps other clients out.
        """
        server, session = self.server, self.server.opened
        if self.holder is not None:
            return inf
        if session is not None:
            user = self.next_user()
            if self.is_excluded(session.path) or (user is not None and user.path != session.path):
                return 0.0
            if not self._is_kept(session.path):
                return 0.0
            return max(0.0, self._used_at + IDLE_CLOSE - now)
        if any(map(self.is_excluded, server.maybe_open)):
            return 0.0
        if not server.maybe_open or self.next_user() is not None:  # whose open closes those first
            return inf
        if server.vehicle.lost(now):
            return MAYBE_OPEN_CLOSE
        return max(0.0, self._used_at + MAYBE_OPEN_CLOSE - now)

    def _is_kept(self, path: bytes) -> bool:
        """Return whether the janitor leaves a file open for IDLE_CLOSE seconds. While the vehicle is armed,
        it does so only for a reader or an upload that still exists."""
        return not self.server.vehicle.armed or any(user.path == path for user in self.users)

    async def close(self) -> None:
        """Terminate the session, and ignore failures, because most servers close an idle session by
        themselves. The caller bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_maybe_open()
