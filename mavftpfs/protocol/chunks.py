"""How many bytes to ask for at once, where long frames are lost more than short ones. Layer: protocol; pure.

Theory. Full chunks are best up to losses that nobody flies with, and nothing else is asked for until there is
a suspicion: two of five were lost for long, or nothing was answered for a second. Then short ones are *tried
beside* long ones, in turn, so that both meet the same link. If no long one passes while short ones do, the
link has a limit, which is found by halving. Else the two shares of losses give the damage to each byte, and
that the size which brings most. A smaller size is never final: the full one is tried beside short ones again
and again, ever more seldom while that changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp, inf, log, sqrt

from mavftpfs.protocol.payload import MAX_DATA

SMALLEST = 32
"""Bytes; about as long as a path, so where these do not pass no file can be opened either."""

OVERHEAD = 27
"""Bytes of a frame beside its data."""

_BLOCK = 50
_BLOCK_SECONDS = 2.0
_BAD = 0.4
"""The share of losses, beyond a fifth each way, from which on smaller chunks may bring a tenth more."""

_SUSPICIOUS = 0.8
"""The sum of what blocks lost more than that."""

_SILENCES = ((12, 1.0), (6, 3.0))
"""So many losses in a row over so many seconds: of a window, or of a single request."""

_PROVEN = 4
_STUCK = 8
_ENOUGH, _ENOUGH_AGAIN, _ENOUGH_OF_SEARCH = 120, 60, 24
"""Requests of each size that tell their losses: at first, later, and whether longer ones pass, too."""

_NEAR = 16
_WORTH = 1.05
_COST, _NARROW_COST = 1.25, 2.0
"""A loss costs more than its bytes: a place in the window for a while, and waiting where there are few."""

_FIRST_HOLD, _LONGEST_HOLD = 30.0, 480.0


class _Tally:
    __slots__ = ("answered", "lost")

    def __init__(self) -> None:
        self.answered = self.lost = 0

    @property
    def total(self) -> int:
        return self.answered + self.lost

    @property
    def passed(self) -> float:
        return self.answered / self.total

    @property
    def doubt(self) -> float:
        """The variance of the logarithm of `passed`."""
        return self.lost / (self.answered * self.total)


class Chunks:
    """The size of chunks of one direction, for all its transfers.

    roomy: whether more requests may be on their way than now; else their number is the limit, and a smaller
    chunk must make up for its size by its losses alone. explained: the share of what is sent that is lost for
    another reason: in the pauses of a card its buffer overflows, whatever the size.

    Attributes:
        size: bytes to ask for at once, as far as it is settled.
    """

    __slots__ = (
        "_again_at",
        "_block_at",
        "_explained",
        "_hi",
        "_hold",
        "_large",
        "_lo",
        "_longest",
        "_roomy",
        "_score",
        "_seen",
        "_settled",
        "_silent",
        "_silent_since",
        "_small",
        "_stuck",
        "_tried",
        "_turn",
        "_unheard",
        "size",
    )

    def __init__(
        self, roomy: Callable[[], bool] = lambda: True, explained: Callable[[], float] = lambda: 0.0
    ) -> None:
        self.size = self._settled = MAX_DATA
        self._roomy, self._explained = roomy, explained
        self._tried = 0  # the size that is tried beside the smallest; 0: none is
        self._turn = self._silent = False
        self._lo, self._hi = SMALLEST, MAX_DATA + 1  # passes; never does
        self._small, self._large = _Tally(), _Tally()
        self._stuck = 0
        self._seen, self._block_at = _Tally(), 0.0
        self._score = 0.0
        self._unheard, self._silent_since, self._longest = 0, 0.0, 0
        self._hold, self._again_at = _FIRST_HOLD / 3, -inf

    @property
    def trying(self) -> bool:
        """Whether each request is to have a size of its own."""
        return self._tried > 0

    def next_size(self, now: float) -> int:
        """Return the size of the next chunk."""
        if not self._tried:
            if self.size == MAX_DATA or now < self._again_at:
                return self.size
            self._search(self.size, MAX_DATA + 1, MAX_DATA)
        self._turn = not self._turn
        return self._tried if self._turn else SMALLEST

    def on_answered(self, size: int, count: int, now: float) -> None:
        """So many requests for `size` bytes each were answered."""
        self._unheard = 0
        if not self._tried:
            if self.size == MAX_DATA:
                self._watch(count, now)
            return
        if size <= SMALLEST:
            self._small.answered += count
        elif size == self._tried:
            self._large.answered += count
        self._judge(now)

    def on_lost(self, size: int, now: float) -> bool:
        """A request for `size` bytes is to be repeated now; return whether it is to be split."""
        self._turn = size > SMALLEST  # the other one is next, also where there is one request at a time
        if not self._tried:
            self._seen.lost += 1
            if size > SMALLEST:
                self._note_silence(size, now)
        elif size <= SMALLEST:
            self._small.lost += 1
        elif size <= self._tried and self._small.answered:  # before, there may be no link
            self._stuck += 1
            self._large.lost += size == self._tried
        return size > (SMALLEST if self._tried else self.size)

    # --- suspicion

    def _watch(self, count: int, now: float) -> None:
        seen = self._seen
        if not seen.answered:
            self._block_at = now
        seen.answered += count
        if seen.total < _BLOCK or now - self._block_at < _BLOCK_SECONDS:
            return
        beyond = seen.lost / seen.total - _BAD - self._explained()
        self._score = min(_SUSPICIOUS, max(0.0, self._score + beyond))
        self._seen = _Tally()
        if self._score >= _SUSPICIOUS and now >= self._again_at:
            self._search(SMALLEST, MAX_DATA + 1, MAX_DATA)

    def _note_silence(self, size: int, now: float) -> None:
        if not self._unheard:
            self._silent_since, self._longest = now, size
        self._unheard += 1
        self._longest = max(self._longest, size)
        silence = now - self._silent_since
        if any(self._unheard >= count and silence >= seconds for count, seconds in _SILENCES):
            self._search(SMALLEST, self._longest + 1, self._longest)
            self._silent = True

    # --- trying

    def _search(self, lo: int, hi: int, size: int) -> None:
        """Try `size` beside the smallest; lo: passes, hi: does not."""
        self._lo, self._hi, self._tried = lo, hi, size
        self._small, self._large = _Tally(), _Tally()
        self._stuck = 0
        self._silent = False

    def _judge(self, now: float) -> None:
        small, large = self._small, self._large
        if not large.answered:
            if self._stuck >= _STUCK and small.answered >= _PROVEN:
                self._go_on(self._lo, self._tried, now)
        elif self._silent:  # it was the link that was gone
            self._end()
        elif min(small.total, large.total) >= self._enough():
            self._on_measured(now)

    def _enough(self) -> int:
        if self._hi <= MAX_DATA:
            return _ENOUGH_OF_SEARCH
        return _ENOUGH if self.size == MAX_DATA else _ENOUGH_AGAIN

    def _on_measured(self, now: float) -> None:
        tried, roomy = self._tried, self._roomy()
        damage = _damage(self._small, self._large, sure=self._settled == MAX_DATA) / (tried - SMALLEST)
        best = min(tried, best_size(damage, roomy=roomy))
        if _brings(best, damage, roomy=roomy) >= _WORTH * _brings(tried, damage, roomy=roomy):
            self._settle(best, now)
        elif tried == MAX_DATA:
            self._settle(tried, now)
        else:
            self._go_on(tried, self._hi, now)

    def _go_on(self, lo: int, hi: int, now: float) -> None:
        """Look for the longest one between a size that passes and one that does not."""
        self.size = lo = min(lo, hi - 1)
        if hi - lo <= _NEAR:
            self._settle(lo, now)
        else:
            self._search(lo, hi, (lo + hi) // 2)

    def _settle(self, size: int, now: float) -> None:
        recovered = self._settled < size == MAX_DATA
        self._hold = _FIRST_HOLD if recovered else min(3 * self._hold, _LONGEST_HOLD)
        self.size = self._settled = size
        self._again_at = now + self._hold
        self._end()

    def _end(self) -> None:
        self._tried = self._unheard = 0
        self._seen, self._score = _Tally(), 0.0


def _damage(small: _Tally, large: _Tally, *, sure: bool) -> float:
    """Return what more bytes take from the logarithm of the share that passes; sure: at least, probably."""
    if not small.answered or not large.answered:
        return 0.0
    doubt = sqrt(small.doubt + large.doubt) if sure else 0.0
    return max(0.0, log(small.passed / large.passed) - doubt)


def best_size(damage: float, *, roomy: bool) -> int:
    """Return which chunk brings most where each byte is damaged with this probability."""
    if damage <= 0.0:
        return MAX_DATA
    half = OVERHEAD / 2
    best = sqrt(half * half + OVERHEAD / (_COST * damage)) - half if roomy else 1 / (_NARROW_COST * damage)
    return int(max(SMALLEST, min(best, MAX_DATA)))


def _brings(size: int, damage: float, *, roomy: bool) -> float:
    """Return how much of a file a chunk brings: per byte on the link, or per request."""
    cost = _COST if roomy else _NARROW_COST
    return exp(-cost * damage * size) * (size / (size + OVERHEAD) if roomy else size)
