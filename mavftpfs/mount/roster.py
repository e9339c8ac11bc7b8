"""Which vehicles a mount of all of them has, and in which state each is. Layer: mount; pure.

A vehicle is known by its system id; another part of it than the autopilot by both ids. A name never
disappears, so that no program takes a lost vehicle for an empty directory.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Heartbeat
from mavftpfs.shared.errors import ExitCode

FIRST_INO = 2
"""1 is the root's."""
HEARD_LATELY = 10.0
"""Seconds after its last heartbeat in which a vehicle's mount is worth starting."""
FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
"""Seconds before a mount that failed is started again; doubled each time."""
MOST = 64
"""Vehicles of one mount. A limit, because any program can send heartbeats with any id."""

_NAME = re.compile(rb"([1-9][0-9]{0,2})(?:-([1-9][0-9]{0,2}))?")


class MemberState(Enum):
    """What a vehicle's own mount is doing."""

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
    """A vehicle, or a part of one. component: 0 = its autopilot. ino: its directory's number.

    problem: why its mount failed, or "". due_at: when it is started again.
    """

    system: int
    component: int
    ino: int
    state: MemberState = MemberState.HEARD
    heard_at: float = float("-inf")
    due_at: float = float("-inf")
    pause: float = FIRST_PAUSE
    problem: str = ""

    @property
    def name(self) -> str:
        """The name of its directory: `1`, or `1-100`."""
        return f"{self.system}-{self.component}" if self.component else str(self.system)

    def _go_to(self, state: MemberState) -> None:
        assert state in NEXT[self.state], (self.state, state)
        self.state = state

    def start(self) -> None:
        """Its mount is being started."""
        self._go_to(MemberState.STARTING)

    def mounted(self) -> None:
        """Its mount is up."""
        self._go_to(MemberState.MOUNTED)
        self.pause, self.problem = FIRST_PAUSE, ""

    def ended(self, code: int, problem: str, now: float) -> None:
        """Its mount's process ended, with an exit code."""
        if code in (ExitCode.OK, ExitCode.UNDELIVERED):  # it was unmounted
            self._go_to(MemberState.UNMOUNTED)
            return
        self._go_to(MemberState.FAILED)
        self.problem = problem
        self.due_at = now + self.pause
        self.pause = min(self.pause * 2, LONGEST_PAUSE)


def parse_name(name: bytes) -> tuple[int, int] | None:
    """Return the system and component of a directory's name, None if it names none."""
    found = _NAME.fullmatch(name)
    if found is None:
        return None
    system, component = int(found[1]), int(found[2] or 0)
    return (system, component) if system <= 255 and component <= 255 else None


class Roster:
    """The vehicles of one mount."""

    def __init__(self) -> None:
        self._members: dict[tuple[int, int], Member] = {}

    def __iter__(self) -> Iterator[Member]:
        return iter(list(self._members.values()))

    def __len__(self) -> int:
        return len(self._members)

    def find(self, system: int, component: int) -> Member | None:
        """Return the vehicle, or the part of one, with these ids."""
        return self._members.get((system, component))

    def at(self, ino: int) -> Member | None:
        """Return the vehicle whose directory has a number."""
        return next((member for member in self if member.ino == ino), None)

    def hear(self, heartbeat: Heartbeat, now: float) -> None:
        """Note a heartbeat: an autopilot's makes its vehicle known."""
        system = heartbeat.source.system
        if system and heartbeat.autopilot != MAV_AUTOPILOT_INVALID:
            self.add(system, 0)
        for member in self:
            if member.system == system:
                member.heard_at = now

    def add(self, system: int, component: int) -> Member | None:
        """Return the vehicle, or the part of one, added if it was not known; None if there are too many."""
        member = self._members.get((system, component))
        if member is None and len(self._members) < MOST:
            member = Member(system, component, FIRST_INO + len(self._members))
            self._members[system, component] = member
        return member

    def due(self, now: float) -> list[Member]:
        """Return those whose mount is to be started now."""
        return [
            member
            for member in self
            if member.state in (MemberState.HEARD, MemberState.FAILED)
            and member.due_at <= now
            and now - member.heard_at <= HEARD_LATELY
        ]
