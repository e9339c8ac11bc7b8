"""Other FTP clients of the vehicle: may one have a file open there? Layer: session; pure.

Servers with one session refuse the second client, or give the session to the client that opens last: PX4 of
September 2026 and MAVSDK's server end the first session without a word (docs/servers.md 1 and 16), and
ArduPilot ends that of a client that paused for 3 s. So this connection opens nothing while another client may
have a file open: from that client's first request that uses a session, until its Terminate or Reset, or 10 s
after its last request. A refused open changes nothing, although clients use it to learn whether a name is
free.

After another client closed its file, this connection waits a random moment longer. If several programs wait,
the others hear the first one that opens a file.
"""

from __future__ import annotations

import random
from enum import Enum
from math import inf

from mavftpfs.protocol.payload import Opcode

LEFT_OPEN = 10.0
"""Seconds after another client's last request for which its file counts as open. PX4 closes the file then;
PX4 of September 2026 after 30."""

MOST_PAUSE = 0.3
"""The most seconds for which this connection opens nothing after another client closed its file."""

CLIENT_MEMORY = 10.0
"""Seconds for which an FTP client that was heard counts as present."""

STAYS_ITS_OWN = 2.5
"""Seconds after an answer for which no ArduPilot with one session reassigns that session; it does after 3."""

OPENING = frozenset((Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE))
_USING = frozenset((Opcode.READ_FILE, Opcode.BURST_READ_FILE, Opcode.WRITE_FILE))
_CLOSING = frozenset((Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS))
_SESSION, _OPCODE, _REQ_OPCODE = 2, 3, 5  # their positions in a payload


class Heard(Enum):
    """An event in the session of another client, told by its request or by the answer."""

    ASKED = "asked to open"
    OPENED = "opened"
    REFUSED = "refused to open"
    USED = "read or written"
    CLOSED = "closed"


class Theirs(Enum):
    """The state of other clients' sessions, as far as it was heard."""

    NOTHING = "nothing"
    ASKED = "an open that is not answered yet"
    FILE = "a file"


_THEN: dict[Theirs, dict[Heard | None, Theirs]] = {
    Theirs.NOTHING: {Heard.ASKED: Theirs.ASKED, Heard.OPENED: Theirs.FILE, Heard.USED: Theirs.FILE},
    Theirs.ASKED: {Heard.REFUSED: Theirs.NOTHING, Heard.OPENED: Theirs.FILE, Heard.USED: Theirs.FILE},
    Theirs.FILE: {Heard.CLOSED: Theirs.NOTHING},
}
"""The state -> the event -> the next state. Any other event changes nothing."""


class OtherClients:
    """Records the requests of other clients, and the answers to them.

    Attributes:
        heard_at: when one of them was heard last.
        session: the id that another client used or closed last; None before the first.
        closed_at: when one of them was last heard to close a file.
        file_open_until: the time until which another client may have a file open.
    """

    def __init__(self, rng: random.Random) -> None:
        """rng: draws for how long this connection waits after another client closed its file."""
        self._rng = rng
        self.session: int | None = None
        self._theirs = Theirs.NOTHING  # until `file_open_until`
        self.heard_at = self.closed_at = self.file_open_until = self._answered_at = -inf
        self._answered_since = inf  # since then its answers show no pause that loses a session

    def hear(self, payload: bytes, now: float) -> Heard | None:
        """Take a request of another client, or an answer to one; return what it tells of its session.

        None for a refused read or write, and for listings, checksums and changes of names, which use no
        session, so that a ground station that shows directories makes nobody's bytes suspect.
        """
        self.heard_at = now
        event, before = _event(payload), self._theirs if now < self.file_open_until else Theirs.NOTHING
        self._theirs = _THEN[before].get(event, before)
        if self._theirs is not Theirs.NOTHING:
            self.file_open_until = now + LEFT_OPEN
        elif before is not Theirs.NOTHING:
            self.file_open_until = now + MOST_PAUSE * self._rng.random() if event is Heard.CLOSED else -inf
        if event is Heard.CLOSED:
            self.closed_at = now
        if event is not None:
            self.session = payload[_SESSION]
        if self._theirs is not Theirs.FILE:
            self._answered_at = -inf
        elif event is not None and payload[_OPCODE] == Opcode.ACK:
            if now - self._answered_at >= STAYS_ITS_OWN:
                self._answered_since = now
            self._answered_at = now
        return event

    def are_heard(self, now: float) -> bool:
        """Return whether another FTP client of this vehicle was heard lately."""
        return now - self.heard_at < CLIENT_MEMORY

    def on_ours_opened(self) -> None:
        """Note that this connection opened a file, so no other client has the session, or the server has
        several sessions."""
        self.file_open_until = -inf

    def has_session(self, since: float, now: float) -> bool:
        """Return whether the answers to another client show that it had a session from `since` until now."""
        return self._answered_since <= since and now - self._answered_at < STAYS_ITS_OWN


def _event(payload: bytes) -> Heard | None:
    """Return what a payload tells of the session of another client; None if nothing."""
    kind = payload[_OPCODE]
    opcode = payload[_REQ_OPCODE] if kind in (Opcode.ACK, Opcode.NAK) else kind
    if opcode in OPENING:
        return Heard.ASKED if kind == opcode else Heard.OPENED if kind == Opcode.ACK else Heard.REFUSED
    if opcode in _USING and kind != Opcode.NAK:
        return Heard.USED
    return Heard.CLOSED if opcode in _CLOSING else None
