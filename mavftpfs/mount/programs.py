"""Which program a request of the kernel is from. Layer: mount."""

from __future__ import annotations

from pathlib import Path

_GROUP, _STARTED = b"Tgid:", 19
"""A line of /proc/PID/status, and the place of the start time among the fields behind the name in stat."""


def program_of(thread: int) -> tuple[int, int] | None:
    """Return what tells a thread's process from all others, also from a later process with its number; None
    if it cannot be seen here (another container's).
    """
    folder = Path(f"/proc/{thread}")
    try:
        lines = (folder / "status").read_bytes().splitlines()
        group = next(int(line.split()[1]) for line in lines if line.startswith(_GROUP))
        fields = (Path(f"/proc/{group}") / "stat").read_bytes().rpartition(b")")[2].split()
        return group, int(fields[_STARTED])
    except (OSError, ValueError, StopIteration, IndexError):
        return None
