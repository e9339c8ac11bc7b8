"""How much narrower a window has to be for congestion that is not ours. Layer: protocol; pure."""

from __future__ import annotations

_LEAST = 0.4
_FALL = 0.7
_RISE = 1.05


class Brake:
    """Falls quickly and rises slowly.

    Attributes:
        factor: of the window, 0.4..1.
    """

    __slots__ = ("factor",)

    def __init__(self) -> None:
        self.factor = 1.0

    def end_round(self, *, congested: bool) -> None:
        """A round is over; congested: it lost requests while even its quickest answer was late."""
        self.factor = max(_LEAST, self.factor * _FALL) if congested else min(1.0, self.factor * _RISE)
