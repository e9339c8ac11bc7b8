"""How long to wait for which reply: one estimator for each family of opcodes. Layer: protocol; pure."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import FLOORS, Manner, Request
from mavftpfs.protocol.rtt import INITIAL_RTO, RttEstimator

_LONGEST_WAIT = 5.0

_FIRST_WAITS = {"list": 0.5}
"""Seconds to wait while no round trip is known, where that is not INITIAL_RTO.

A mount begins with a listing, whose loss somebody waits for. Each transmission of one has its own seq: where
it is repeated in vain its answer tells the round trip all the same, and a second execution changes nothing.
"""

_WORK = "work"
_NO_WORK = 0.1
"""Seconds of work that count as none: what takes no longer times the way and the server's readiness."""
_PACE_MARGIN = 4.0
"""A card may be so much slower than it was seen to be: others use it, and it stops to erase."""
_LEAST_PACE = 0.05
_USUAL_PACE = 0.1
"""Cards read a megabyte per second and more: of a server never seen at work, a checksum is asked for again
when one of those would have had it. It is under the same seq: PX4 and ArduPilot, which may be slower, replay
their answer (servers.md 2), and MAVSDK, which works again, is a computer."""

_USUAL_SENDS = 2
"""Transmissions that may go out so; then the slowest card gets its time."""

_FORGETTING = 0.125


class Timers:
    """Round trips by family (see `requests.Manner`).

    Attributes:
        of: the estimators.
    """

    __slots__ = ("_at", "_manner", "_pace", "_sent_at", "of")

    def __init__(self) -> None:
        self.of = {
            family: RttEstimator(floor, _FIRST_WAITS.get(family, INITIAL_RTO))
            for family, floor in FLOORS.items()
        }
        self._at = self._sent_at = -inf
        self._manner: Manner | None = None
        self._pace: dict[int, float] = {}

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
            if request.manner.family == _WORK and request.manner.patience > _NO_WORK:
                self._learn_pace(request, now - sent_at)
                return now - sent_at
            timer = self.of[request.manner.family]
            timer.sample(now - sent_at)
            if timer.samples == 1:
                self._lend(timer.unfloored)
        return now - sent_at

    def _lend(self, timeout: float) -> None:
        """A lost Open after a few listings should not cost a second: that is what nothing known would mean.

        The first sample allows for three round trips, which is generous for whoever has none yet.
        """
        for timer in self.of.values():
            timer.borrow(timeout)

    def wait(self, request: Request) -> float:
        """Return how long to wait for the reply to this transmission of a request, in seconds."""
        manner = request.manner
        timer = self.of[manner.family]
        wait = rto = timer.rto
        patient = request.sends >= manner.patient_after
        if patient and manner.family == _WORK:
            # The way and the work take their times one after the other.
            wait = rto = rto + self._work_of(request)
        # Under the same seq no repetition tells the round trip: where that is not known, it may be longer.
        free = manner.free_sends if timer.known or not manner.same_seq else 1
        doublings = request.sends - free
        if doublings > 0:
            wait = min(rto * (1 << min(doublings, 6)), max(rto, _LONGEST_WAIT))
        return max(wait, manner.patience) if patient and manner.family != _WORK else wait

    def _learn_pace(self, request: Request, elapsed: float) -> None:
        """Compare how long a server worked with what the slowest is given; the slowest lately counts."""
        seen = elapsed / request.manner.patience
        last = self._pace.get(request.opcode, seen)
        self._pace[request.opcode] = max(seen, last + (seen - last) * _FORGETTING)

    def _work_of(self, request: Request) -> float:
        """Return how long to wait for the work of this server, in seconds; the slowest takes `patience`."""
        patience = request.manner.patience
        seen = self._pace.get(request.opcode)
        if seen is not None:
            return patience * min(1.0, max(_LEAST_PACE, seen * _PACE_MARGIN))
        if request.opcode == Opcode.CALC_FILE_CRC32 and request.sends <= _USUAL_SENDS:
            return max(patience * _USUAL_PACE, min(patience, _NO_WORK))
        return patience
