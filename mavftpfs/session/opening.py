"""Opening and closing the one server session, with what to do when it is taken. Layer: session.

Servers answer an open while a session is (still) taken with NAK 5 (PX4), 4 (ArduPilot, another id) or 1
(ArduPilot, the same id). Asking again soon keeps a stale session alive (servers.md 1), so the remedies
are: close what may be our own, then silence, then, if nobody else is about, ResetSessions.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from functools import partial

import trio

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import ListDirectory, OpenFile, Simple, Terminate
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.driver import Driver
from mavftpfs.session.echoes import feared_for
from mavftpfs.session.gate import Gate
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, SessionBusy
from mavftpfs.shared.model import wire_path

SILENCE_ARDUPILOT = 3.5
"""ArduPilot lets a session be taken over after 3 s without any reply."""

SILENCE_PX4 = 10.5
"""PX4 closes a session 10 s after the last request of anybody on the link."""

GATE_PATIENCE = 5.0
"""Seconds to wait for requests under way before falling silent."""

_MAX_FAILING = 256
_MAX_OPENED = 64
_MAX_EARLY = 16

_MORE_LOST_ACKS = 3
"""How often an open is tried again whose ACKs are lost, one after the other, before that is called busy."""

TERMINATE_LIMIT = 5.0
"""Seconds to wait for a Terminate before the session is treated as doubtful."""

_FEARED_ON_LEAVING = 3.0
"""Most seconds to wait on leaving for an open that the network brings once more."""

_SURELY_OPEN = 8.0
"""Seconds in which no server closes an idle session (PX4 does after 10)."""


@dataclass(frozen=True, slots=True)
class OpenSession:
    """The server's session, open on a file. size: as the open ACK said, None where it said nothing. seq: of
    that ACK. repeated: the request was sent more than once."""

    path: bytes
    id: int
    size: int | None
    opened_at: float
    writing: bool = False
    seq: int = -1
    repeated: bool = False


class SessionOpener:
    """Opens and closes; knows whether something of ours may still be open over there."""

    def __init__(
        self, driver: Driver, engine: Engine, vehicle: Vehicle, gate: Gate, clock: Callable[[], float]
    ) -> None:
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._gate = gate
        self._clock = clock
        self._doubtful: dict[int, bytes] = {}
        self._reopened: dict[int, bytes] = {}
        self._opened: dict[int, bytes] = {}
        self._disturbed: set[int] = set()
        self._early: set[tuple[int, int]] = set()
        self._server_assigns: bool | None = None
        self._failing: dict[bytes, None] = {}
        self._asked_at = float("-inf")
        self.resets = 0
        self.quiet_periods = 0

    @property
    def doubtful_paths(self) -> list[bytes]:
        """The files that may still be open over there by our doing."""
        return [*self._doubtful.values(), *self._reopened.values()]

    def opened_by(self, seq: int) -> bytes | None:
        """Return which file an open was to open whose answers have this seq, None if there was none."""
        return self._opened.get(seq)

    def note_early(self, seq: int, session: int) -> None:
        """An open was answered once more that is not known: the one under way may have been, at once."""
        if len(self._early) < _MAX_EARLY:
            self._early.add((seq, session))

    def leave_open(self, session: int, path: bytes) -> None:
        """An open came to the server once more: what it opened there is to be closed."""
        self._disturbed.add(session)
        self._reopened[session] = path

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Open a file: OpenFileRO, OpenFileWO or CreateFile.

        Raises:
            FtpNak: the server refused. SessionBusy: its session stayed taken. RequestTimeout.
        """
        if self.doubtful_paths:
            await self._close_doubtful()
        remedies = [self._close_own, *[self._close_again] * _MORE_LOST_ACKS, self._fall_silent, self._reset]
        last: FtpNak | None = None
        repeated = False
        while True:
            try:
                session = await self._open_undisturbed(path, opcode)
                return replace(session, repeated=session.repeated or repeated)
            except FtpNak as nak:
                last, repeated = nak, repeated or nak.retransmitted
                if not self._looks_taken(nak, path):
                    raise
            while remedies:
                if await remedies.pop(0)(last):
                    break
            else:
                if last.code == NakCode.FAIL:
                    self._remember_failing(path)
                    raise last
                raise SessionBusy("the vehicle's only FTP session is in use by another client")

    @property
    def may_peek(self) -> bool:
        """Whether `peek` harms nobody and proves something: Terminate names a session that can only be ours,
        and what goes out in a row comes in a row."""
        if self._server_assigns is not False or self._engine.stats.strays or self.doubtful_paths:
            return False
        return not self._vehicle.foreign_client(self._clock())

    async def peek(self, path: bytes) -> int | None:
        """Return a file's size as the ACK to OpenFileRO says, whose Terminate goes out right behind it: that
        is a round trip less. Only where `may_peek`.

        Raises:
            As open.
        """
        session = self._engine.home_session
        opening, closing = OpenFile(Opcode.OPEN_FILE_RO, wire_path(path), session), Terminate(session)
        self._doubt(session, path)
        try:
            async with self._gate.passing():
                await self._driver.run(opening, closing)
        except FtpNak as nak:
            if opening.error is not None and not self._looks_taken(nak, path):
                raise
        finally:
            self._note_asked(opening, path)
        if opening.error is not None:
            return (await self.open(path)).size
        in_order = not opening.retransmitted and opening.progress_at <= closing.progress_at
        if in_order and closing.error is None and opening.session == session:
            self._trust(session)
        else:  # it may have come after its Terminate: the next open closes it first
            self._doubt(opening.session, path)
        return opening.size

    async def close(self, session: OpenSession, limit: float = TERMINATE_LIMIT) -> bool:
        """Terminate and check the answer; return False if the server had closed it before, by itself.

        A session that is not there counts as closed by us if we had to ask twice, within a time in which no
        server closes an idle one: the first request did it. limit: seconds to wait for an answer.

        Raises:
            FtpNak: closing failed over there. RequestTimeout: no answer; the next open tries again first.
        """
        self._engine.session = self._engine.home_session
        operation = Terminate(session.id)
        self._doubt(session.id, session.path)
        asked_at = self._clock()
        try:
            with trio.fail_after(limit):
                await self._run(operation)
        except trio.TooSlowError:
            self._vehicle.note_timeout()
            raise RequestTimeout("no answer to TerminateSession") from None
        except FtpNak as nak:
            self._trust(session.id)
            if nak.code != NakCode.FILE_EXISTS:  # PX4's sticky errno for "no such session"
                raise
            operation.already_closed = True
        self._trust(session.id)
        if not operation.already_closed:
            return True
        return operation.retransmitted and self._clock() - asked_at < _SURELY_OPEN

    async def close_doubtful(self) -> None:
        """Close what may still be ours.

        Raises:
            RequestTimeout: no answer.
        """
        await self._close_doubtful()

    async def leave(self) -> None:
        """Close what may still be ours, also what the network may yet have opened once more: where sessions
        have numbers nobody else would close it.

        Raises:
            RequestTimeout: no answer.
        """
        await self._close_doubtful()
        if self._engine.stats.strays and not self._vehicle.lost(self._clock()):
            feared = min(_FEARED_ON_LEAVING, feared_for(self._engine, self._clock()))
            await trio.sleep(max(0.0, self._asked_at + feared - self._clock()))
        while self.doubtful_paths:
            await self._close_doubtful()

    def abandon(self, session: OpenSession) -> None:
        """Stop believing in a session after silence or a reboot; the next open closes it first."""
        self._doubt(session.id, session.path)
        self._engine.session = self._engine.home_session

    def forget(self) -> None:
        """The server restarted. The news may come a second later: what is doubtful may be open since then.
        What was asked before may be carried out yet, too."""
        self._server_assigns = None
        self._engine.session = self._engine.home_session

    def _doubt(self, session: int, path: bytes) -> None:
        self._doubtful[session] = path

    def _trust(self, session: int) -> None:
        self._doubtful.pop(session, None)

    @property
    def _own_id(self) -> int:
        """The id under which a file is open over there that we asked for."""
        return 0 if self._server_assigns is True else self._engine.home_session

    async def _open_undisturbed(self, path: bytes, opcode: Opcode) -> OpenSession:
        """Open; once more where an older open came to the server again meanwhile, perhaps after this one: on
        MAVSDK the session is that file's then."""
        self._disturbed.clear()
        session = await self._open_once(path, opcode)
        if session.id in self._disturbed:
            await self.close(session)
            session = await self._open_once(path, opcode)
        return session

    async def _open_once(self, path: bytes, opcode: Opcode) -> OpenSession:
        asked, expected = self._engine.home_session, self._own_id
        operation = OpenFile(opcode, wire_path(path), asked)
        self._doubt(expected, path)
        self._early.clear()
        # A time-out or cancellation leaves it doubtful: the open may have been executed.
        try:
            await self._run(operation)
        finally:  # also refused or given up: the network may bring it to the server later, or once more
            self._note_asked(operation, path)
        self._trust(expected)
        self._trust(operation.session)
        self._reopened.pop(operation.session, None)
        for early, session in self._early:
            if early in operation.answers and session != operation.session:
                self._reopened[session] = path
        self._server_assigns = operation.session != asked
        self._engine.session = operation.session
        writing = opcode != Opcode.OPEN_FILE_RO
        seq, repeated = operation.reply.seq, operation.retransmitted
        return OpenSession(path, operation.session, operation.size, self._clock(), writing, seq, repeated)

    def _note_asked(self, operation: OpenFile, path: bytes) -> None:
        self._asked_at = self._clock()
        for seq in operation.answers:
            self._opened[seq] = path
        while len(self._opened) > _MAX_OPENED:
            del self._opened[next(iter(self._opened))]

    def _remember_failing(self, path: bytes) -> None:
        """Silence did not help: what fails is this file, and nobody waits for it again."""
        self._failing[path] = None
        if len(self._failing) > _MAX_FAILING:
            del self._failing[next(iter(self._failing))]

    def _looks_taken(self, nak: FtpNak, path: bytes) -> bool:
        """8 may hide any other code on PX4 (sticky EEXIST), and makes no sense as an answer to an open."""
        if nak.code in (NakCode.NO_SESSIONS_AVAILABLE, NakCode.INVALID_SESSION, NakCode.FILE_EXISTS):
            return True
        plain = nak.code != NakCode.FAIL or self._server_assigns is True or path in self._failing
        # Else one of ours may have been executed, and a file be open under our id: ArduPilot's NAK 1.
        if plain or not (nak.retransmitted or self._engine.stats.strays):
            self._trust(self._own_id)
        return not plain

    async def _close_own(self, nak: FtpNak) -> bool:
        """Terminate what may be ours: an open of ours whose ACK was lost, or (8) clear the sticky errno."""
        if nak.code == NakCode.FILE_EXISTS:
            return await self._tolerate(lambda: self._run(ListDirectory(b"/", False)))
        if nak.retransmitted or nak.code == NakCode.FAIL:
            return await self._close_doubtful()
        return False

    async def _close_again(self, nak: FtpNak) -> bool:
        """The ACK of that open was lost, too: what refused its repetition is ours."""
        return nak.retransmitted and nak.code != NakCode.FILE_EXISTS and await self._close_doubtful()

    async def _fall_silent(self, nak: FtpNak) -> bool:
        await self._close_again(nak)
        seconds = (
            SILENCE_PX4
            if nak.code in (NakCode.NO_SESSIONS_AVAILABLE, NakCode.FILE_EXISTS)
            else SILENCE_ARDUPILOT
        )
        async with self._gate.held_shut(GATE_PATIENCE) as silent:
            if silent:
                self.quiet_periods += 1
                await trio.sleep(seconds)
        return silent

    async def _reset(self, nak: FtpNak) -> bool:
        if nak.code == NakCode.FAIL or self._vehicle.foreign_client(self._clock()):
            return False
        self.resets += 1
        reset = Simple(Opcode.RESET_SESSIONS, b"", session=self._engine.home_session, side_effect=True)
        return await self._tolerate(lambda: self._run(reset))

    async def _close_doubtful(self) -> bool:
        """Close what may still be ours, but for what another client may own by now."""
        closed = False
        self._doubtful = self._reopened | self._doubtful
        self._reopened.clear()
        for session, path in list(self._doubtful.items()):
            self._trust(session)
            if session == 0 and self._vehicle.foreign_client(self._clock()):
                continue
            try:
                closed |= await self._tolerate(partial(self._terminate, session))
            except BaseException:
                self._doubtful.setdefault(session, path)  # not answered: as doubtful as before
                raise
        return closed

    async def _terminate(self, session: int) -> None:
        """Terminate by the id we asked for, and by 0 where the server may have given us that instead."""
        operation = Terminate(session)
        await self._run(operation)
        unknown = self._server_assigns is None and not self._vehicle.foreign_client(self._clock())
        if operation.already_closed and session != 0 and unknown:
            await self._run(Terminate(0))

    async def _tolerate(self, step: Callable[[], Awaitable[None]]) -> bool:
        """Run a remedy whose refusal changes nothing; a time-out is the caller's news."""
        try:
            await step()
        except RequestTimeout:
            raise
        except MavftpfsError:
            return True
        return True

    async def _run(self, operation: ListDirectory | OpenFile | Simple | Terminate) -> None:
        async with self._gate.passing():
            await self._driver.run(operation)
