"""The server's one session: its states, and who keeps it off a path. Layer: session.

One task opens, uses and closes it. Whoever is about to change a path claims that path: the session is closed
if it is open there, and stays off it until the claim is given up (our own session on a path is terminated
before the path is removed, renamed, created or truncated).
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

import trio

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.opening import TERMINATE_LIMIT, Opener, OpenSession
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, SessionBusy, SessionLost

_TAKEN = frozenset((NakCode.INVALID_SESSION, NakCode.NO_SESSIONS_AVAILABLE))

T = TypeVar("T")


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
        switches: how often one file made room for another.
        kept_out: whether the last request that needs no session was refused because of somebody else's.
    """

    def __init__(self, opener: Opener, op_deadline: float = 30.0) -> None:
        self.opener = opener
        self.state = State.CLOSED
        self.session: OpenSession | None = None
        self.switches = 0
        self.kept_out = False
        self._op_deadline = op_deadline
        self._path: bytes | None = None  # of what is being opened, while it is
        self._closing: bytes | None = None
        self._claims: list[_Claim] = []
        self._news = trio.Event()
        self._freed = trio.Event()

    def check_invariants(self) -> None:
        """Raise AssertionError if state and books disagree."""
        assert (self.session is not None) == (self.state is State.OPEN)
        assert (self._closing is not None) == (self.state is State.CLOSING)
        if self.state in (State.CLOSED, State.UNSURE):
            assert bool(self.opener.unsure) == (self.state is State.UNSURE)

    def _enter(self, state: State, session: OpenSession | None = None) -> None:
        assert state in NEXT[self.state], f"{self.state} does not become {state}"
        self.state, self.session = state, session
        self.check_invariants()
        self._freed.set()
        self._freed = trio.Event()

    def _settle(self) -> None:
        """Nothing is open, as far as is known."""
        self._enter(State.UNSURE if self.opener.unsure else State.CLOSED)

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

    # --- opening and closing

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close what is open and open another file.

        Raises:
            What Opener.open raises, and close of a file that was written to. That a file which was only read
            could not be closed is no news to whoever opens the next: the opener tries again.
        """
        self._path = path  # from now on nobody may change that name, also while the other file is closed
        try:
            if self.session is not None:
                close = self.close if self.session.writing else self.close_quietly
                await close()
                self.switches += 1
            self._enter(State.OPENING)
            try:
                session = await self.opener.open(path, opcode)
            except BaseException:
                self._settle()
                raise
            self._enter(State.OPEN, session)
        finally:
            self._path = None
        return session

    async def close(self, limit: float | None = None) -> bool:
        """Terminate; True if there was nothing to do or it was we who closed it (Opener.close).

        limit: seconds to wait for the answer; None: as for any request, for somebody is told of a failure.
        """
        session = self.session
        if session is None:
            return True
        self._closing = session.path
        self._enter(State.CLOSING)
        try:
            return await self.opener.close(session, self._op_deadline if limit is None else limit)
        finally:
            self._closing = None
            self._settle()

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
        self._closing = next(iter(self.opener.unsure.values()))
        self._enter(State.CLOSING)
        try:
            await self.opener.close_unsure()
        except MavftpfsError:
            return
        finally:
            self._closing = None
            self._settle()

    async def made_room(self, path: bytes) -> bool:
        """Close another file that was only read; return whether there was one and it is closed."""
        if self.session is None or self.session.writing or self.session.path == path:
            return False
        self.switches += 1
        return await self.close_quietly()

    def require(self, session: OpenSession) -> None:
        """Raise SessionLost if this one is not believed in any more."""
        if self.session is not session:
            raise SessionLost("the vehicle restarted, or opened another file", by_server=True)

    def abandon(self) -> None:
        """What is open is lost, or not to be believed: it is closed before the next open."""
        if self.session is not None:
            self.opener.abandon(self.session)
            self._enter(State.UNSURE)
        self.wake()

    def forget_server(self) -> None:
        """The vehicle restarted: nothing is open, unless it was opened before we heard of that."""
        self.abandon()
        self.opener.forget_server()

    # --- requests beside it

    async def get_through(self, attempt: Callable[[], Awaitable[T]], *, changes: bool = False) -> T:
        """Do something that another client's session may keep out (ArduPilot), after silences if need be.

        changes: a refusal of what was sent twice may answer the second execution, and is the caller's news.

        Raises:
            SessionBusy: it did not go away. Else what `attempt` raises.
        """

        def is_taken(nak: FtpNak) -> bool:
            return nak.code in _TAKEN and self.session is None and not (changes and nak.retransmitted)

        try:
            result = await self.opener.outlast(attempt, is_taken)
        except SessionBusy:
            self.kept_out = True
            raise
        self.kept_out = False
        return result

    # --- claims

    def claimed(self, path: bytes) -> bool:
        """Whether somebody changes this path now."""
        return any(claim.covers(path) for claim in self._claims)

    @asynccontextmanager
    async def claim(self, path: bytes, *, below: bool, limit: float) -> AsyncIterator[None]:
        """Keep the session off a path for the length of the body.

        Raises:
            RequestTimeout: it could not be closed within `limit` seconds.
        """
        claim = _Claim(path, below)
        self._claims.append(claim)
        try:
            with trio.move_on_after(limit) as scope:
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
        if any(self.claimed(path) for path in self.opener.unsure.values()):
            await self.close_unsure()

    def _busy(self) -> list[bytes]:
        open_path = None if self.session is None else self.session.path
        paths = (open_path, self._path, self._closing, *self.opener.unsure.values())
        return [path for path in paths if path is not None]
