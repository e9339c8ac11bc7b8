"""How often a file was opened on the vehicle while it is open here. Layer: cache; pure."""

from __future__ import annotations

from dataclasses import dataclass

LEAST_PAUSE = 2.0
"""Seconds between two listings that only compare one file."""

COST_FACTOR = 50
"""Nor is it listed again before so many times what the last listing took: that costs 2 % of the link."""


@dataclass(slots=True)
class Openings:
    """The server's sessions on one version of a file: each may have found another file there.

    latest: when the present one was opened. count: how many there were. proven: the last of them that is
    known to have found the very file. look_at: when a listing may be asked for the next time.
    """

    latest: float = float("-inf")
    count: int = 0
    proven: int = 0
    look_at: float = float("-inf")

    @property
    def settled(self) -> bool:
        """Whether all that came is of one file."""
        return self.count == self.proven

    def on_opened(self, at: float, *, first: bool) -> None:
        """What comes from now on is of the file that was opened at that time; first: nothing came before."""
        if at != self.latest:
            self.latest = at
            self.count += 1
        if first:
            self.proven = self.count

    @property
    def doubted(self) -> bool:
        """Whether a listing shows what may be another file."""
        return self.proven < 0

    def on_doubted(self) -> None:
        """A listing shows what may be another file."""
        self.proven, self.look_at = -1, float("-inf")

    def on_compared(self, count: int, took: float, now: float) -> None:
        """A listing that began after the first `count` of them shows the file still."""
        self.proven = max(self.proven, count)
        self.look_at = now + max(LEAST_PAUSE, COST_FACTOR * took)
