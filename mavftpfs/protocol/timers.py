"""How long to wait for which reply: one estimator for each family of opcodes. Layer: protocol; pure."""

from __future__ import annotations

from mavftpfs.protocol.requests import FLOORS, Request
from mavftpfs.protocol.rtt import INITIAL_RTO, RttEstimator

_LONGEST_WAIT = 5.0


class Timers:
    """Round trips by family (see `requests.Manner`).

    Attributes:
        of: the estimators.
    """

    __slots__ = ("of",)

    def __init__(self) -> None:
        self.of = {family: RttEstimator(floor) for family, floor in FLOORS.items()}

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

    def wait(self, request: Request) -> float:
        """Return how long to wait for the reply to this transmission of a request, in seconds."""
        manner = request.manner
        wait = rto = self.of[manner.family].rto
        doublings = request.sends - manner.free_sends
        if doublings > 0:
            wait = min(rto * (1 << min(doublings, 6)), max(rto, _LONGEST_WAIT))
        return max(wait, manner.patience) if request.sends >= manner.patient_after else wait
