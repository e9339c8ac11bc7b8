"""How long to wait for which reply: one estimator for each family of opcodes. Layer: protocol; pure."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.requests import FLOORS, Manner, Request
from mavftpfs.protocol.rtt import INITIAL_RTO, RttEstimator

_LONGEST_WAIT = 5.0


class Timers:
    """Round trips by family (see `requests.Manner`).

    Attributes:
        of: the estimators.
    """

    __slots__ = ("_at", "_manner", "_sent_at", "of")

    def __init__(self) -> None:
        self.of = {family: RttEstimator(floor) for family, floor in FLOORS.items()}
        self._at = self._sent_at = -inf
        self._manner: Manner | None = None

    @property
    def rtt(self) -> float | None:
        """Smoothed round trip in seconds: of reads, else of any request; None before the first."""
        known = [timer for timer in self.of.values() if timer.known]
        return known[0].smoothed if known else None

    def timeout(self, family: str) -> float:
        """Return the present retransmission timeout of a family of opcodes, in seconds."""
        timer = self.of[family]
        if timer.known:
            return timer.rto
        known = (other.unfloored for other in self.of.values() if other.known)
        return max(min(known, default=INITIAL_RTO), FLOORS[family])

    def sample(self, request: Request, now: float) -> float:
        """Return the round trip of a transmission that was answered, and learn from it.

        What was sent in one batch and answered in one batch is one sample: a hundred equal ones would say
        that round trips never vary.
        """
        sent_at = request.sent_at
        if now != self._at or sent_at != self._sent_at or request.manner is not self._manner:
            self._at, self._sent_at, self._manner = now, sent_at, request.manner
            self.of[request.manner.family].sample(now - sent_at)
        return now - sent_at

    def wait(self, request: Request) -> float:
        """Return how long to wait for the reply to this transmission of a request, in seconds."""
        manner = request.manner
        wait = rto = self.of[manner.family].rto
        doublings = request.sends - manner.free_sends
        if doublings > 0:
            wait = min(rto * (1 << min(doublings, 6)), max(rto, _LONGEST_WAIT))
        return max(wait, manner.patience) if request.sends >= manner.patient_after else wait
