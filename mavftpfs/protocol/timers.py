"""The wait for a reply before its request counts as lost. Layer: protocol; pure.

There are two estimators of the round trip: of chunks of files, and of single requests, because a listing of a
big directory takes seconds where a read takes milliseconds. A request is lost when its timer runs out. It is
lost sooner if a later one was answered: servers answer in order, so a round trip and an eighth are enough
(`Reordering`). Waits grow with the time that passed without progress; transmissions are not counted.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.requests import Request, RetryPolicy

INITIAL_RTO = 1.0
"""Seconds to wait while no round trip is known. A request with a seq of its own waits half as long: after a
needless repetition its answer tells the round trip all the same, and a second execution changes nothing."""

LONGEST_BACK_OFF = 3.0
"""Seconds to which a wait grows at most, so that a link that comes back is noticed soon."""

_NO_WORK = 0.1
"""Seconds of work that count as none: a request that takes no longer measures the way and the server's
readiness."""

EIGHTH, MOST_LATE = 0.125, 1.0
"""Shares of a round trip, the least and the most, by which an answer may be later than usual before its
request counts as lost, where a later request was answered."""

AT_ONCE = 0.001
"""Seconds: answers that are so much later are not late. Timers and batches are not more precise."""

FADE = 2.0
"""Seconds after which an eighth that was added counts no more."""


class RttEstimator:
    """Smoothed round-trip time, its variation, and the retransmission timeout; all in seconds.

    RFC 6298 with Karn's rule (the caller gives only samples that belong to one transmission), but without its
    floor of 1 s. And there is always half a round trip of slack above the mean.
    """

    def __init__(self) -> None:
        self.rto = INITIAL_RTO
        self.known = False
        self.smoothed = 0.0
        self.variation = 0.0

    def sample(self, rtt: float) -> None:
        """Take one round trip that provably belongs to one transmission."""
        if self.known:
            error = rtt - self.smoothed
            self.smoothed = smoothed = self.smoothed + error * 0.125
            self.variation += ((error if error > 0 else -error) - self.variation) * 0.25
        else:
            self.smoothed = smoothed = rtt
            self.variation = rtt / 2
            self.known = True
        slack = 4 * self.variation
        half = smoothed / 2
        self.rto = smoothed + (slack if slack > half else half)


class Reordering:
    """By how much an answer may be later than those to later requests, in round trips.

    Each answer to what was taken to be lost adds an eighth, and that fades (as in RACK, RFC 8985).
    """

    def __init__(self) -> None:
        self._late, self._at = EIGHTH, 0.0

    def share(self, now: float) -> float:
        """Return the share of a round trip to wait beyond it."""
        return max(EIGHTH, self._late - EIGHTH * (now - self._at) / FADE)

    def on_late(self, now: float) -> None:
        """Note that a request that had been declared lost was answered after all."""
        self._late, self._at = min(MOST_LATE, self.share(now) + EIGHTH), now


class Timers:
    """The round trips of one server. bulk: of chunks of files. single: of all other requests."""

    def __init__(self) -> None:
        self.bulk, self.single = RttEstimator(), RttEstimator()
        self.reordering = Reordering()
        self._last = (-inf, -inf, False)

    def _estimator(self, policy: RetryPolicy) -> RttEstimator:
        """Return what is known for this policy, or at least for the other one."""
        own, other = (self.bulk, self.single) if policy.bulk else (self.single, self.bulk)
        return own if own.known or not other.known else other

    def timeout(self, policy: RetryPolicy) -> float:
        """Return how many seconds to wait for the reply to a first transmission, work aside."""
        estimator = self._estimator(policy)
        if estimator.known or policy.same_seq:
            return max(estimator.rto, policy.floor)
        return INITIAL_RTO / 2

    def sample(self, request: Request, now: float) -> float:
        """Return the round trip of a transmission that was answered, and learn from it.

        Requests that were sent and answered in one batch are one sample: a hundred equal ones would say
        that round trips never vary.
        """
        policy = request.policy
        rtt = now - request.sent_at
        moment = (now, request.sent_at, policy.bulk)
        if moment != self._last and policy.work <= _NO_WORK:  # else most of it was work
            self._last = moment
            (self.bulk if policy.bulk else self.single).sample(rtt)
        return rtt

    def wait(self, policy: RetryPolicy, quiet: float) -> float:
        """Return how many seconds to wait for the reply to a request that goes out.

        quiet: seconds in which its operation made no progress. While no round trip is known, the wait is at
        least as long, because the way may be long, and the answer to a repetition does not measure it.
        """
        backoff = policy.backoff if self._estimator(policy).known else 1.0
        wait = max(self.timeout(policy), min(quiet * backoff, LONGEST_BACK_OFF))
        return wait + min(policy.work, max(policy.usual_work, quiet))

    def passed_wait(self, rtt: float, now: float) -> float:
        """Return how many seconds after its transmission a request is lost, if a later one was answered.

        rtt: of that one, because the smoothed one is too long when a pause of the card has ended.
        """
        return max((1.0 + self.reordering.share(now)) * rtt, rtt + AT_ONCE)
