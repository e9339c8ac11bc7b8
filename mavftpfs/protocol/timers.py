"""How long to wait for which reply. Layer: protocol; pure.

One estimator for each family of opcodes, because a listing of a big directory or a checksum takes seconds
where a read takes milliseconds.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import FLOORS, Manner, Request

INITIAL_RTO = 1.0
"""Seconds to wait while no round trip is known, if nothing better is."""

LONGEST_BACK_OFF = 3.0
"""Seconds between two tries that doubling reaches at most: a link that comes back should not wait longer."""
_FREE_SILENCES = 2
_MAX_DOUBLINGS = 7

_FIRST_WAITS = {"list": 0.5}
"""Seconds to wait while no round trip is known, where that is not INITIAL_RTO.

A mount begins with a listing, and a user waits if it is lost. Each transmission of a listing has its own seq.
So after a needless repetition the answer tells the round trip all the same, and a second execution changes
nothing.
"""

_MOVING = ("data", "write")
_WORK = "work"
_NO_WORK = 0.1
"""Seconds of work that count as none: a request that takes no longer measures the way and the server's
readiness."""
_USUAL_PACE = 0.1
"""Usual cards read a megabyte per second and more. A checksum is asked for again when a usual card would have
answered. That is under the same seq: PX4 and ArduPilot, which may be slower, replay their answer (servers.md
2). MAVSDK computes it again, but it is a computer."""

_USUAL_SENDS = 3
"""So many transmissions go out like that; then the slowest card gets its time."""


class RttEstimator:
    """Smoothed round-trip time, its variation, and the retransmission timeout of one family; all in seconds.

    RFC 6298 with Karn's rule (the caller gives only samples that belong to one transmission) and two changes.
    The floor is small, because a tail loss on a fast link would otherwise cost 1 s. And there is always half
    a round trip of slack above the mean.

    Args:
        floor: least timeout. first: the timeout before the first sample, if the floor is not more.
    """

    def __init__(self, floor: float, first: float = INITIAL_RTO) -> None:
        self.floor = floor
        self._silences = 0
        self.unfloored = first
        self.rto = max(first, floor)
        """How long to wait for a reply before it is asked again, backed off after silences."""
        self.samples = 0
        self.smoothed = 0.0
        self.variation = 0.0

    def sample(self, rtt: float) -> None:
        """Take one round trip that provably belongs to one transmission; ends a back-off."""
        if self.samples:
            error = rtt - self.smoothed
            self.smoothed = smoothed = self.smoothed + error * 0.125
            self.variation += ((error if error > 0 else -error) - self.variation) * 0.25
        else:
            self.smoothed = smoothed = rtt
            self.variation = rtt / 2
        self.samples += 1
        self._silences = 0
        slack = 4 * self.variation
        half = smoothed / 2
        self.unfloored = rto = smoothed + (slack if slack > half else half)
        self.rto = rto if rto > self.floor else self.floor

    def on_silence(self) -> None:
        """Nothing was heard for a whole timeout; from the third in a row on, each doubles it.

        Not from the first: at 20 % loss each way a lone request goes unanswered every third time.
        """
        self._silences += 1
        rto = max(self.unfloored, self.floor)
        doublings = self._silences - _FREE_SILENCES
        if doublings > 0 and rto < LONGEST_BACK_OFF:
            rto = min(rto * (1 << min(doublings, _MAX_DOUBLINGS)), LONGEST_BACK_OFF)
        self.rto = rto


class Timers:
    """Round trips by family (see `requests.Manner`). of: the estimators, that of reads first. moving: the
    estimator of the data that moved last, read or written."""

    def __init__(self) -> None:
        self.of = {
            family: RttEstimator(floor, _FIRST_WAITS.get(family, INITIAL_RTO))
            for family, floor in FLOORS.items()
        }
        self.moving = self.of["data"]
        self._at = self._sent_at = -inf
        self._manner: Manner | None = None

    def timeout(self, family: str) -> float:
        """Return the present retransmission timeout of a family of opcodes, in seconds."""
        timer = self.of[family]
        if timer.samples:
            return timer.rto
        known = (other.unfloored for other in self.of.values() if other.samples)
        return max(min(known, default=INITIAL_RTO), FLOORS[family])

    def sample(self, request: Request, now: float) -> float:
        """Return the round trip of a transmission that was answered, and learn from it.

        What was sent in one batch and answered in one batch is one sample: a hundred equal ones would say
        that round trips never vary.
        """
        sent_at = request.sent_at
        if now != self._at or sent_at != self._sent_at or request.manner is not self._manner:
            self._at, self._sent_at, self._manner = now, sent_at, request.manner
            if request.manner.family == _WORK and request.manner.slowest > _NO_WORK:
                return now - sent_at  # most of it was work
            timer = self.of[request.manner.family]
            timer.sample(now - sent_at)
            if request.manner.family in _MOVING:
                self.moving = timer
            if timer.samples == 1:
                # A family without samples would wait 1 s. Start it from another family's first sample, which
                # allows for three round trips.
                for other in self.of.values():
                    if not other.samples and timer.unfloored < other.unfloored:
                        other.unfloored = timer.unfloored
                        other.rto = max(timer.unfloored, other.floor)
        return now - sent_at

    def wait(self, request: Request) -> float:
        """Return how long to wait for the reply to this transmission of a request, in seconds."""
        manner = request.manner
        timer = self.of[manner.family]
        plain, rto = max(timer.unfloored, timer.floor), timer.rto
        slow = request.sends >= manner.slow_from
        if slow and manner.family == _WORK:
            # The way and the work take their times one after the other.
            work = manner.slowest
            if request.opcode == Opcode.CALC_FILE_CRC32 and request.sends <= _USUAL_SENDS:
                work = max(work * _USUAL_PACE, min(work, _NO_WORK))
            plain, rto = plain + work, rto + work
        # Under the same seq a repetition does not tell the round trip. If that is not known yet, it may be
        # long.
        free = manner.free_sends if timer.samples or not manner.same_seq else 1
        doublings = min(max(0, request.sends - free), _MAX_DOUBLINGS)
        wait = max(rto, min(plain * (1 << doublings), LONGEST_BACK_OFF))
        return max(wait, manner.slowest) if slow and manner.family != _WORK else wait
