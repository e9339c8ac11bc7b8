"""How much wider a window has to be where answers come in bunches. Layer: protocol; pure.

There the usual round trip is longer than the least, by the time it takes to gather them, by what each
packet is held up (Wi-Fi), or because many come late and out of order: the window that fills the way only
without that fills a third of it, brings a third of the rate, and so stays. What is too much of a wider one
waits in a queue for so long, or overflows a short one: so it grows step by step, and gives way where more is
lost than with a narrower one lately.
"""

from __future__ import annotations

from collections import deque

from mavftpfs.protocol.trains import FASTEST_LINK

MOST = 2.0
"""Times the window that fills the way by its least round trip."""

SECONDS = 0.05
"""Of answers, at most."""

_STEP = 0.2
_CUT = 0.85
_MORE_LOSS = 0.05
_SMOOTHING = 0.4
_ROUNDS_REMEMBERED = 48


class Widening:
    """Watches the losses of rounds and widens a window as far as they allow.

    Attributes:
        share: of the most that may be added.
    """

    __slots__ = ("_loss", "_losses", "share")

    def __init__(self) -> None:
        self.share = 0.0
        self._loss = 0.0
        self._losses: deque[float] = deque(maxlen=_ROUNDS_REMEMBERED)

    def end_round(self, answered: int, lost: int, *, bunched: bool) -> None:
        """A round with always something to send is over; bunched: answers came, but not all the time."""
        loss = lost / (answered + lost)
        self._loss += (loss - self._loss) * (_SMOOTHING if self._losses else 1.0)
        self._losses.append(self._loss)
        if not bunched:
            self.share = 0.0
        elif self._loss > min(self._losses) + _MORE_LOSS:
            self.share *= _CUT
        else:
            self.share = min(1.0, self.share + _STEP)

    def window(self, held: float, rate: float) -> float:
        """Return a window for a way that holds so many by its least round trip; rate: answers a second."""
        if rate > FASTEST_LINK:
            return held
        return held + self.share * min(MOST * held, rate * SECONDS)
