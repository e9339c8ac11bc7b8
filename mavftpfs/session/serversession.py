"""The server's one session: its states, opening and closing, and remedies when it is taken. Layer: session.

One task, the scheduler's, opens, uses and closes it. Everybody's requests pass here, so that
nothing is sent while a remedy wants silence.

Servers refuse an open while a session is (still) taken: with NAK 5 (PX4), 4 (ArduPilot, another id) or 1
(ArduPilot, the same id). ArduPilot refuses all other requests with 4, too (docs/servers.md 1). Asking again
soon keeps a stale session alive. So there is one list of remedies: close what may be ours, be silent, reset
if nobody else was heard. After those it is busy.

Whoever is about to change a path claims it: the session is closed if it is open there, and stays off that
path until the claim is given up.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import TypeVar

import trio

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import ListDirectory, OpenFile, Simple, Terminate
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.requests import Operation
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, SessionBusy, SessionLost
from mavftpfs.shared.model import wire_path

SILENCE_ARDUPILOT = 3.5
"""Seconds. ArduPilot lets a session be taken over after 3 s without any reply."""

SILENCE_PX4 = 10.5
"""Seconds. PX4 closes a session 10 s after the last request of anybody on the link."""

SILENCE_PATIENCE = 5.0
"""Seconds to wait for requests under way before falling silent: a long listing keeps nobody else out."""

TERMINATE_LIMIT = 5.0
"""Seconds to wait for a Terminate that is sent for somebody else's sake."""

_LOST_ACKS = 4
"""How often an open is tried again whose ACKs are lost one after the other."""

_SURELY_OPEN = 8.0
"""Seconds in which no server closes an idle session (PX4 does after 10)."""

_TAKEN = frozenset((NakCode.INVALID_SESSION, NakCode.NO_SESSIONS_AVAILABLE))

T = TypeVar("T")
Remedy = Callable[[FtpNak], Awaitable[bool]]
"""Does something about a refusal; False: it does not apply."""


class State(Enum):
    """What is known of the server's session."""

    CLOSED = "closed"
    OPENING = "opening"
    OPEN = "open"
    CLOSING = "closing"
    UNSURE = "unsure"
    """A file may be open by our doing: a request was not answered, or the session is not believed any more.
    """


NEXT: dict[State, frozenset[State]] = {
    # Opening closes first what is unsure; a refusal of the open itself proves that nothing is open.
    State.CLOSED: frozenset((State.OPENING,)),
    State.OPENING: frozenset((State.OPEN, State.CLOSED, State.UNSURE)),
    # Lost, or not believed any more after a silence, a restart, or an answer that nothing explains: UNSURE.
    State.OPEN: frozenset((State.CLOSING, State.UNSURE)),
    State.CLOSING: frozenset((State.CLOSED, State.UNSURE)),
    State.UNSURE: frozenset((State.OPENING, State.CLOSING)),
}
"""All transitions there are."""


@dataclass(frozen=True, slots=True)
class OpenSession:
    """The server's session, open on a file.

    size: in bytes, as the open ACK said; None where it said nothing. opened_at: when that ACK came. writing:
    opened by OpenFileWO or CreateFile. seq: of that ACK. resent: its request was sent more than once.
    """

    path: bytes
    id: int
    size: int | None
    opened_at: float
    writing: bool = False
    seq: int = -1
    resent: bool = False


@dataclass(frozen=True, eq=False)
class _Claim:
    """A path that is about to change. below: with all that lies below it."""

    path: bytes
    below: bool

    def covers(self, path: bytes) -> bool:
        return path == self.path or (self.below and path.startswith(self.path.rstrip(b"/") + b"/"))


class ServerSession:
    """Opens, closes and remembers; lets its user sleep until there is news.

    op_deadline: seconds to wait for a Terminate of whose failure somebody is told.

    Attributes:
        state: see State. session: what is open in the state OPEN.
        unsure: files that may be open over there by our doing, by session id.
        kept_out: whether the last request that needs no session was refused because of somebody else's.
        resets, quiet_periods: how often these remedies were used.
    """

    def __init__(
        self,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        doubt: Doubt,
        clock: Callable[[], float],
        op_deadline: float = 30.0,
    ) -> None:
        self.state = State.CLOSED
        self.session: OpenSession | None = None
        self.unsure: dict[int, bytes] = {}
        self.kept_out = False
        self.resets = self.quiet_periods = 0
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._doubt = doubt
        self._clock = clock
        self._op_deadline = op_deadline
        self._server_assigns: bool | None = None
        self._opening: bytes | None = None
        self._claims: list[_Claim] = []
        self._news = trio.Event()
        self._freed = trio.Event()
        self._under_way = 0
        self._silent = 0
        self._traffic_changed = trio.Event()

    def check_invariants(self) -> None:
        """Raise AssertionError if the state and what is remembered disagree."""
        assert (self.session is not None) == (self.state is State.OPEN)
        if self.state in (State.CLOSED, State.UNSURE):
            assert bool(self.unsure) == (self.state is State.UNSURE)

    def _enter(self, state: State, session: OpenSession | None = None) -> None:
        assert state in NEXT[self.state], f"{self.state} does not become {state}"
        self.state, self.session = state, session
        self.check_invariants()
        self._freed.set()
        self._freed = trio.Event()

    def _settle(self) -> None:
        """Nothing is open, as far as is known."""
        self._enter(State.UNSURE if self.unsure else State.CLOSED)

    # --- waiting

    def wake(self) -> None:
        """There is news for the user of the session."""
        self._news.set()

    async def sleep(self, seconds: float) -> bool:
        """Wait for news; return False if there was none."""
        with trio.move_on_after(seconds):
            await self._news.wait()
            self._news = trio.Event()
            return True
        return False

    # --- all traffic

    @asynccontextmanager
    async def traffic(self) -> AsyncIterator[None]:
        """Hold this while requests may be on the wire; it waits while nothing is to be said."""
        while self._silent:
            await self._traffic_changed.wait()
        self._under_way += 1
        try:
            yield
        finally:
            self._under_way -= 1
            self._tell_traffic()

    async def run(self, operation: Operation) -> None:
        """Carry out an operation that needs no open file of its own.

        Raises:
            What it fails with.
        """
        async with self.traffic():
            await self._driver.run(operation)

    async def get_through(self, attempt: Callable[[], Awaitable[T]], *, changes: bool = False) -> T:
        """Do something that another client's session may keep out (ArduPilot), after silences if need be.

        changes: a refusal of what was sent twice may answer the second execution, and is the caller's news.

        Raises:
            SessionBusy: it did not go away. Else what `attempt` raises.
        """

        def is_taken(nak: FtpNak) -> bool:
            return nak.code in _TAKEN and self.session is None and not (changes and nak.retransmitted)

        try:
            result = await self._insist(attempt, is_taken, self._silences())
        except SessionBusy:
            self.kept_out = True
            raise
        self.kept_out = False
        return result

    # --- opening

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close what is open and open another file, by OpenFileRO, OpenFileWO or CreateFile.

        Raises:
            FtpNak: the server refused. SessionBusy: its session stayed taken. RequestTimeout. What `close`
                raises of a file that was written to; that a file which was only read could not be closed is
                no news to whoever opens the next.
        """
        self._opening = path  # from now on nobody may change that name, also while the other file is closed
        try:
            if self.session is not None:
                close = self.close if self.session.writing else self.close_quietly
                await close()
            self._enter(State.OPENING)
            try:
                session = await self._open_by_remedies(path, opcode)
            except BaseException:
                self._settle()
                raise
            self._enter(State.OPEN, session)
        finally:
            self._opening = None
        return session

    async def _open_by_remedies(self, path: bytes, opcode: Opcode) -> OpenSession:
        await self._close_maybe_open()
        resent = False

        async def attempt() -> OpenSession:
            nonlocal resent
            try:
                return await self._ask_to_open(path, opcode)
            except FtpNak as nak:
                resent |= nak.retransmitted
                if not self._may_be_ours(nak):
                    self.unsure.clear()
                raise

        remedies = [*[self._close_ours] * _LOST_ACKS, *self._silences(), self._reset]
        session = await self._insist(attempt, self._refuses_as_taken, remedies)
        return replace(session, resent=session.resent or resent)

    async def _ask_to_open(self, path: bytes, opcode: Opcode) -> OpenSession:
        asked = self._engine.home_session
        operation = OpenFile(opcode, wire_path(path), asked)
        # A time-out or a cancellation leaves it unsure: the open may have been carried out.
        self.unsure[0 if self._server_assigns else asked] = path
        await self.run(operation)
        self.unsure.clear()
        self._server_assigns = operation.session != asked
        self._engine.session = operation.session
        return OpenSession(
            path,
            operation.session,
            operation.size,
            self._clock(),
            writing=opcode != Opcode.OPEN_FILE_RO,
            seq=operation.reply.seq,
            resent=operation.retransmitted,
        )

    def _refuses_as_taken(self, nak: FtpNak) -> bool:
        """Whether an open was refused because something is open.

        NAK 8 may hide any other code on PX4 (sticky EEXIST), and makes no sense as an answer to an open.
        ArduPilot's 1 may mean that the session is open under our id, by an open whose ACK was lost; else it
        is a plain failure.
        """
        if nak.code in _TAKEN or nak.code == NakCode.FILE_EXISTS:
            return True
        taken = nak.code == NakCode.FAIL and self._may_be_ours(nak) and self._server_assigns is not True
        if not taken:
            self.unsure.clear()
        return taken

    def _may_be_ours(self, nak: FtpNak) -> bool:
        """Whether an open of ours may have been carried out before this refusal: its ACK was lost, or the
        network brought an older one once more."""
        return nak.retransmitted or (self._doubt.active and not self._others_heard())

    # --- closing

    async def close(self, limit: float | None = None) -> bool:
        """Terminate; return False if the server had closed it before, by itself.

        A session that is not there counts as closed by us if we had to ask twice, within a time in which no
        server closes an idle one: the first request did it. limit: seconds to wait for the answer; None: as
        for any request, for somebody is told of a failure.

        Raises:
            FtpNak: closing failed over there. RequestTimeout: no answer; it is unsure now.
        """
        session = self.session
        if session is None:
            return True
        self._forget(session)
        self._enter(State.CLOSING)
        try:
            return await self._terminate(session, self._op_deadline if limit is None else limit)
        finally:
            self._settle()

    async def _terminate(self, session: OpenSession, limit: float) -> bool:
        operation = Terminate(session.id)
        asked_at = self._clock()
        try:
            with trio.fail_after(limit):
                await self.run(operation)
        except trio.TooSlowError:
            self._vehicle.note_timeout()
            raise RequestTimeout("no answer to TerminateSession") from None
        except FtpNak as nak:
            self.unsure.pop(session.id, None)
            if nak.code != NakCode.FILE_EXISTS:  # PX4's sticky errno for "no such session"
                raise
            operation.already_closed = True
        self.unsure.pop(session.id, None)
        if not operation.already_closed:
            return True
        return operation.retransmitted and self._clock() - asked_at < _SURELY_OPEN

    async def close_quietly(self) -> bool:
        """Close after a failure that is already being reported, or for somebody else's sake."""
        try:
            return await self.close(TERMINATE_LIMIT)
        except MavftpfsError:
            return False

    async def close_unsure(self) -> None:
        """Close what may still be open by our doing; a failure leaves it unsure."""
        if self.state is not State.UNSURE:
            return
        self._enter(State.CLOSING)
        try:
            await self._close_maybe_open()
        except MavftpfsError:
            return
        finally:
            self._settle()

    async def _close_maybe_open(self) -> bool:
        """Close what may be open by our doing, but not what another client may own; return whether something
        was closed, or was not there.

        Raises:
            RequestTimeout: no answer; it is as unsure as before.
        """
        closed = False
        for session in list(self.unsure):
            if session != 0 or not self._others_heard():
                await self._tolerate(partial(self._terminate_by_id, session))
                closed = True
            self.unsure.pop(session, None)
        return closed

    async def _terminate_by_id(self, session: int) -> None:
        """Terminate by the id we asked for, and by 0 where the server may have given us that instead."""
        operation = Terminate(session)
        await self.run(operation)
        if operation.already_closed and session and self._server_assigns is None and not self._others_heard():
            await self.run(Terminate(0))

    async def made_room(self, path: bytes) -> bool:
        """Close another file that was only read; return whether there was one and it is closed."""
        if self.session is None or self.session.writing or self.session.path == path:
            return False
        return await self.close_quietly()

    def require(self, session: OpenSession) -> None:
        """Raise SessionLost if this one is not believed in any more."""
        if self.session is not session:
            raise SessionLost("the vehicle restarted, or opened another file", by_server=True)

    def abandon(self) -> None:
        """What is open is lost, or not to be believed: it is closed before the next open."""
        if self.session is not None:
            self._forget(self.session)
            self._enter(State.UNSURE)
        self.wake()

    def _forget(self, session: OpenSession) -> None:
        self.unsure[session.id] = session.path
        self._engine.session = self._engine.home_session

    def forget_server(self) -> None:
        """The vehicle restarted. What is unsure stays so: the news may come after it was opened anew."""
        self.abandon()
        self._server_assigns = None
        self._engine.session = self._engine.home_session

    # --- remedies

    async def _insist(
        self,
        attempt: Callable[[], Awaitable[T]],
        is_taken: Callable[[FtpNak], bool],
        remedies: list[Remedy],
    ) -> T:
        """Return what `attempt` returns; each time it is refused as taken comes the next remedy that applies.

        Raises:
            SessionBusy: there is none left. Else what `attempt` raises.
        """
        while True:
            try:
                return await attempt()
            except FtpNak as nak:
                if not is_taken(nak):
                    raise
                refusal = nak
            while remedies:
                if await remedies.pop(0)(refusal):
                    break
            else:
                if refusal.code == NakCode.FAIL:
                    raise refusal
                raise SessionBusy("the vehicle's only FTP session is in use by another client") from refusal

    def _silences(self) -> list[Remedy]:
        return [partial(self._be_silent, seconds) for seconds in (SILENCE_ARDUPILOT, SILENCE_PX4)]

    async def _close_ours(self, nak: FtpNak) -> bool:
        if nak.code == NakCode.FILE_EXISTS:  # a listing that comes to its end clears the sticky errno
            return await self._tolerate(lambda: self.run(ListDirectory(b"/", False)))
        return self._may_be_ours(nak) and await self._close_maybe_open()

    async def _be_silent(self, seconds: float, nak: FtpNak) -> bool:
        if nak.code == NakCode.FAIL:
            return False
        self._silent += 1
        try:
            with trio.move_on_after(SILENCE_PATIENCE):
                while self._under_way:
                    await self._traffic_changed.wait()
            silent = not self._under_way
            if silent:
                self.quiet_periods += 1
                await trio.sleep(seconds)
        finally:
            self._silent -= 1
            self._tell_traffic()
        return silent

    async def _reset(self, nak: FtpNak) -> bool:
        if nak.code == NakCode.FAIL or self._others_heard():
            return False
        self.resets += 1
        reset = Simple(Opcode.RESET_SESSIONS, b"", session=self._engine.home_session, side_effect=True)
        return await self._tolerate(lambda: self.run(reset))

    async def _tolerate(self, step: Callable[[], Awaitable[None]]) -> bool:
        """Run a remedy whose refusal changes nothing; a time-out is the caller's news."""
        try:
            await step()
        except RequestTimeout:
            raise
        except MavftpfsError:
            return True
        return True

    def may_be_ours(self, session: int) -> bool:
        """Return whether an id may be that of our session: always, but where clients choose their ids."""
        return self._server_assigns is not False or session == self._engine.home_session

    def _others_heard(self) -> bool:
        return self._vehicle.foreign_client(self._clock())

    def _tell_traffic(self) -> None:
        self._traffic_changed.set()
        self._traffic_changed = trio.Event()

    # --- claims

    def claimed(self, path: bytes) -> bool:
        """Whether somebody changes this path now."""
        return any(claim.covers(path) for claim in self._claims)

    @asynccontextmanager
    async def claim(self, path: bytes, *, below: bool = False) -> AsyncIterator[None]:
        """Keep the session off a path for the length of the body; below: off all that lies below it, too.

        Raises:
            RequestTimeout: it could not be closed in time.
        """
        claim = _Claim(path, below)
        self._claims.append(claim)
        try:
            with trio.move_on_after(self._op_deadline) as scope:
                while any(claim.covers(busy) for busy in self._busy()):
                    self.wake()
                    await self._freed.wait()
            if scope.cancelled_caught:
                raise RequestTimeout("our own session on this path could not be closed")
            yield
        finally:
            self._claims.remove(claim)
            self.wake()

    async def honour_claims(self) -> None:
        """Close what is open, or may be open, on claimed paths; errors are the claimer's time-out."""
        if self.session is not None and self.claimed(self.session.path):
            await self.close_quietly()
        if any(self.claimed(path) for path in self.unsure.values()):
            await self.close_unsure()

    def _busy(self) -> list[bytes]:
        open_path = None if self.session is None else self.session.path
        return [path for path in (open_path, self._opening, *self.unsure.values()) if path is not None]
