"""Round-trip times and the timers made of them. Layer: protocol; pure.

One estimator for each family of opcodes, because a listing of a big directory or a checksum takes
seconds where a read takes milliseconds. RFC 6298 with Karn's rule (the caller gives only samples
that belong to one transmission) and two changes: the floor is small, because a tail loss on a fast
link would otherwise cost 1 s, and there is always half a round trip of slack above the mean.
"""

from __future__ import annotations

INITIAL_RTO = 1.0
MAX_RTO = 8.0
_MAX_BACKOFF = 64.0


class RttEstimator:
    """Smoothed round-trip time, its variation, and the retransmission timeout; all in seconds."""

    __slots__ = ("_backoff", "_floor", "_rto", "samples", "smoothed", "variation")

    def __init__(self, floor: float) -> None:
        self._floor = floor
        self._rto = max(INITIAL_RTO, floor)
        self._backoff = 1.0
        self.samples = 0
        self.smoothed = 0.0
        self.variation = 0.0

    @property
    def known(self) -> bool:
        """Whether a round trip was ever measured."""
        return self.samples > 0

    @property
    def rto(self) -> float:
        """How long to wait for a reply before it is asked for again; backed off, at most MAX_RTO."""
        return min(self._rto * self._backoff, max(MAX_RTO, self._floor))

    def sample(self, rtt: float) -> None:
        """Take one round trip that provably belongs to one transmission; ends a back-off."""
        if self.samples:
            self.variation += (abs(self.smoothed - rtt) - self.variation) * 0.25
            self.smoothed += (rtt - self.smoothed) * 0.125
        else:
            self.smoothed = rtt
            self.variation = rtt / 2
        self.samples += 1
        self._backoff = 1.0
        slack = self.smoothed / 2
        if slack < 4 * self.variation:
            slack = 4 * self.variation
        rto = self.smoothed + slack
        self._rto = rto if rto > self._floor else self._floor

    def back_off(self) -> None:
        """Double the timeout until the next sample: nothing was heard for a whole one."""
        self._backoff = min(self._backoff * 2, _MAX_BACKOFF)
