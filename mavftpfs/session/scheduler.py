"""Gives the one server session to one user after another. Layer: session.

    async with scheduler.turn(user) as turn:
        session = await turn.open(path)

One task (`serve`) grants the turns. Between them it closes what nobody needs open. Readers and uploads have a
task each, single requests are made in the caller's own.

A user that used little of the session lately (an editor, `head`) goes before one that used much (a copy), at
once. Those that used much take turns of a second or more, since changing files costs round trips. A user that
waited for long goes first all the same: one small file after another slows a copy down, and does not stop it.
"""

from __future__ import annotations

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
from mavftpfs.shared.errors import LocalProtocolError, MavftpfsError, RequestTimeout, SessionBusy
from mavftpfs.shared.model import renamed

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
of an upload again takes up to four round trips, and five the first time after the vehicle's start."""

RELIEF = 0.5
"""Seconds for which a user that had waited so long keeps its turn."""

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
    """The end of something that one task does and others wait for."""

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
    """A reader, an upload or a single request: what orders it among those that wait.

    Attributes:
        path: of the file it uses.
        waiting_since: since when it wants more than readahead; None if it does not. A caller waits for that
            (`awaited`), or none does: uploads in the background. The user sets it; `Scheduler.turn` clears
            it, however it ends.
        writing: its turns are refused while nothing may be written.
    """

    def __init__(self, path: bytes, waiting_since: float | None = None, *, writing: bool = False) -> None:
        self.path = path
        self.waiting_since = waiting_since
        self.writing = writing
        self._used = 0.0
        self._until = 0.0

    @property
    def awaited(self) -> bool:
        """Whether a caller waits for it, and gets an error if it has no turn in time."""
        return self.waiting_since is not None

    @property
    def idle(self) -> bool:
        """Whether it wants nothing, though it may be in the queue."""
        return False

    def goes_on(self, session: OpenSession) -> bool:
        """Return whether it uses what is open and opens nothing."""
        return False

    def on_queued(self) -> None:
        """It goes on waiting, because others have the session: the vehicle is not silent."""

    def on_removed(self) -> None:
        """The file of its path was removed or replaced."""

    def on_suspect(self, reason: str) -> None:
        """What was read lately may be another file's."""

    def on_armed_changed(self) -> None:
        """The vehicle was armed or disarmed."""

    def on_turn(self, began: float, now: float) -> None:
        """It had the session until now."""
        self._used = self.used(began) + now - began
        self._until = now

    def used(self, now: float) -> float:
        """Return the seconds of use that still count: they fade, but not while it waits."""
        until = now if self.waiting_since is None else min(now, self.waiting_since)
        return self._used * min(1.0, max(0.0, 1.0 - (until - self._until) / USE_MEMORY))

    def waited_long(self, now: float, rtt: float | None) -> bool:
        """Return whether it is not to be passed over any more."""
        limit = max(LONG_WAIT, LONG_WAIT_TRIPS * (rtt or 0.0))
        return self.waiting_since is not None and now - self.waiting_since >= limit

    def rank(self, now: float, rtt: float | None) -> tuple[bool, float]:
        """Return its place among the users that wait: the least goes first."""
        heavy = self.used(now) >= LIGHT_USE and not self.waited_long(now, rtt)
        return heavy, now if self.waiting_since is None else self.waiting_since

    def gives_way(self, rival_use: float, began: float, now: float, rtt: float | None) -> bool:
        """Return whether its turn, which began then, ends for a user that waits. rival_use: see Turn."""
        slice_, had_waited_long = now - began, self.waited_long(began, rtt)
        if slice_ < RELIEF and had_waited_long:
            return False
        if rival_use < LIGHT_USE and max(self.used(now), slice_) >= LIGHT_USE:
            return True
        return slice_ >= min(MAX_TURN, max(MIN_TURN, TURN_TRIPS * (rtt or 0.0)))


class Turn:
    """The session, as long as it is one user's; before that, the user's place in the queue.

    Attributes:
        user, task: whose it is. granted: ends when it is granted, or when the user cannot have it.
        given_back: it is over. limit: bounds the wait.
    """

    def __init__(self, scheduler: Scheduler, user: SessionUser) -> None:
        self.user = user
        self.task = trio.lowlevel.current_task()
        self.granted, self.given_back = Future(), trio.Event()
        self.limit = trio.CancelScope()
        self._scheduler = scheduler

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close what is open and open another file; raises what ServerSession.open does."""
        assert self._scheduler.holder is self
        return await self._scheduler.server.open(path, opcode)

    @property
    def rival_use(self) -> float | None:
        """How much the lightest user that waits used lately, in seconds; None if nobody waits."""
        now = self._scheduler.clock()
        return min((user.used(now) for user in self._scheduler.waiting(now)), default=None)


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
        op_deadline: float = 30.0,
        read_mode: ReadMode = "window",
        chunk: int | None = None,
    ) -> None:
        self.read_mode: ReadMode = read_mode
        self.read_chunks, self.write_chunks = ChunkSize(chunk), ChunkSize(chunk)
        self.server = ServerSession(driver, clock, op_deadline)
        self.server.on_reads_distrusted = self._on_reads_distrusted
        self.clock = clock
        self.users: dict[SessionUser, None] = {}
        self.serving = trio.Event()
        self._gone: deque[tuple[float, SessionUser]] = deque()  # with the time when they were removed
        self.holder: Turn | None = None
        self._driver = driver
        self._op_deadline = op_deadline
        self._longest_wait = 1.02 * op_deadline  # the time-out of a request comes first, and says more
        self._queue: dict[SessionUser, Turn] = {}
        self._excluded: list[_Excluded] = []
        self._nursery: trio.Nursery | None = None
        self._used_at = clock()  # end of the last turn, or the janitor's last try

    # --- turns

    def add(self, user: SessionUser, run: Callable[[], Awaitable[None]]) -> None:
        """Run the task of a reader or an upload, until it ends or the connection does."""
        assert self._nursery is not None
        self.users[user] = None
        self._nursery.start_soon(run)

    def remove(self, user: SessionUser) -> None:
        """It wants no turn any more; harmless if that is known."""
        if user in self.users:
            del self.users[user]
            now = self.clock()
            self._gone.append((now, user))
            while self._gone[0][0] < now - RECENT:
                self._gone.popleft()
        self.refuse(user, LocalProtocolError("it was closed"))

    def refuse(self, user: SessionUser, error: MavftpfsError) -> None:
        """If it waits for a turn, raise an error there."""
        turn = self._queue.pop(user, None)
        if turn is not None:
            turn.granted.end(error)
        self.server.wake()

    def limit_wait(self, user: SessionUser) -> None:
        """A caller begins to wait for this user: if it is queued, its turn comes within `op_deadline` from
        now, or it gets an error. Its place in the queue stays."""
        if user in self._queue:
            self._limit(self._queue[user])

    def _limit(self, turn: Turn) -> None:
        """Let it wait for `_longest_wait` from now on; without limit if no caller waits for its user."""
        turn.limit.deadline = trio.current_time() + self._longest_wait if turn.user.awaited else inf

    @asynccontextmanager
    async def turn(self, user: SessionUser) -> AsyncIterator[Turn]:
        """Wait for the session, and have it for the length of the body.

        The body must not wait for a path, a node or memory for reads: a task that has one of these may be
        waiting for the session. If the body is cancelled while it opens or closes a file, `serve` closes what
        may be open.

        Raises:
            VehicleLost, Armed: it cannot be used now. RequestTimeout, SessionBusy: others keep it.
        """
        turn = self._queue[user] = Turn(self, user)
        self.server.wake()
        try:
            self._limit(turn)
            with turn.limit:
                await turn.granted.wait()
            if self.holder is not turn:
                raise SessionBusy(_OTHERS) if self.clock() < self.others_until else RequestTimeout(_KEPT)
            self.server.vehicle.require(self.clock(), writing=user.writing)
            yield turn
        finally:
            user.waiting_since = None
            if self._queue.get(user) is turn:
                del self._queue[user]
            if self.holder is turn:
                self._set_holder(None)
            turn.given_back.set()

    def _set_holder(self, turn: Turn | None) -> None:
        self.holder = turn
        self.server.changed.unpark_all()

    def assert_no_turn(self) -> None:
        """Assert that the caller has no turn: it would wait for itself, or make others wait for long."""
        assert self.holder is None or self.holder.task is not trio.lowlevel.current_task(), "not in a turn"

    def waiting(self, now: float) -> list[SessionUser]:
        """Return the users that want more than readahead, and could use the session now."""
        return [user for user in self._queue if user.waiting_since is not None and self._may_use(user, now)]

    def next_user(self) -> SessionUser | None:
        """Return the user that is to have the session now. Readahead comes only if nothing waits, and that of
        the open file first."""
        now, rtt = self.clock(), self._driver.engine.rtt
        if waiting := self.waiting(now):
            return min(waiting, key=lambda user: user.rank(now, rtt))
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
        if self.is_excluded(user.path):
            return False
        session = self.server.session
        return now >= self.others_until or (session is not None and user.goes_on(session))

    @property
    def others_until(self) -> float:
        """Before this nothing is opened: that might end another client's session."""
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
        try:
            with trio.move_on_after(self._op_deadline) as scope:
                while any(map(excluded.covers, self._used_paths())):
                    server.wake()
                    await server.changed.park()
            if scope.cancelled_caught:
                raise RequestTimeout("our own session on these paths could not be closed")
            yield
        finally:
            self._excluded.remove(excluded)
            server.wake()

    def _used_paths(self) -> list[bytes]:
        """Return where something is open, may be open, or may be opened at any time."""
        used = list(self.server.maybe_open.values())
        if self.server.session is not None:
            used.append(self.server.session.path)
        if self.holder is not None:
            used.append(self.holder.user.path)
        return used

    async def _close_excluded(self) -> None:
        """Close what is open, or may be open, where a path is about to change. The task that waits for that
        is told of a failure by its time-out."""
        if not self._excluded:
            return
        server = self.server
        if server.session is not None and self.is_excluded(server.session.path):
            await server.close_quietly()
        if any(map(self.is_excluded, server.maybe_open.values())):
            await server.close_maybe_open()

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """A file or directory was renamed. Users of it, and of what lies in it, go on under the new path. A
        file that had the new name cannot be read any more."""
        for user in list(self.users):  # a user may be closed by that
            if user.path == new:
                user.on_removed()
            else:
                user.path = renamed(user.path, old, new)

    def on_removed(self, path: bytes) -> None:
        """The file of this name was removed or replaced: its readers get no more of it."""
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

    # --- the one task

    async def serve(self) -> None:
        """Grant turns until cancelled, and run the tasks of readers and uploads."""
        server = self.server
        async with trio.open_nursery() as self._nursery:
            self.serving.set()
            while True:
                await trio.lowlevel.checkpoint()
                await self._close_excluded()
                user, session = self.next_user(), server.session
                if user is None:
                    await self._idle(self.clock())
                elif session is not None and session.path != user.path:
                    await server.close_quietly()  # a user may have come meanwhile that goes first
                else:
                    await self._grant(user)

    async def _grant(self, user: SessionUser) -> None:
        """Give a user the session, and wait until it is given back. If the vehicle answered meanwhile, the
        users in the queue may wait longer: it is not silent."""
        turn, began = self._queue.pop(user), self.clock()
        self._set_holder(turn)
        turn.granted.end()
        await turn.given_back.wait()
        self._used_at = self.clock()
        if self._driver.last_reply_at >= began:
            for user, other in self._queue.items():
                self._limit(other)
                user.on_queued()

    async def _idle(self, now: float) -> None:
        """Nobody can use the session now: close it in time, and wait for news."""
        server, news_in = self.server, inf
        if self._queue and now < self.others_until:
            await server.learn_several_sessions()
            for user in self._queue:
                user.on_queued()
            news_in = max(0.0, self.others_until - now)
        if await server.sleep(min(self._closes_in(now), news_in)) or self.next_user() is not None:
            return
        self._used_at = self.clock()
        if server.session is not None:
            await server.close_quietly()
        elif not server.vehicle.lost(self._used_at):
            await server.close_maybe_open()

    def _closes_in(self, now: float) -> float:
        """Return in how many seconds what is open, or may be, is closed. That is counted from the last use,
        not from the last news: there may always be news, and an orphan of ours keeps other clients out."""
        session = self.server.session
        if session is not None:
            return max(0.0, self._used_at + IDLE_CLOSE - now) if self._is_kept(session.path) else 0.0
        return max(0.0, self._used_at + MAYBE_OPEN_CLOSE - now) if self.server.maybe_open else inf

    def _is_kept(self, path: bytes) -> bool:
        """Return whether a file stays open a moment longer: not in flight, if nobody has it open here."""
        return not self.server.vehicle.armed or any(user.path == path for user in self.users)

    async def close(self) -> None:
        """Terminate the session, best effort: a server forgets it by itself, sooner or later. The caller
        bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_maybe_open()
