"""Short uses of the server session: open, do something, close. Layer: session."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import trio

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.opening import OpenSession
from mavftpfs.shared.errors import MavftpfsError


@dataclass(eq=False)
class SessionJob:
    """One open, an action, one Terminate.

    asked_at: when it was asked for. ticket: its place in the queue.
    """

    path: bytes
    opcode: Opcode
    action: Callable[[OpenSession], Awaitable[None]]
    ticket: int
    asked_at: float
    session: OpenSession | None = None
    error: MavftpfsError | None = None
    finished: trio.Event = field(default_factory=trio.Event)

    def fail(self, error: MavftpfsError) -> None:
        """End it before it began."""
        self.error = error
        self.finished.set()
