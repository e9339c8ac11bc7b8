"""Which program a request of the kernel is from. Layer: mount."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_GROUP, _STARTED = b"Tgid:", 19
"""A line of /proc/PID/status, and the place of the start time among the fields behind the name in stat."""


@dataclass(frozen=True, slots=True)
class Process:
    """A process, told from all others, also from a later process with its number, by its start time."""

    number: int
    started: int

    def ended(self) -> bool:
        """Return whether it ended."""
        return program_of(self.number) != self


def program_of(thread: int) -> Process | None:
    """Return a thread's process; None if it cannot be seen here (another container's)."""
    folder = Path(f"/proc/{thread}")
    try:
        lines = (folder / "status").read_bytes().splitlines()
        group = next(int(line.split()[1]) for line in lines if line.startswith(_GROUP))
        fields = (Path(f"/proc/{group}") / "stat").read_bytes().rpartition(b")")[2].split()
        return Process(group, int(fields[_STARTED]))
    except (OSError, ValueError, StopIteration, IndexError):
        return None
