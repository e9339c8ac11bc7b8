"""The tries of a session user since its last progress, and the time of the next. Layer: session; pure.

Progress is a byte that arrived, or was ACKed, for the first time. A user fails if it made none for
`op_deadline` from the beginning of its first turn without progress.
"""

from __future__ import annotations

from math import inf

from mavftpfs.shared.errors import MavftpfsError, RequestTimeout, SessionLost

LEAST_PAUSE = 0.1
"""Seconds after a second lost session before a third is begun."""


class Tries:
    """The turns of one user since its last progress.

    Attributes:
        retry_at: the user waits for no turn before.
    """

    def __init__(self) -> None:
        self.begin_anew()

    def begin_anew(self, retry_at: float = -inf) -> None:
        """Forget the turns so far: there was progress or new work, or the caller was told of the failure."""
        self.retry_at = retry_at
        self._began: float | None = None  # when the first of them began
        self._loss: MavftpfsError | None = None

    def on_turn(self, now: float) -> None:
        """Note that a turn begins now."""
        if self._began is None:
            self._began = now

    def on_lost(self, lost: SessionLost, now: float, op_deadline: float) -> None:
        """Note that a turn ended because its session was lost. The user tries again at once. After a second
        loss without progress it pauses as long as its tries have failed, at least LEAST_PAUSE: each pause
        doubles that time."""
        self.on_turn(now)
        if self._loss is not None:
            failing = self.barren_for(now)
            self.retry_at = now + max(LEAST_PAUSE, min(failing, op_deadline - failing))
        cause = lost.__cause__
        self._loss = cause if isinstance(cause, MavftpfsError) else lost

    def barren_for(self, now: float) -> float:
        """Return how long ago the first of them began; 0 if none did."""
        return 0.0 if self._began is None else now - self._began

    def failure(self, now: float, op_deadline: float) -> MavftpfsError | None:
        """Return the error of a user that made no progress for `op_deadline`."""
        if self.barren_for(now) < op_deadline:
            return None
        return self._loss or RequestTimeout(f"no progress for {op_deadline:g} s")
