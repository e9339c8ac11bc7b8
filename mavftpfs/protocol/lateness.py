"""How much later than newer ones a path delivers what it doubled or held back. Layer: protocol; pure.

Where two ways lead to one vehicle, or a modem repeats by itself, a copy of a request may come seconds after
the first. Its answer, which nobody waits for, tells: it was overtaken by the answer to what was sent behind
it, and since then it is late. What only had to wait (for a slow card, in a queue) was not overtaken.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from math import inf

LONGEST = 10.0
"""Seconds; what seems to be later is no copy, but an answer of others under a seq of ours."""

MEMORY = 600.0
"""Seconds after which a path may have become better."""

_GENERATION = 1024
"""Requests; between one and two generations of them are remembered."""

_REUSED = 61_440
"""Seqs later the same ones may have been used again (65535 there are, a few are left out)."""


class Lateness:
    """Knows when what was sent, and since when newer requests are answered."""

    __slots__ = ("_answered", "_at", "_longest", "_old", "_passed", "_young")

    def __init__(self) -> None:
        self._young: dict[int, tuple[float, int]] = {}
        self._old: dict[int, tuple[float, int]] = {}
        self._passed = 0
        self._answered: deque[tuple[float, float]] = deque(maxlen=_GENERATION)
        self._longest = 0.0
        self._at = -inf

    def on_passed(self, count: int) -> None:
        """So many seqs were used, or left out."""
        self._passed += count

    def on_sent(self, answer: int, now: float) -> None:
        """A request went out (again) whose answer has this seq."""
        self._young[answer] = now, self._passed
        if len(self._young) >= _GENERATION:
            self._old, self._young = self._young, {}

    def on_answered(self, sent_at: float, now: float) -> None:
        """What was sent then is answered."""
        answered = self._answered
        if not answered or sent_at > answered[-1][0]:
            answered.append((sent_at, now))

    def on_stray(self, answer: int, now: float) -> None:
        """An answer came that nobody waited for (any more)."""
        sent_at, passed = self._young.get(answer) or self._old.get(answer) or (inf, 0)
        if self._passed - passed >= _REUSED or not self.overtaken(sent_at):
            return
        late = now - self._answered[bisect_right(self._answered, (sent_at, inf))][1]
        if late <= LONGEST and (late >= self._longest or now - self._at > MEMORY):
            self._longest, self._at = late, now

    def overtaken(self, sent_at: float) -> bool:
        """Return whether something was answered that was sent later than that."""
        return bool(self._answered) and self._answered[-1][0] > sent_at

    def seen(self, now: float) -> float:
        """Return the most seconds by which anything was late lately."""
        return self._longest if now - self._at <= MEMORY else 0.0
