"""Decisions of the session layer as pure functions of what was measured. Layer: session; pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Strategy = Literal["window", "burst"]
ReadMode = Literal["auto", "window", "burst"]

LIGHT_USE = 0.3
"""Seconds of service in the recent past below which a file counts as an interactive one."""

USE_MEMORY = 10.0
"""Seconds after which a file's service no longer counts."""

MIN_QUANTUM = 1.0
"""Seconds a bulk reader keeps the server's session while another bulk reader waits."""

MAX_QUANTUM = 4.0

STARVING = 3.0
"""Seconds of waiting after which a bulk reader is not passed over any more."""

RELIEF = 0.5
"""Seconds of service that ends starving."""

WORTH_A_BURST = 32 * 1024
"""Bytes of sequential want below which a burst gains nothing over a window of reads."""

BURST_GAIN = 1.3
"""How much faster than the window a burst must be to be chosen: it cannot always be stopped."""


@dataclass(frozen=True, slots=True)
class ReadFacts:
    """What the choice of a read strategy may depend on; rates in bytes/s, times in seconds.

    wanted: contiguous bytes wanted from here on.
    in_flight_limit: requests the server may be sent at once, None where no limit is known.
    window_rate, burst_rate: measured goodput, None before it was tried.
    burst_stoppable: False where requests are not answered during a burst (ArduPilot), None unknown.
    """

    mode: ReadMode
    wanted: int
    rtt: float | None
    chunk: int
    in_flight_limit: int | None
    window_rate: float | None
    burst_rate: float | None
    burst_stoppable: bool | None
    others_waiting: bool


def choose_strategy(facts: ReadFacts) -> Strategy:
    """Return how to read next.

    A window of ReadFile requests is the rule: it can be stopped, it fills gaps as it goes, and on PX4 and
    MAVSDK it is the faster way by far (servers.md 15). A burst wins only where the server's queue caps the
    window and the round trip is long, so that w * chunk / RTT stays below the pace of a burst. None is begun
    only to be measured: ArduPilot's cannot be stopped for 3 to 280 s, is paced to a third of the link, and
    requests that are spread evenly (protocol.pacing) fill a long way better.
    """
    if facts.mode != "auto":
        return facts.mode
    if facts.wanted < WORTH_A_BURST or facts.others_waiting:
        return "window"
    if facts.burst_rate is None or facts.in_flight_limit is None:
        return "window"
    window_rate = facts.window_rate
    if window_rate is None:
        if facts.rtt is None:
            return "window"
        window_rate = facts.in_flight_limit * facts.chunk / max(facts.rtt, 1e-3)
    return "burst" if facts.burst_rate > BURST_GAIN * window_rate else "window"


def quantum(rtt: float | None) -> float:
    """Return the seconds two bulk readers alternate by: changing files costs two round trips."""
    return min(MAX_QUANTUM, max(MIN_QUANTUM, 10.0 * (rtt or 0.0)))


@dataclass(slots=True)
class Service:
    """How much of the session a file had lately: seconds of service."""

    seconds: float = 0.0
    until: float = 0.0

    def add(self, seconds: float, now: float) -> None:
        """Count service that ended now."""
        self.seconds = self.recent(now) + seconds
        self.until = now

    def recent(self, now: float) -> float:
        """Return the service that still counts; it fades linearly within USE_MEMORY."""
        faded = max(0.0, 1.0 - (now - self.until) / USE_MEMORY)
        return self.seconds * faded


def is_starving(waited: float) -> bool:
    """Return whether who waited so long (seconds) goes before newcomers: one small file after another must
    slow a copy down, not stop it."""
    return waited >= STARVING


def should_switch(
    *,
    current_has_demand: bool,
    current_slice: float,
    current_use: float,
    waiting_use: float,
    rtt: float | None,
    current_waited: float = 0.0,
) -> bool:
    """Return whether the session should pass to a file that waits with demand.

    A file that used little lately (an editor, `head`) goes before one that used much, at once; equals
    alternate by quantum. Who had to wait long (current_waited) keeps what it got for a while.
    """
    if not current_has_demand:
        return True
    if is_starving(current_waited) and current_slice < RELIEF:
        return False
    if waiting_use < LIGHT_USE and max(current_use, current_slice) >= LIGHT_USE:
        return True
    return current_slice >= quantum(rtt)
