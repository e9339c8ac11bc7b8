"""Whose burst is running, and whether this server answers others meanwhile. Layer: protocol; pure."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.requests import Operation, Request
from mavftpfs.shared.traits import Traits

_PACKETS_TO_BELIEVE = 3


class BurstWatch:
    """What the engine must remember of the last burst.

    Attributes:
        op: whose burst the next burst packets may belong to, else None.
        heard_at: when the last burst packet came, believed or not: an abandoned ArduPilot burst goes on.
    """

    __slots__ = ("_order", "_proof_wanted", "heard_at", "op")

    def __init__(self) -> None:
        self.op: Operation | None = None
        self.heard_at = -inf
        self._order = 0
        self._proof_wanted = 0

    @property
    def running(self) -> bool:
        """Whether a burst is under way that we follow."""
        return self.op is not None and self.op.bursting

    def begin(self, request: Request) -> None:
        """A BurstReadFile goes out."""
        self.op = request.op
        self._order = request.order
        self._proof_wanted = 0

    def release(self, op: Operation) -> None:
        """An operation is over; so is our interest in its burst."""
        if self.op is op:
            self.op = None

    def on_packet(self, traits: Traits) -> None:
        """A packet of the running burst came: enough of them behind another answer prove something."""
        if self._proof_wanted:
            self._proof_wanted -= 1
            if not self._proof_wanted:
                traits.answers_during_burst = True

    def on_answer(self, request: Request, traits: Traits, timeout: float) -> None:
        """A request on its way during a burst was answered: in between, or only behind it (servers.md 4)?

        timeout: what an answer takes at most without a burst, in seconds.
        """
        if traits.answers_during_burst is not None or not request.single or request.order < self._order:
            return
        if self.running:
            self._proof_wanted = _PACKETS_TO_BELIEVE
        elif self.heard_at - request.sent_at > 2 * timeout:
            traits.answers_during_burst = False
