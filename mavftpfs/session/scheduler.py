"""Gives the one server session to one user after another. Layer: session.

    async with scheduler.turn(user) as turn:
        session = await turn.open()

A task that waits for a turn looks itself whether it is next: whenever something changed
(`ServerSession.changed`), and when its own timer ends. Readers and uploads have a task each, single requests
are made in the caller's own. Between turns the janitor closes what nobody needs open, so that no caller is
cancelled in a Terminate.

The user with the least score is next: seconds of use in the recent past, which count up to 0.3, less a tenth
of the seconds that it waited. So an editor or `head` goes before a copy at once, and one small file after
another keeps a copy waiting for three seconds at most.
"""

from __future__ import annotations

import random
from collections import deque
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
from mavftpfs.shared.errors import (
    LocalProtocolError,
    MavftpfsError,
    RequestTimeout,
    SessionBusy,
    SessionTaken,
)
from mavftpfs.shared.model import renamed

ReadMode = Literal["window", "burst"]

MOST_USE = 0.3
"""Seconds of use in the recent past that count at most."""

USE_MEMORY = 10.0
"""Seconds after which use no longer counts."""

WAITED = 0.1
"""How much a second of waiting counts, in seconds of use."""

LEAST_TURN, LONGEST_TURN = 0.5, 2.5
TURN_TRIPS = 10.0
"""Seconds, and round trips, that a turn lasts among equals: changing files costs up to five round trips."""

RECENT = 10.0
"""Seconds for which what was read stays provisional, also of files that were closed since: another client is
noticed late, because servers answer it on its own link, and a router may pass on only some of that."""

IDLE_CLOSE = 1.5
"""Seconds a file stays open on the server without being read. Below the 2 s after which PX4 frees its
buffers and the 3 s after which ArduPilot gives the session away: so a session is never doubtful."""

MAYBE_OPEN_CLOSE = 5.0
"""Seconds after the last use, or the last try, after which what may be open is closed."""

_KEPT = "the vehicle's only session is kept by another transfer"
_OTHERS = "another client of the vehicle may have a file open, which is not ended for ours"


class Future:
    """Lets tasks wait for the end of another task's work."""

    def __init__(self) -> None:
        self._event = trio.Event()
        self._error: MavftpfsError | None = None

    @property
    def ended(self) -> bool:
        """Whether it ended, well or not."""
        return self._event.is_set()

    def end(self, error: MavftpfsError | None = None) -> None:
        """Let those that wait go on, with an error where it failed; the first time counts."""
        if not self.ended:
            self._error = error
            self._event.set()

    async def wait(self) -> None:
        """Wait for the end, and raise the error if there is one."""
        await self._event.wait()
        if self._error is not None:
            raise self._error.with_traceback(None)


class SessionUser:
    """A reader, an upload or a single request, with what orders it among those that wait.

    Attributes:
        path: of the file it uses.
        waiting_since: when it began to want more than readahead; None if it does not. The user sets it;
            `Scheduler.turn` clears it, however it ends.
        writing: its turns are refused while nothing may be written.
    """

    def __init__(self, path: bytes, waiting_since: float | None = None, *, writing: bool = False) -> None:
        self.path = path
        self.waiting_since = waiting_since
        self.writing = writing
        self._used = 0.0
        self._until = 0.0

    @property
    def awaited_since(self) -> float | None:
        """When a caller began to wait for this user: it gets a turn in time, or an error. None if none waits,
        as for an upload in the background."""
        return self.waiting_since

    @property
    def idle(self) -> bool:
        """Whether it wants nothing, though it may be in the queue."""
        return False

    def goes_on(self, session: OpenSession) -> bool:
        """Return whether it uses what is open and opens nothing."""
        return False

    def on_queued(self) -> None:
        """Note that it goes on waiting for others, and that its time is not up."""

    def on_removed(self) -> None:
        """Note that the file of its path was removed or replaced."""

    def on_suspect(self, reason: str) -> None:
        """Note that what was read lately may be another file's."""

    def on_armed_changed(self) -> None:
        """Note that the vehicle was armed or disarmed."""

    def on_turn(self, began: float, now: float) -> None:
        """Note that it had the session since then."""
        self._used = self.used(began) + now - began
        self._until = now

    def used(self, now: float) -> float:
        """Return the seconds of use that still count: they fade, but not while it waits."""
        until = now if self.waiting_since is None else min(now, self.waiting_since)
        return self._used * min(1.0, max(0.0, 1.0 - (until - self._until) / USE_MEMORY))

    def score(self, now: float) -> float:
        """Return its place among the users that wait: the least is next."""
        waited = 0.0 if self.waiting_since is None else now - self.waiting_since
        return min(self.used(now), MOST_USE) - WAITED * waited


class Turn:
    """The session, while one user has it.

    Attributes:
        user, task: whose it is. granted_at: since when. began: when its file was opened, or went on.
    """

    def __init__(self, scheduler: Scheduler, user: SessionUser) -> None:
        self.user = user
        self.task = trio.lowlevel.current_task()
        self.granted_at = self.began = scheduler.clock()
        self._scheduler = scheduler
        since = self.began if user.waiting_since is None else user.waiting_since
        self._waited = self.began - since

    async def open(self, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close what is open and open the user's file. While another client has a file open, others may have
        the turn. Raises what ServerSession.open and Scheduler.turn do."""
        scheduler = self._scheduler
        while True:
            assert scheduler.holder is self
            try:
                session = await scheduler.server.open(self.user.path, opcode)
                break
            except SessionTaken:
                await scheduler.wait_again(self)
        self.began = session.opened_at
        return session

    @property
    def contended(self) -> bool:
        """Whether another user waits that could use the session now."""
        return bool(self._scheduler.waiting(self._scheduler.clock()))

    @property
    def light_waits(self) -> bool:
        """Whether another user waits that used little, so that this turn is short."""
        now = self._scheduler.clock()
        return any(rival.used(now) < MOST_USE for rival in self._scheduler.waiting(now))

    def is_over(self) -> bool:
        """Return whether another user is to go first now, or the path is about to change.

        A turn that lasted a while ends for any user with a lower score; before that only for one that used
        little. Half a second is left in any case to a user that waited for longer than its use counts: else
        the next small file would send it away at once.
        """
        scheduler, user = self._scheduler, self.user
        now, rtt = scheduler.clock(), scheduler.server.engine.rtt
        if scheduler.is_excluded(user.path):
            return True
        lasted = now - self.began
        used, rivals = user.used(self.began) + lasted, scheduler.waiting(now)
        score = min(used, MOST_USE)
        if lasted < LEAST_TURN:
            score -= WAITED * self._waited
        if lasted < min(LONGEST_TURN, max(LEAST_TURN, TURN_TRIPS * (rtt or 0.0))):
            if score <= 0.0 or used < MOST_USE:
                return False
            rivals = [rival for rival in rivals if rival.used(now) < MOST_USE]
        return any(rival.score(now) < score for rival in rivals)


@dataclass(eq=False)
class _Excluded:
    """Paths that are about to change. below: with all that lies below the first."""

    paths: tuple[bytes, ...]
    below: bool

    def covers(self, path: bytes) -> bool:
        return path in self.paths or (self.below and path.startswith(self.paths[0].rstrip(b"/") + b"/"))


class Scheduler:
    """Serialises all use of the server session.

    op_deadline: seconds in which a user gets the session, or is told that it is not to be had.
    patient: see ConnectOptions.
    chunk: bytes that a request carries, 1..239; None: see ChunkSize.

    Attributes:
        users: the readers and uploads there are.
        holder: the turn that was granted and is not over. serving: set once `serve` runs.
        read_mode: by which requests files are read. read_chunks, write_chunks: the size of requests.
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
        self.server.on_reads_distrusted = self._on_reads_distrusted
        self.clock = clock
        self.users: dict[SessionUser, None] = {}
        self.serving = trio.Event()
        self._gone: deque[tuple[float, SessionUser]] = deque()  # with the time when they were removed
        self.holder: Turn | None = None
        self._driver = driver
        self._op_deadline = op_deadline
        self._longest_wait = 1.02 * op_deadline  # the time-out of a request comes first, and says more
        self._queue: dict[SessionUser, MavftpfsError | None] = {}  # with what refuses it a turn
        self._excluded: list[_Excluded] = []
        self._nursery: trio.Nursery | None = None
        self._tidying = False
        self._used_at = clock()  # end of the last turn, or the janitor's last try
        self._moved_at = -inf  # see `_moved`

    # --- turns

    def add(self, user: SessionUser, run: Callable[[], Awaitable[None]]) -> None:
        """Run the task of a reader or an upload, until it ends or the connection does."""
        assert self._nursery is not None
        self.users[user] = None
        self._nursery.start_soon(run)

    def remove(self, user: SessionUser) -> None:
        """Unregister a reader or an upload. Calling this twice is harmless."""
        if user in self.users:
            del self.users[user]
            now = self.clock()
            self._gone.append((now, user))
            while self._gone[0][0] < now - RECENT:
                self._gone.popleft()
        self.refuse(user, LocalProtocolError("it was closed"))

    def refuse(self, user: SessionUser, error: MavftpfsError) -> None:
        """If a user waits for a turn, raise an error there."""
        if user in self._queue:
            self._queue[user] = error
        self.server.wake()

    @asynccontextmanager
    async def turn(self, user: SessionUser) -> AsyncIterator[Turn]:
        """Wait for the session, and have it for the length of the body.

        The body must not wait for a path, a node or memory for reads: a task that has one of these may be
        waiting for the session. If the body is cancelled while it opens or closes a file, the janitor closes
        what may be open.

        Raises:
            VehicleLost, Armed: it cannot be used now. RequestTimeout, SessionBusy: others keep it.
        """
        turn: Turn | None = None
        try:
            await trio.lowlevel.checkpoint()
            await self._wait(user)
            turn = Turn(self, user)
            self._set_holder(turn)
            self.server.vehicle.require(self.clock(), writing=user.writing)
            yield turn
        finally:
            if turn is not None and self.holder is turn:
                now = self.clock()
                user.on_turn(turn.began, now)
                self._moved_at, self._used_at = self._moved, now
                self._set_holder(None)
            user.waiting_since = None

    async def wait_again(self, turn: Turn) -> None:
        """Give a turn back, and wait until it is next again; raises what `turn` does."""
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
                now, others_until = self.clock(), self.others_until
                if now >= self._deadline(user):
                    raise SessionBusy(_OTHERS) if now < others_until else RequestTimeout(_KEPT)
                user.on_queued()
                until = min(self._deadline(user), now + self._op_deadline / 4)  # it is told that it goes on
                await self.server.sleep((min(until, others_until) if others_until > now else until) - now)
        finally:
            del self._queue[user]
            self.server.wake()

    def _deadline(self, user: SessionUser) -> float:
        """Return until when a user waits. Its time begins when the vehicle last answered in somebody's turn,
        or when another client last closed a file."""
        since = user.awaited_since
        if since is None:
            return inf
        if self.clock() < self.others_until:
            return self.server.busy_at(max(since, self._moved))
        return max(since, self._moved) + self._longest_wait

    @property
    def _moved(self) -> float:
        """When the vehicle last answered in somebody's turn. Listings are also answered outside of turns."""
        answered_at, holder = self._driver.last_reply_at, self.holder
        return answered_at if holder is not None and answered_at >= holder.granted_at else self._moved_at

    def _set_holder(self, turn: Turn | None) -> None:
        self.holder = turn
        self.server.wake()

    def assert_no_turn(self) -> None:
        """Assert that the caller has no turn: it would wait for itself, or make others wait for long."""
        assert self.holder is None or self.holder.task is not trio.lowlevel.current_task(), "not in a turn"

    def waiting(self, now: float) -> list[SessionUser]:
        """Return the users that want more than readahead, and could use the session now."""
        return [user for user in self._queue if user.waiting_since is not None and self._may_use(user, now)]

    def _is_next(self, user: SessionUser) -> bool:
        """Return whether a user has its turn now: it is first, and no other file is open."""
        session = self.server.session
        closed = session is None or session.path == user.path
        return closed and self.holder is None and not self._tidying and self.next_user() is user

    def next_user(self) -> SessionUser | None:
        """Return the user that is to have the session now. Readahead comes only if nothing waits, and that of
        the open file first."""
        now = self.clock()
        if waiting := self.waiting(now):
            return min(waiting, key=lambda user: user.score(now))
        session = self.server.session
        first = None
        for user in self._queue:
            if not user.idle and self._may_use(user, now):
                if session is not None and user.path == session.path:
                    return user
                first = first or user
        return first

    def _may_use(self, user: SessionUser, now: float) -> bool:
        """Return whether nothing keeps it from its file: a change of names, or another client's open file."""
        if self._queue.get(user) is not None or self.is_excluded(user.path):
            return False
        session = self.server.session
        return now >= self.others_until or (session is not None and user.goes_on(session))

    @property
    def others_until(self) -> float:
        """Until then nothing is opened: that might end another client's session."""
        several = self._driver.engine.traits.several_sessions
        return -inf if several else self.server.others.file_open_until

    # --- paths that are about to change

    def is_excluded(self, path: bytes) -> bool:
        """Return whether somebody changes this path now."""
        return bool(self._excluded) and any(excluded.covers(path) for excluded in self._excluded)

    @asynccontextmanager
    async def excluded(self, *paths: bytes, below: bool = False) -> AsyncIterator[None]:
        """Keep the session off paths for the length of the body; below: off all below the first, too.

        Raises:
            RequestTimeout: it could not be closed in time.
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
                raise RequestTimeout("our own session on these paths could not be closed")
            yield
        finally:
            self._excluded.remove(excluded)
            server.wake()

    def _used_paths(self) -> list[bytes]:
        """Return where something is open, may be open, or may be opened at any time."""
        used = [path for _, path in self.server.maybe_open]
        if self.server.session is not None:
            used.append(self.server.session.path)
        if self.holder is not None:
            used.append(self.holder.user.path)
        return used

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """Note that a file or directory was renamed.

        Users of it, and of what lies in it, go on under the new path. A file that had the new name cannot be
        read any more.
        """
        for user in list(self.users):  # a user may be closed by that
            if user.path == new:
                user.on_removed()
            else:
                user.path = renamed(user.path, old, new)

    def on_removed(self, path: bytes) -> None:
        """Note that the file of this name was removed or replaced: its readers get no more of it."""
        for user in list(self.users):  # a user may be closed by that
            if user.path == path:
                user.on_removed()

    # --- news

    def _on_reads_distrusted(self, why: str) -> None:
        """Tell all users that what was read lately may be another file's, also of files closed since."""
        for user in [*self.users, *(user for _, user in self._gone)]:
            user.on_suspect(why)

    def on_armed_changed(self) -> None:
        """End uploads while the vehicle is armed, and go on with them afterwards (promise 9)."""
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
                if self._queue and self.clock() < self.others_until:
                    await self.server.learn_several_sessions()
                now, wait = self.clock(), self._closes_in(self.clock())
                if now < self.others_until:  # then another user may be next
                    wait = min(wait, self.others_until - now)
                if wait > 0.0:
                    await self.server.sleep(wait)
                else:
                    await self.tidy()

    async def tidy(self) -> None:
        """Close what is open, or may be. A task that waits for that is told of a failure by its time-out."""
        server = self.server
        self._tidying = True
        try:
            if server.session is not None:
                await server.close_quietly()
            else:
                await server.close_maybe_open()
        finally:
            self._tidying, self._used_at = False, self.clock()
            server.wake()

    def _closes_in(self, now: float) -> float:
        """Return in how many seconds the janitor closes what is open, or may be.

        At once if another user is next, or the path is about to change. Else that is counted from the last
        use, not from the last news: there may always be news, and an orphan of ours keeps other clients out.
        """
        server, session = self.server, self.server.session
        if self.holder is not None:
            return inf
        if session is not None:
            user = self.next_user()
            if self.is_excluded(session.path) or (user is not None and user.path != session.path):
                return 0.0
            if not self._is_kept(session.path):
                return 0.0
            return max(0.0, self._used_at + IDLE_CLOSE - now)
        if any(self.is_excluded(path) for _, path in server.maybe_open):
            return 0.0
        if not server.maybe_open or self.next_user() is not None:  # which closes that before its open
            return inf
        if server.vehicle.lost(now):
            return MAYBE_OPEN_CLOSE
        return max(0.0, self._used_at + MAYBE_OPEN_CLOSE - now)

    def _is_kept(self, path: bytes) -> bool:
        """Return whether a file stays open a moment longer: not in flight, if nobody has it open here."""
        return not self.server.vehicle.armed or any(user.path == path for user in self.users)

    async def close(self) -> None:
        """Terminate the session, best effort: a server forgets it by itself, sooner or later. The caller
        bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_maybe_open()
