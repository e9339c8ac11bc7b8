"""The one server session, as the one task that uses it sees it. Layer: session.

Whoever is about to change a path claims it: the session is closed if it is open on that path, and stays
off it until the claim is given up (design promise 6).
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import trio

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.opening import TERMINATE_LIMIT, OpenSession, SessionOpener
from mavftpfs.shared.errors import MavftpfsError, RequestTimeout, SessionLost


@dataclass(frozen=True, eq=False)
class _Claim:
    """A path that is about to change. below: with all that lies below it."""

    path: bytes
    below: bool

    def covers(self, path: bytes) -> bool:
        return path == self.path or (self.below and path.startswith(self.path.rstrip(b"/") + b"/"))


class SessionHolder:
    """Opens, closes and remembers; lets its user sleep until there is news.

    Attributes:
        session: what is open, if anything. switches: how often one file made room for another.
    """

    def __init__(self, opener: SessionOpener, op_deadline: float = 30.0) -> None:
        self.opener = opener
        self._op_deadline = op_deadline
        self.session: OpenSession | None = None
        self.switches = 0
        self._opening: bytes | None = None
        self._closing: bytes | None = None
        self._claims: list[_Claim] = []
        self._news = trio.Event()
        self._freed = trio.Event()

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
            What SessionOpener.open raises, and close of a file that was written to. That a file which was
            only read could not be closed is no news to whoever opens the next: the opener tries again.
        """
        self._opening = path  # from now on nobody may change that name, also while the other file is closed
        try:
            await self._make_way()
            self.session = await self.opener.open(path, opcode)
        finally:
            self._opening = None
            self._tell()
        return self.session

    async def _make_way(self) -> None:
        if self.session is not None:
            close = self.close if self.session.writing else self.close_quietly
            await close()
            self.switches += 1

    async def size_of(self, path: bytes) -> int | None:
        """Return a file's size as OpenFileRO tells it; it may be open after that, or nothing is.

        Raises:
            As open.
        """
        self._opening = path
        try:
            await self._make_way()
            if self.opener.may_peek:
                return await self.opener.peek(path)
        finally:
            self._opening = None
            self._tell()
        return (await self.open(path)).size

    async def close(self, limit: float | None = None) -> bool:
        """Terminate; True if there was nothing to do or it was we who closed it (SessionOpener.close).

        limit: seconds to wait for the answer; None: as for any request, for somebody is told of a failure.
        """
        session, self.session = self.session, None
        if session is None:
            return True
        self._closing = session.path
        try:
            return await self.opener.close(session, self._op_deadline if limit is None else limit)
        finally:
            self._closing = None
            self._tell()

    async def close_quietly(self) -> bool:
        """Close after a failure that is already being reported, or for somebody else's sake."""
        try:
            return await self.close(TERMINATE_LIMIT)
        except MavftpfsError:
            return False

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
        """The session is lost or not to be believed: the next open closes it first."""
        session, self.session = self.session, None
        if session is not None:
            self.opener.abandon(session)
        self._tell()

    def forget(self) -> None:
        """The vehicle restarted: nothing is open, unless it was opened before we heard of that."""
        self.abandon()
        self.opener.forget()
        self._tell()
        self.wake()

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
        session = self.session
        if session is not None and self.claimed(session.path):
            await self.close_quietly()
        if any(self.claimed(doubtful) for doubtful in self.opener.doubtful_paths):
            await self.close_doubtful()

    async def close_doubtful(self) -> None:
        """Close what may still be open by our doing; a failure leaves it doubtful."""
        try:
            await self.opener.close_doubtful()
        except MavftpfsError:
            return
        finally:
            self._tell()

    def _busy(self) -> list[bytes]:
        open_path = None if self.session is None else self.session.path
        paths = (open_path, self._opening, self._closing, *self.opener.doubtful_paths)
        return [path for path in paths if path is not None]

    def _tell(self) -> None:
        self._freed.set()
        self._freed = trio.Event()
