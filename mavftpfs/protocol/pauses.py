"""The pauses of a server's card, and what goes out meanwhile. Layer: protocol; pure.

A card that pauses for a tenth of a second (PX4 on NuttX) leaves a slow link idle for as long. After such
pauses the flow keeps some answers in the link's queue, and while the card pauses, it sends on at a third of
the pace, because otherwise the server would have nothing to do for a round trip after the pause. These
requests may overflow the server's buffer, so a loss during a pause proves nothing of the link.
"""

from __future__ import annotations

from math import inf

PAUSE, LONGEST_PAUSE = 0.02, 0.4
"""Seconds without an answer after which it is a pause, and after which it is a silence."""

WAITS = 8
"""Requests: a server pauses if no answer comes for the time that so many usually take, and PAUSE more."""

BRIDGE = 0.35
"""While a server pauses, requests go on at this share of its rate. Most of these overflow its buffer."""

BRIDGE_FROM = 0.03
"""Seconds: with a shorter round trip there is no reserve and no bridge. The requests in a server's buffer
last for so long."""

KNOWN = 30.0
"""Seconds for which it is believed that a server pauses."""


class Pauses:
    """A server's pauses, as the times of its answers show them.

    Attributes:
        length: seconds without an answer that prove no loss, because the server pauses; 0 if it does not.
    """

    def __init__(self) -> None:
        self.length = 0.0
        self._answered_at = inf
        self._ended_at = -inf

    def on_answers(self, now: float, rtt: float | None, shortest: float, rate: float) -> None:
        """Note answers. rtt: of one of them, if known. shortest: round trip of the path. rate: answers per
        second, usually."""
        gap, self._answered_at = now - self._answered_at, now
        # An answer that ends a pause has waited for its end. After a run of losses none has.
        if rtt is not None and rate > 0.0 and rtt > shortest + gap / 2 and gap > PAUSE + WAITS / rate:
            self._ended_at, self.length = now, max(min(gap, LONGEST_PAUSE), self.length)
        elif now >= self._ended_at + KNOWN:
            self.length = 0.0

    def on_app_limited(self) -> None:
        """Note that there is nothing to answer."""
        self._answered_at = inf

    def touch(self, since: float, shortest: float) -> bool:
        """Return whether what happened since then may be due to a pause: it shows until a round trip after
        the pause."""
        return self.length > 0.0 and self._ended_at + shortest >= since

    def beyond(self, now: float, shortest: float, reserve: float) -> float:
        """Return for how many seconds requests go out beyond the window. reserve: seconds of answers that are
        to wait in the link's queue."""
        if now >= self._ended_at + KNOWN or shortest < BRIDGE_FROM:
            return 0.0
        silence = now - self._answered_at
        if silence > PAUSE:
            bridge = min(LONGEST_PAUSE, silence)
        else:  # after a pause its requests are answered a round trip later
            bridge = self.length if now < self._ended_at + shortest else 0.0
        return max(BRIDGE * bridge, reserve)

    def grows(self, now: float, shortest: float) -> bool:
        """Return whether time alone makes `beyond` more."""
        known = now < self._ended_at + KNOWN and shortest >= BRIDGE_FROM
        return known and now - self._answered_at < LONGEST_PAUSE
