"""Do losses come from too wide a window? Layer: protocol; pure.

A buffer that overflows at the far end (PX4's serial input, servers.md 3) loses requests without making
anything slower, which looks like a bad radio. So while much is lost, the window is narrowed now and then
for the requests of one round: if clearly fewer of *those* are lost, it was too wide, and a ceiling is
put on it, which rises again while there is no such evidence.
"""

from __future__ import annotations

from math import inf, sqrt

_WORTH_KNOWING = 0.08
_ROUNDS_BETWEEN = 24
_FIRST_AFTER = 6
_NARROWED = 0.7
_RISE = 1.25
_LEAST = 4.0
_AS_MANY = 0.9


class Easing:
    """Plans eased rounds and judges them.

    Attributes:
        ceiling: the widest window that seems to be survived.
        until: only transmissions with a smaller order count; those sent while eased.
    """

    __slots__ = ("_answered", "_eased", "_from", "_lost", "_usual", "_wait", "ceiling", "until")

    def __init__(self) -> None:
        self.ceiling = inf
        self._wait = _FIRST_AFTER
        self._from = self.until = -1
        self._eased = 0.0
        self._usual = 0.0
        self._answered = 0
        self._lost = 0

    def count(self, order: int, *, lost: bool) -> None:
        """A transmission was answered or lost."""
        if self._from <= order < self.until:
            if lost:
                self._lost += 1
            else:
                self._answered += 1

    def next_window(self, target: float, loss: float, next_order: int) -> float:
        """Return the window for the next round, which wants to be `target`; called once a round.

        loss: the usual share of losses. next_order: number of the next transmission.
        """
        self._wait -= 1
        if self._wait == -1:
            self.until = next_order
        elif self._wait == -3:
            self._judge(loss)
            self._wait = _ROUNDS_BETWEEN
        target = min(target, self.ceiling)
        if self._wait == 0:
            if loss < _WORTH_KNOWING:
                self._wait = 1
                self.ceiling *= _RISE
                return target
            self._from, self.until = next_order, 1 << 62
            self._answered = self._lost = 0
            self._usual = target
            target *= _NARROWED
            self._eased = target
        return target

    def _judge(self, loss: float) -> None:
        sample = self._answered + self._lost
        if sample == 0:
            return
        share = self._lost / sample
        doubt = 1.5 * sqrt(share * (1 - share) / sample) + 1 / sample
        # Losses also come in gusts, while a card writes, and a round between two of them looks innocent. A
        # buffer that is too short answers as many of a narrow window; where fewer were, narrowing only costs.
        as_many = self._answered >= _AS_MANY * self._usual * (1 - loss)
        if as_many and share + doubt < 0.8 * loss:
            self.ceiling = max(_LEAST, self._eased)
        else:
            self.ceiling *= _RISE
