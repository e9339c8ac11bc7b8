"""Requests that a session of somebody else's keeps out. Layer: session.

ArduPilot refuses whatever does not carry the id of the session that is open there, be it one of a client
that was killed a second ago (servers.md 1). Such a session is taken away after 3 s in which nobody was told
anything, and each refusal begins them anew: so nothing is said for longer than that before asking again.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

import trio

from mavftpfs.protocol.payload import NakCode
from mavftpfs.session.opening import GATE_PATIENCE, SILENCE_ARDUPILOT, SILENCE_PX4
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.shared.errors import FtpNak, SessionBusy

_TAKEN = frozenset((NakCode.INVALID_SESSION, NakCode.NO_SESSIONS_AVAILABLE))

T = TypeVar("T")


class StaleSessions:
    """Repeats what was refused for a session that is not ours, after the silence that ends a stale one.

    Attributes:
        in_the_way: whether the last request of this kind was refused so.
    """

    def __init__(self, scheduler: Scheduler, clock: Callable[[], float], op_deadline: float) -> None:
        self._scheduler = scheduler
        self._clock = clock
        self._op_deadline = op_deadline
        self.in_the_way = False

    async def outlast(self, attempt: Callable[[], Awaitable[T]], *, changes: bool = False) -> T:
        """Return what `attempt` returns, called again while it is refused so, for `op_deadline` seconds.

        changes: a refusal of what was sent twice may answer the second execution, and is the caller's news.

        Raises:
            SessionBusy: the session did not go away in time. Else what `attempt` raises.
        """
        deadline = self._clock() + self._op_deadline
        silence = SILENCE_ARDUPILOT
        while True:
            try:
                result = await attempt()
            except FtpNak as nak:
                ours = self._scheduler.session is not None
                if nak.code not in _TAKEN or ours or (changes and nak.retransmitted):
                    raise
                self.in_the_way = True
                if self._clock() + silence >= deadline:
                    raise SessionBusy("the vehicle's only FTP session is in use by another client") from nak
            else:
                self.in_the_way = False
                return result
            async with self._scheduler.gate.held_shut(GATE_PATIENCE) as silent:
                if silent:
                    await trio.sleep(silence)
            silence = SILENCE_PX4  # whoever is not gone by now is asked less often
