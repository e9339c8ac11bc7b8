"""Opening and closing the one server session, and what to do when it is taken. Layer: session.

Servers refuse an open while a session is (still) taken with NAK 5 (PX4), 4 (ArduPilot, another id) or 1
(ArduPilot, the same id); ArduPilot refuses all other requests with 4, too (docs/servers.md 1). Asking again
soon keeps a stale session alive. So there is one list of remedies: close what may be ours, say nothing for a
while, reset if nobody else was heard. Then it is busy.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
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
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, SessionBusy
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


class Opener:
    """Opens, closes, and gets requests through when the session is taken.

    Attributes:
        unsure: files that may be open over there by our doing, by session id.
        resets, quiet_periods: how often these remedies were used.
    """

    def __init__(
        self,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        doubt: Doubt,
        clock: Callable[[], float],
    ) -> None:
        self.unsure: dict[int, bytes] = {}
        self.resets = 0
        self.quiet_periods = 0
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._doubt = doubt
        self._clock = clock
        self._server_assigns: bool | None = None
        self._inside = 0
        self._silent = 0
        self._changed = trio.Event()

    # --- all traffic passes here

    @asynccontextmanager
    async def passing(self) -> AsyncIterator[None]:
        """Hold this while requests may be on the wire; it waits while nothing is to be said."""
        while self._silent:
            await self._changed.wait()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1
            self._notify()

    async def run(self, operation: Operation) -> None:
        """Carry out an operation that needs no open file of its own.

        Raises:
            What it fails with.
        """
        async with self.passing():
            await self._driver.run(operation)

    async def outlast(self, attempt: Callable[[], Awaitable[T]], is_taken: Callable[[FtpNak], bool]) -> T:
        """Do something that needs no session, but that somebody else's may keep out.

        Raises:
            SessionBusy: it was refused after each silence, too. Else what `attempt` raises.
        """
        return await self._insist(attempt, is_taken, self._silences())

    # --- opening and closing

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Open a file by OpenFileRO, OpenFileWO or CreateFile.

        Raises:
            FtpNak: the server refused. SessionBusy: its session stayed taken. RequestTimeout.
        """
        await self.close_unsure()
        resent = False

        async def attempt() -> OpenSession:
            nonlocal resent
            try:
                return await self._open(path, opcode)
            except FtpNak as nak:
                resent |= nak.retransmitted
                if not self._may_be_ours(nak):
                    self.unsure.clear()
                raise

        remedies = [*[self._close_ours] * _LOST_ACKS, *self._silences(), self._reset]
        session = await self._insist(attempt, self._refuses_as_taken, remedies)
        return replace(session, resent=session.resent or resent)

    async def _open(self, path: bytes, opcode: Opcode) -> OpenSession:
        asked = self._engine.home_session
        operation = OpenFile(opcode, wire_path(path), asked)
        # A time-out or a cancellation leaves it unsure: the open may have been carried out.
        self.unsure[self._own_id] = path
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

    async def close(self, session: OpenSession, limit: float = TERMINATE_LIMIT) -> bool:
        """Terminate and check the answer; return False if the server had closed it before, by itself.

        A session that is not there counts as closed by us if we had to ask twice, within a time in which no
        server closes an idle one: the first request did it. limit: seconds to wait for an answer.

        Raises:
            FtpNak: closing failed over there. RequestTimeout: no answer; it is unsure now.
        """
        self.abandon(session)
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

    def abandon(self, session: OpenSession) -> None:
        """Stop believing in a session: it is closed before the next open."""
        self.unsure[session.id] = session.path
        self._engine.session = self._engine.home_session

    def forget_server(self) -> None:
        """The server restarted. What is unsure stays so: the news may come after it was opened anew."""
        self._server_assigns = None
        self._engine.session = self._engine.home_session

    async def close_unsure(self) -> bool:
        """Close what may be open by our doing, but not what another client may own; return whether something
        was closed, or was not there.

        Raises:
            RequestTimeout: no answer; it is as unsure as before.
        """
        closed = False
        for session in list(self.unsure):
            if session != 0 or not self._others_heard():
                await self._tolerate(partial(self._terminate, session))
                closed = True
            self.unsure.pop(session, None)
        return closed

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

    async def _close_ours(self, nak: FtpNak) -> bool:
        if nak.code == NakCode.FILE_EXISTS:  # a listing that comes to its end clears the sticky errno
            return await self._tolerate(lambda: self.run(ListDirectory(b"/", False)))
        return self._may_be_ours(nak) and await self.close_unsure()

    async def _be_silent(self, seconds: float, nak: FtpNak) -> bool:
        if nak.code == NakCode.FAIL:
            return False
        self._silent += 1
        try:
            with trio.move_on_after(SILENCE_PATIENCE):
                while self._inside:
                    await self._changed.wait()
            silent = not self._inside
            if silent:
                self.quiet_periods += 1
                await trio.sleep(seconds)
        finally:
            self._silent -= 1
            self._notify()
        return silent

    async def _reset(self, nak: FtpNak) -> bool:
        if nak.code == NakCode.FAIL or self._others_heard():
            return False
        self.resets += 1
        reset = Simple(Opcode.RESET_SESSIONS, b"", session=self._engine.home_session, side_effect=True)
        return await self._tolerate(lambda: self.run(reset))

    async def _terminate(self, session: int) -> None:
        """Terminate by the id we asked for, and by 0 where the server may have given us that instead."""
        operation = Terminate(session)
        await self.run(operation)
        if operation.already_closed and session and self._server_assigns is None and not self._others_heard():
            await self.run(Terminate(0))

    async def _tolerate(self, step: Callable[[], Awaitable[None]]) -> bool:
        """Run a remedy whose refusal changes nothing; a time-out is the caller's news."""
        try:
            await step()
        except RequestTimeout:
            raise
        except MavftpfsError:
            return True
        return True

    @property
    def _own_id(self) -> int:
        """The id under which a file that we asked for is open over there."""
        return 0 if self._server_assigns is True else self._engine.home_session

    def _others_heard(self) -> bool:
        return self._vehicle.foreign_client(self._clock())

    def _notify(self) -> None:
        self._changed.set()
        self._changed = trio.Event()
