"""Was more lost in a round than ever before? Layer: protocol; pure."""

from __future__ import annotations

from math import sqrt

_TELLING_LOSSES = 8
_DOUBT = 3


class Overflow:
    """Compares the losses of each round with those of all rounds before it."""

    __slots__ = ("_all", "_losses")

    def __init__(self) -> None:
        self._all = 0
        self._losses = 0

    def judge(self, answers: int, losses: int) -> bool:
        """Take the round that is over; return whether so much was lost that its window must be to blame."""
        total = answers + losses
        before = (self._losses + _DOUBT) / (self._all + 2 * _DOUBT)
        self._all += total
        self._losses += losses
        chance = _DOUBT * sqrt(total * before * (1.0 - before))
        return losses >= _TELLING_LOSSES and losses > (before + 0.1) * total + chance
