"""The program behind a request of the kernel. Layer: mount."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_GROUP, _STARTED = b"Tgid:", 19
"""A line of /proc/PID/status, and the place of the start time among the fields behind the name in stat."""


@dataclass(frozen=True, slots=True)
class Process:
    """A process, identified by its start time, because a later process may have its number."""

    number: int
    started: int

    def ended(self) -> bool:
        """Return whether it ended."""
        return program_of(self.number) != self


def program_of(thread: int) -> Process | None:
    """Return a thread's process; None if it is invisible here (another container's)."""
    folder = Path(f"/proc/{thread}")
    try:
        lines = (folder / "status").read_bytes().splitlines()
        group = next(int(line.split()[1]) for line in lines if line.startswith(_GROUP))
        fields = (Path(f"/proc/{group}") / "stat").read_bytes().rpartition(b")")[2].split()
        return Process(group, int(fields[_STARTED]))
    except (OSError, ValueError, StopIteration, IndexError):
        return None
