"""Doubt: when something was noticed, and when something that concerns reads. Layer: session; pure.

Servers share session ids between clients, requests name a session and no file, and some links deliver a
request twice, the second time late. Whatever shows that this happened raises the same doubt: an answer that
nothing outstanding and no repetition of ours explains, another FTP client, a session that vanished under us,
a restart of the vehicle. For ten minutes from then on the caches compare what was written.

Where requests were seen to come late, a name is not changed twice within that time, and a file that was sent
is left alone for so long: a copy of its CreateFile, and one of the rename that follows, would put an empty
file in the place of it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from mavftpfs.protocol.payload import Opcode

LASTS = 600.0
"""Seconds for which a doubt lasts: a second radio or another client stays for a while."""

LEAST_LATE = 1.0
MOST_LATE = 10.0
"""Seconds by which a copy of a request is taken to be late at least, and at most."""


_SESSION, _OPCODE, _REQ_OPCODE = 2, 3, 5  # where they are in a payload

_OF_SESSIONS = frozenset(
    (
        Opcode.OPEN_FILE_RO,
        Opcode.OPEN_FILE_WO,
        Opcode.CREATE_FILE,
        Opcode.READ_FILE,
        Opcode.BURST_READ_FILE,
        Opcode.WRITE_FILE,
        Opcode.TERMINATE_SESSION,
        Opcode.RESET_SESSIONS,
    )
)


def session_used_by(payload: bytes) -> int | None:
    """Return the id of the session that another client's request, or a reply to it, uses; None: none.

    If that may be ours it may be its own now. Listings, checksums and changes of names use none: a ground
    station that shows directories makes nobody's bytes doubtful.
    """
    opcode = payload[_REQ_OPCODE] if payload[_OPCODE] in (Opcode.ACK, Opcode.NAK) else payload[_OPCODE]
    return payload[_SESSION] if opcode in _OF_SESSIONS else None


class Doubt:
    """Whether, and since when, what was ACKed is not believed without a look.

    Attributes:
        on_raised: called each time that what was read is in doubt, with the reason, for people.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.on_raised: Callable[[str], None] = lambda reason: None
        self._clock = clock
        self._at = self._reads_at = -inf
        self._late = 0.0
        self._late_at = -inf

    def raise_it(self, reason: str, *, reads: bool = True) -> None:
        """Something was noticed now; reads: what was read lately may be another file's, too."""
        self._at = self._clock()
        if reads:
            self._reads_at = self._at
            self.on_raised(reason)

    def is_active(self, since: float = inf) -> bool:
        """Return whether something was noticed in the last ten minutes, or after that time."""
        return self._clock() - self._at <= LASTS or self._at > since

    def reads_arose_since(self, at: float) -> bool:
        """Return whether what was read then may be another file's."""
        return self._reads_at >= at

    def note_late(self, seconds: float) -> None:
        """A copy of a request was answered so long after the request was sent first."""
        now, late = self._clock(), min(MOST_LATE, max(LEAST_LATE, seconds))
        if late >= self.lateness:
            self._late, self._late_at = late, now

    @property
    def lateness(self) -> float:
        """Seconds for which a copy of a request may still come: the most by which one was late in the last
        ten minutes, within bounds; 0 if none was."""
        return self._late if self._clock() - self._late_at <= LASTS else 0.0
