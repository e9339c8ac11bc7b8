"""The measured cases: conditions, and the limit that docs/benchmarks.md gives for them.

The limit is the link's, and at most the server's ceiling, which for PX4 and MAVSDK is whatever they answer. A
PX4 whose card pauses (px4-nuttx) answers a read later, and answers that wait in the link meanwhile bridge
that: for 0.25 s and a round trip at most, because a program that lists a directory beside it waits behind
them, and that page has a bound for it. It has room for five writes, and what a full link brings beyond them
is never answered. How many pauses there are is chance, a tenth more or less in a minute, so a run is compared
with what its own pauses allowed. The window that a receive buffer survives limits only a serial port, and
these links are none: six writes a round trip would be 4.8 kB/s at 300 ms, and a share of that says nothing
where 75 kB/s are reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Family

Direction = Literal["read", "write"]

FRAME = 266
"""Bytes of a MAVLink 2 frame that carries 239 bytes of data."""

SMALL_FRAME = 30
"""Bytes of a frame that asks for data, or that ACKs it."""

ARDUPILOT_BURST = MAX_DATA / 0.0056
ARDUPILOT_WINDOW = 5
"""Requests that an ArduPilot queues, all of which are ours while no other client is heard."""

ARDUPILOT_POLL = 0.010

WAITING = 0.25
MOST_WAITING = 0.45
"""Seconds of answers, with the round trip, that may wait in a link for the pauses of a card."""

TARGETS = {
    "read": {0.0: 0.88, 0.01: 0.88, 0.05: 0.82, 0.1: 0.77},
    "write": {0.0: 0.86, 0.01: 0.84, 0.05: 0.75, 0.1: 0.66},
}
"""Share of the limit to reach, by direction and loss."""


TROUBLES = {
    "none": LinkSettings(),
    "reordered": LinkSettings(reorder=0.02),
    "doubled": LinkSettings(duplicate=0.01),
    "jittery": LinkSettings(jitter=0.05),
}
"""Links by what they do to frames besides losing them."""


@dataclass(frozen=True, slots=True)
class Case:
    """One measurement's conditions.

    rate in bytes/s, rtt in seconds, loss 0..1 each way; trouble: a name of TROUBLES.
    """

    profile: str
    rate: float
    rtt: float
    loss: float
    direction: Direction = "read"
    trouble: str = "none"

    @property
    def limit(self) -> float:
        """Bytes per second that could be read or written at best, were all pauses of a card alike."""
        profile = PROFILES[self.profile]
        return self.limit_beside([profile.stall_chance * sum(profile.stall) / 2] * 1000)

    def limit_beside(self, pauses: Sequence[float]) -> float:
        """Return the same where the card made one request after the other wait for so many seconds."""
        limit = self.rate * MAX_DATA / FRAME * (1 - self.loss)
        if self.profile.startswith(("ardupilot", "littlefs")):
            # What a lone request takes from the moment it is handed to the link until it is answered.
            answered = self.rtt + ARDUPILOT_POLL + (FRAME + SMALL_FRAME) / self.rate
            ceiling = ARDUPILOT_WINDOW * MAX_DATA / answered
            if self.direction == "read":
                ceiling = max(ceiling, min(ARDUPILOT_BURST, self.rate / 3))
            limit = min(limit, ceiling)
        profile = PROFILES[self.profile]
        if profile.family is not Family.PX4:
            return limit
        link = MAX_DATA / limit
        if not any(pauses):
            return MAX_DATA / max(link, profile.request_cost)
        pause = sum(pauses) / len(pauses)
        if self.direction == "read":
            return MAX_DATA / self._answered(pauses, link)
        # What a full link brings meanwhile is lost, but for what the server's input buffer holds.
        held = profile.stall_chance * (profile.rx_buffer // FRAME) * link
        return MAX_DATA / max(link + max(0.0, pause - held), profile.request_cost + pause)

    def _answered(self, pauses: Sequence[float], link: float) -> float:
        """Return seconds for each answer where the server always has work, but while so many of them wait."""
        most = min(WAITING + self.rtt, MOST_WAITING)
        cost = PROFILES[self.profile].request_cost
        answered = brought = 0.0
        for pause in pauses:
            answered = max(answered, brought - most) + cost + pause
            brought = max(brought, answered) + link
        return brought / len(pauses)

    @property
    def target(self) -> float | None:
        """The share of the limit to reach here, None for a loss that has no target."""
        return TARGETS[self.direction].get(self.loss)


@dataclass(frozen=True, slots=True)
class Result:
    """limit: the case's, with the pauses that the card really made. share: goodput over it. requests: per
    chunk of data. dropped: frames that found the link's queue full, both ways, and
    replies that the server threw away because they would have."""

    case: Case
    limit: float
    share: float
    requests: float
    dropped: int
