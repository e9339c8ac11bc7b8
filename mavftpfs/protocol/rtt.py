"""Round-trip times and the timers made of them. Layer: protocol; pure.

One estimator for each family of opcodes, because a listing of a big directory or a checksum takes
seconds where a read takes milliseconds. RFC 6298 with Karn's rule (the caller gives only samples
that belong to one transmission) and two changes: the floor is small, because a tail loss on a fast
link would otherwise cost 1 s, and there is always half a round trip of slack above the mean.
"""

from __future__ import annotations

INITIAL_RTO = 1.0
"""Seconds to wait while no round trip is known, if nothing better is (see `timers`)."""

LONGEST_BACK_OFF = 3.0
_FREE_SILENCES = 2
_MAX_DOUBLINGS = 7


class RttEstimator:
    """Smoothed round-trip time, its variation, and the retransmission timeout; all in seconds.

    Args:
        floor: least timeout. first: the timeout before the first sample, if the floor is not more.
    """

    __slots__ = ("_floor", "_silences", "rto", "samples", "smoothed", "unfloored", "variation")

    def __init__(self, floor: float, first: float = INITIAL_RTO) -> None:
        self._floor = floor
        self._silences = 0
        self.unfloored = first
        self.rto = max(first, floor)
        """How long to wait for a reply before it is asked again.

        Backed off to at most LONGEST_BACK_OFF: a link that comes back should not wait longer for us.
        """
        self.samples = 0
        self.smoothed = 0.0
        self.variation = 0.0

    @property
    def known(self) -> bool:
        """Whether a round trip was ever measured."""
        return self.samples > 0

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
        self.rto = rto if rto > self._floor else self._floor

    def borrow(self, timeout: float) -> None:
        """Wait no longer than another family does after its first round trip, until one of ours is known."""
        if not self.samples and timeout < self.unfloored:
            self.unfloored = timeout
            self.rto = max(timeout, self._floor)

    def on_silence(self) -> None:
        """Nothing was heard for a whole timeout; from the third in a row on, each doubles it.

        Not from the first: at 20 % loss each way a lone request goes unanswered every third time.
        """
        self._silences += 1
        rto = max(self.unfloored, self._floor)
        doublings = self._silences - _FREE_SILENCES
        if doublings > 0 and rto < LONGEST_BACK_OFF:
            rto = min(rto * (1 << min(doublings, _MAX_DOUBLINGS)), LONGEST_BACK_OFF)
        self.rto = rto
