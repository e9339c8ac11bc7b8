"""Gives the one server session to one user after another. Layer: session.

One task (`serve`) gives turns; readers, uploads and single requests only say what they want and wake it.

Whoever used little of it lately (an editor, `head`) goes before whoever used much (a copy), at once. Those
who used much take turns of a second or more, since changing files costs round trips. Whoever waited for long
goes first all the same: one small file after another slows a copy down, and does not stop it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from math import inf
from typing import Literal

import trio

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.reading import ReadToEof
from mavftpfs.protocol.writing import Pieces, WriteTransfer
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.others import OPENING, took_session
from mavftpfs.session.serversession import OpenSession, ServerSession, State
from mavftpfs.shared.errors import DataUnproven, MavftpfsError, RequestTimeout, SessionBusy, SessionLost
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
of an upload again takes up to four round trips."""

RELIEF = 0.5
"""Seconds that whoever waited so long keeps what he got."""

RECENT = 10.0
"""Seconds for which what was read stays provisional, also of files that were closed since: another client is
noticed late, because servers answer it on its own link, and a router may pass on only some of that."""

IDLE_CLOSE = 1.5
"""Seconds a file stays open on the server without being read. Below the 2 s after which PX4 frees its
buffers and the 3 s after which ArduPilot gives the session away: so a session is never doubtful."""

_MAYBE_OPEN_RETRY = 5.0
_OFTEN = 0.25

Action = Callable[[OpenSession], Awaitable[None]]


class SessionUser(ABC):
    """Somebody who wants the session now and then: a reader, an upload, a single request.

    Attributes:
        path: of the file it uses.
        asked_at: when it began to wait for its turn; None while it wants nothing (an upload keeps its
            last). It stays set in the turn.
    """

    def __init__(self, path: bytes, scheduler: Scheduler, asked_at: float | None = None) -> None:
        self.path = path
        self.asked_at = asked_at
        self._scheduler = scheduler
        self._server = scheduler.server
        self._used = 0.0
        self._until = 0.0
        scheduler.users[self] = None
        scheduler.server.wake()

    @abstractmethod
    def due_at(self) -> float:
        """Return when it can use the session: 0 for now, inf if nothing is wanted that somebody waits for."""

    @abstractmethod
    async def turn(self) -> None:
        """Use the session now. What fails is told to whoever waits."""

    @abstractmethod
    def fail(self, error: MavftpfsError) -> None:
        """Tell whoever waits that what it wants cannot be had now."""

    def prefetches(self) -> bool:
        """Return whether it wants something that nobody waits for."""
        return False

    def goes_on(self, session: OpenSession) -> bool:
        """Return whether it uses what is open and opens nothing."""
        return False

    def expire(self, error: MavftpfsError) -> None:
        """It waited too long. Who asks again waits anew."""
        self.asked_at = None
        self.fail(error)

    def on_queued(self) -> None:
        """It waits for its turn, and the vehicle answered in another's."""
        return

    def on_removed(self) -> None:
        """The file of its path was removed or replaced."""
        return

    def on_suspect(self, reason: str) -> None:
        """What was read lately may be another file's."""
        return

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


class _Job(SessionUser):
    """One open, an action, one Terminate."""

    def __init__(self, path: bytes, scheduler: Scheduler, opcode: Opcode, action: Action | None) -> None:
        super().__init__(path, scheduler, scheduler.clock())
        self.session: OpenSession | None = None
        self.error: MavftpfsError | None = None
        self.finished = trio.Event()
        self._opcode = opcode
        self._action = action

    def due_at(self) -> float:
        """See SessionUser."""
        return inf if self.finished.is_set() else 0.0

    def fail(self, error: MavftpfsError) -> None:
        """See SessionUser."""
        self.error = error
        self.finished.set()

    async def turn(self) -> None:
        """See SessionUser."""
        server = self._server
        try:
            # It may have died, or been armed, while others had the session.
            server.vehicle.require(server.clock(), writing=self._opcode != Opcode.OPEN_FILE_RO)
            self.session = await server.open(self.path, self._opcode)
            if self._action is not None:
                await self._action(self.session)
            await server.close()
        except MavftpfsError as error:
            self.error = error
            await server.close_quietly()
        finally:
            self.finished.set()


class Scheduler:
    """Serialises all use of the server session.

    op_deadline: seconds after which who waits for the session is told that it is not to be had.
    chunk: bytes that a request carries, 1..239; None: see ChunkSize.

    Attributes:
        users: those who want the session, now or later. gone: those who read, and want nothing any more,
            with the time since when.
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
        self.doubt = Doubt(clock, self._on_reads_doubted)
        self.server = ServerSession(driver, self.doubt, clock, op_deadline)
        self.clock = clock
        self.users: dict[SessionUser, None] = {}
        self.gone: deque[tuple[float, SessionUser]] = deque()
        self._driver = driver
        self._op_deadline = op_deadline
        self._used_at = clock()
        self._touched_at = -inf
        driver.engine.on_unexplained = self._on_unexplained

    # --- who wants the session

    def remove(self, user: SessionUser) -> None:
        """It wants nothing any more; harmless if that is known."""
        self.users.pop(user, None)
        self.server.wake()

    def waiting(self, now: float) -> list[SessionUser]:
        """Return all who wait for the session and could use it now."""
        waiting = []
        for user in self.users:
            if user.due_at() <= now and self._may_use(user, now):
                waiting.append(user)
        return waiting

    def _may_use(self, user: SessionUser, now: float) -> bool:
        """Return whether nothing keeps it from its file: a change of names, or another client's open file."""
        if self.server.is_excluded(user.path):
            return False
        session = self.server.session
        return now >= self.held_until or (session is not None and user.goes_on(session))

    @property
    def held_until(self) -> float:
        """Before this nothing is opened: that might end another client's session."""
        several = self._driver.engine.traits.several_sessions
        return -inf if several else self.server.others.file_open_until

    def first(self) -> SessionUser | None:
        """Return whoever is to use the session now. Readahead comes only if nobody waits for anything, and
        that of the open file first."""
        now, rtt = self.clock(), self._driver.engine.rtt
        first, best = None, (True, inf)
        for user in self.waiting(now):
            rank = user.rank(now, rtt)
            if first is None or rank < best:
                first, best = user, rank
        if first is not None:
            return first
        session = self.server.session
        for user in self.users:
            if user.prefetches() and self._may_use(user, now):
                if session is not None and user.path == session.path:
                    return user
                first = first or user
        return first

    def rival_use(self, user: SessionUser) -> float | None:
        """Return how much the lightest of the others who wait used lately (seconds); None if nobody waits."""
        now = self.clock()
        least: float | None = None
        for other in self.waiting(now):
            if other is not user and (least is None or other.used(now) < least):
                least = other.used(now)
        return least

    def expire_waiters(self) -> None:
        """Somebody holds the session and cannot be interrupted: do not let others wait for ever."""
        now = self.clock()
        error = RequestTimeout("the vehicle's only session is taken by an upload that cannot be interrupted")
        for user in self.waiting(now):
            if user.asked_at is not None and user.asked_at < now - self._op_deadline:
                user.expire(error)

    def expire_held(self) -> float:
        """Tell the users that wait too long for another client's file to be closed; return when the next one
        will have done so."""
        now, next_at = self.clock(), inf
        if now >= self.held_until:
            return next_at
        error = SessionBusy("another client of the vehicle may have a file open, which is not ended for ours")
        for user in list(self.users):  # who is told may end
            if user.due_at() > now or user.asked_at is None or self._may_use(user, now):
                continue
            expires_at = user.asked_at + self._op_deadline
            if now >= expires_at:
                user.expire(error)
            else:
                user.on_queued()
                next_at = min(next_at, expires_at)
        return next_at

    # --- what others ask for

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read a file to EOF whatever its size claims; once more if the session was lost or in doubt.

        Raises:
            DataUnproven: another FTP client may have used the session each time, so that the bytes may be
                another file's. Else as use_session.
        """
        data = b""

        async def read(session: OpenSession) -> None:
            nonlocal data
            began = self.clock()
            operation = ReadToEof(session.id, self.read_chunks.size, limit)
            await self._driver.run(operation)
            if self.server.session is not session:
                raise SessionLost("the vehicle restarted, or opened another file", by_server=True)
            if self.doubt.reads_arose_since(began):
                raise DataUnproven(f"another FTP client was active while {path!r} was read")
            data = operation.data

        try:
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        except (SessionLost, DataUnproven):
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        return data

    async def write_whole(
        self, path: bytes, pieces: Sequence[bytes], progress: Callable[[int], None] | None = None
    ) -> None:
        """See cache.remote.VehicleStore."""
        server, size = self.server, min(self.read_chunks.size, self.write_chunks.size)

        async def write(session: OpenSession) -> None:
            transfer = WriteTransfer(
                session.id, Pieces(pieces, progress), ChunkSize(size), in_flight=1, on_starved=server.wake
            )
            try:
                await self._driver.start(transfer, server.wake)
                while not transfer.done and not transfer.starved:
                    if server.session is not session:
                        raise SessionLost("the vehicle restarted, or opened another file", by_server=True)
                    server.vehicle.require(self.clock(), writing=True)
                    self._driver.kick()
                    await server.sleep(_OFTEN)
                if transfer.error is not None:
                    raise transfer.error
            finally:
                transfer.finish()
                self._driver.cancel(transfer)

        await self.use_session(path, Opcode.CREATE_FILE, write)

    async def use_session(self, path: bytes, opcode: Opcode, action: Action | None = None) -> OpenSession:
        """Open a file, do something, terminate; returns what the open ACK said.

        Raises:
            VehicleLost, RequestTimeout, or what opening, the action or closing fail with.
        """
        self.server.vehicle.require(self.clock())
        job = _Job(path, self, opcode, action)
        try:
            await job.finished.wait()
        finally:
            self.remove(job)
        if job.error is not None:
            raise job.error
        assert job.session is not None
        return job.session

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """A file or directory was renamed: who reads or writes it, or in it, goes on under the new path. What
        had the new name cannot be read any more."""
        for user in list(self.users):  # who is told may close it
            if user.path == new:
                user.on_removed()
            elif not isinstance(user, _Job):
                user.path = renamed(user.path, old, new)

    def on_removed(self, path: bytes) -> None:
        """The file of this name was removed or replaced: what its readers still want cannot be had."""
        for user in list(self.users):  # who is told may close it
            if user.path == path:
                user.on_removed()

    # --- news

    def on_foreign(self, payload: bytes, *, newcomer: bool) -> None:
        """Another FTP client's payload was heard. newcomer: the first for a while, so earlier ones may have
        been missed."""
        now, engine = self.clock(), self._driver.engine
        session = self.server.others.hear(payload, now)
        echoes = engine.traits.ack_carries_own_session  # then each client has an id of its own
        if session is not None and (not echoes or session == engine.home_session):
            self._touched_at = now
        # Whoever uses sessions may just have used ours, too, in a request that was not heard.
        reads = newcomer or now - self._touched_at <= RECENT
        self.doubt.raise_it("another FTP client is active", reads=reads)
        if not echoes and self.server.session is not None and took_session(payload):
            self.server.abandon()  # what we read or write would be its file
        self.server.wake()

    def _on_unexplained(self, reply: Payload, late: float) -> None:
        """An answer came that no request of ours explains. An older open that was carried out once more may
        have put its file in the place of ours (MAVSDK); all else is no other file's."""
        session = self.server.session
        opens = reply.opcode == Opcode.ACK and reply.req_opcode in OPENING
        other = opens and session is not None and session.seq != reply.seq
        self.doubt.late.saw(late, self.clock())
        self.doubt.raise_it("an answer came that no request of ours explains", reads=other)
        if other:
            self.server.abandon()

    def _on_reads_doubted(self, reason: str) -> None:
        """What was read lately is provisional, also of files closed since."""
        for user in [*self.users, *(user for _, user in self.gone)]:
            user.on_suspect(reason)

    def on_reboot(self) -> None:
        """The vehicle restarted, perhaps as another one: nothing is open, nothing is known of it."""
        self.doubt.raise_it("the vehicle restarted")
        self.server.abandon()

    # --- the one task

    async def serve(self) -> None:
        """Run until cancelled."""
        server = self.server
        while True:
            await trio.lowlevel.checkpoint()
            await server.close_excluded()
            user, session, began = self.first(), server.session, self.clock()
            try:
                if user is None:
                    await self._idle(began)
                    continue
                if session is not None and session.path != user.path and not session.writing:
                    await server.close_quietly()
                    continue  # somebody may have come meanwhile who goes first
                await user.turn()
            except MavftpfsError:
                # Closing the previous file failed; whoever wants something is asked again.
                server.abandon()
            self._used_at = self.clock()
            if self._driver.last_reply_at >= began:
                # The vehicle answered in this turn: who waits for a later one is not timed out.
                for other in list(self.users):
                    if other is not user and other.due_at() < inf:
                        other.on_queued()

    async def _idle(self, now: float) -> None:
        """Nobody can use the session now: close it in time, and wait for news."""
        server = self.server
        expires_at = self.expire_held()
        if expires_at < inf:
            await server.find_out_sessions()
        until_due = expires_at - now
        for user in self.users:
            due = max(user.due_at(), self.held_until)
            if now < due:
                until_due = min(until_due, due - now)
        if server.session is not None:
            # Counted from the last use, not from the last news: there may always be news.
            left = max(0.0, self._used_at + IDLE_CLOSE - now)
            if not await server.sleep(min(left, until_due)) and self.first() is None:
                await server.close()
        elif server.state is State.MAYBE_OPEN and not server.vehicle.lost(now):
            # An open or a Terminate that was never answered: leave no orphan over there.
            if not await server.sleep(min(_MAYBE_OPEN_RETRY, until_due)):
                await server.close_maybe_open()
        else:
            await server.sleep(until_due)

    async def close(self) -> None:
        """Terminate the session, best effort: a server forgets it by itself, sooner or later. The caller
        bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_maybe_open()
