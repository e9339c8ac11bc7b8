"""The vehicles of a mount of all of them, and their states. Layer: mount; pure.

A vehicle is known by its system id.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Heartbeat
from mavftpfs.shared.errors import ExitCode

HEARD_LATELY = 10.0
"""Seconds after its last heartbeat for which starting a vehicle's mount is worthwhile."""
PAUSE = 5.0
"""Seconds before a failed mount is started again."""
MOST = 64
"""The most vehicles of one mount, because any program can send heartbeats with any id."""


class MemberState(Enum):
    """The state of a vehicle's own mount."""

    HEARD = "heard"
    STARTING = "starting"
    MOUNTED = "mounted"
    FAILED = "failed"
    UNMOUNTED = "unmounted"


NEXT = {
    MemberState.HEARD: {MemberState.STARTING},
    MemberState.STARTING: {MemberState.MOUNTED, MemberState.FAILED, MemberState.UNMOUNTED},
    MemberState.MOUNTED: {MemberState.FAILED, MemberState.UNMOUNTED},
    MemberState.FAILED: {MemberState.STARTING},
    MemberState.UNMOUNTED: set(),
}
"""State -> the states that may follow. A mount that the user ended stays ended."""


@dataclass(slots=True)
class Member:
    """A vehicle. problem: why its mount failed, or "". due_at: the time when its mount is started again."""

    system: int
    state: MemberState = MemberState.HEARD
    heard_at: float = float("-inf")
    due_at: float = float("-inf")
    problem: str = ""

    @property
    def name(self) -> str:
        """The name of its directory: its system id."""
        return str(self.system)

    def _go_to(self, state: MemberState) -> None:
        assert state in NEXT[self.state], (self.state, state)
        self.state = state

    def start(self) -> None:
        """Note that its mount is being started."""
        self._go_to(MemberState.STARTING)

    def mounted(self) -> None:
        """Note that its mount is up."""
        self._go_to(MemberState.MOUNTED)
        self.problem = ""

    def ended(self, code: int, problem: str, now: float) -> None:
        """Note that its mount's process ended, with an exit code."""
        if code in (ExitCode.OK, ExitCode.UNDELIVERED):  # it was unmounted
            self._go_to(MemberState.UNMOUNTED)
            return
        self._go_to(MemberState.FAILED)
        self.problem = problem
        self.due_at = now + PAUSE


class Members:
    """The vehicles of one mount, in the order of their system ids."""

    def __init__(self) -> None:
        self._members: dict[int, Member] = {}

    def __iter__(self) -> Iterator[Member]:
        return iter(sorted(self._members.values(), key=lambda member: member.system))

    def __len__(self) -> int:
        return len(self._members)

    def hear(self, heartbeat: Heartbeat, now: float) -> None:
        """Note a heartbeat. An autopilot's heartbeat makes its vehicle known, unless there are too many."""
        system = heartbeat.source.system
        is_new = system not in self._members and heartbeat.autopilot != MAV_AUTOPILOT_INVALID
        if system and is_new and len(self._members) < MOST:
            self._members[system] = Member(system)
        if system in self._members:
            self._members[system].heard_at = now

    def due(self, now: float) -> list[Member]:
        """Return the vehicles whose mount is due now."""
        return [
            member
            for member in self
            if member.state in (MemberState.HEARD, MemberState.FAILED)
            and member.due_at <= now
            and now - member.heard_at <= HEARD_LATELY
        ]
