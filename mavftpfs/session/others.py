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
from math import inf

from mavftpfs.protocol.payload import Opcode

LEFT_OPEN = 10.0
"""Seconds after another client's last request for which its file counts as open. PX4 closes the file then;
PX4 of September 2026 after 30."""

MOST_PAUSE = 0.3
"""The most seconds for which this connection opens nothing after another client closed its file."""

STAYS_ITS_OWN = 2.5
"""Seconds after an answer for which no ArduPilot with one session reassigns that session; it does after 3."""

OPENING = frozenset((Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE))
_USING = OPENING | {Opcode.READ_FILE, Opcode.BURST_READ_FILE, Opcode.WRITE_FILE}
_CLOSING = frozenset((Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS))
_SESSION, _OPCODE, _REQ_OPCODE = 2, 3, 5  # their positions in a payload


class OtherClients:
    """Records the requests of other clients, and the answers to them.

    Attributes:
        session: the id that another client used or closed last; None before the first.
        closed_at: when one of them was last heard to close a file.
    """

    def __init__(self, rng: random.Random) -> None:
        """rng: draws for how long this connection waits after another client closed its file."""
        self._rng = rng
        self._paused_until = -inf
        self.session: int | None = None
        self.closed_at = -inf
        self._has_file = False
        self._asks = False  # their open is not answered yet
        self._heard_at = self._answered_at = -inf
        self._answered_since = inf  # since then its answers show no pause that loses a session

    def hear(self, payload: bytes, now: float) -> int | None:
        """Take a request of another client, or an answer to one; return the id of its session.

        None for listings, checksums and changes of names, which use no session, so that a ground station that
        shows directories makes nobody's bytes suspect.
        """
        opcode, answered = _opcode_of(payload)
        if now >= self.file_open_until:
            self._has_file = self._asks = False
        self._heard_at = now
        if opcode not in _USING | _CLOSING:
            return None
        self.session = payload[_SESSION]
        if opcode in _CLOSING:
            self._on_closed(now)
        elif opcode not in OPENING:
            self._has_file = True
        elif asks_to_open(payload):
            self._asks = True
        else:
            self._asks, self._has_file = False, self._has_file or answered
        if not self._has_file:
            self._answered_at = -inf
        elif answered:
            if now - self._answered_at >= STAYS_ITS_OWN:
                self._answered_since = now
            self._answered_at = now
        return self.session

    def _on_closed(self, now: float) -> None:
        """Note that one of them closes its file. The request and its answer are one event."""
        if self._has_file:
            self._paused_until = now + MOST_PAUSE * self._rng.random()
        self._has_file, self.closed_at = False, now

    def on_ours_opened(self) -> None:
        """Note that this connection opened a file, so no other client has the session, or the server has
        several sessions."""
        self._has_file = self._asks = False

    @property
    def file_open_until(self) -> float:
        """The time until which another client may have a file open."""
        return self._heard_at + LEFT_OPEN if self._has_file or self._asks else self._paused_until

    def has_session(self, since: float, now: float) -> bool:
        """Return whether the answers to another client show that it had a session from `since` until now."""
        return self._answered_since <= since and now - self._answered_at < STAYS_ITS_OWN


def took_session(payload: bytes) -> bool:
    """Return whether this payload shows that another client has the shared session."""
    opcode, answered = _opcode_of(payload)
    return opcode in _USING and (answered or (opcode not in OPENING and payload[_OPCODE] != Opcode.NAK))


def asks_to_open(payload: bytes) -> bool:
    """Return whether this is a request to open a file, whose result only the answer shows."""
    return payload[_OPCODE] in OPENING


def _opcode_of(payload: bytes) -> tuple[int, bool]:
    """Return the opcode of a request, or of the answered request, and whether this is its ACK."""
    opcode = payload[_OPCODE]
    if opcode in (Opcode.ACK, Opcode.NAK):
        return payload[_REQ_OPCODE], opcode == Opcode.ACK
    return opcode, False
