"""The size of chunks: bytes of a file in one request. Layer: protocol; pure.

A chunk is 239 bytes, the most that fits a payload. Some radios and modems pass short frames and drop all long
ones. So when every full chunk is lost for a while, full and short chunks alternate. If only the short
ones are answered, chunks stay short for five minutes; then full ones get another chance."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import MAX_DATA

SHORT = 64
"""Bytes of a short chunk: its frame is hardly longer than that of a request with a path, which must pass
too."""

SHORT_SECONDS = 300.0
"""Seconds for which chunks stay short."""

SUSPICIOUS_LOSSES = 12
SUSPICIOUS_SECONDS = 1.0
"""So many full chunks lost in a row, over a second, are no chance: one in 200,000 where a third of all round
trips fails. A card that pauses for a moment loses more, and short ones find room in its buffer where full
ones do not."""

LONE_LOSSES = 6
LONE_SECONDS = 3.0
"""Fewer will do over three seconds: with one request outstanding, twelve losses would take too long."""

PROOF = 8
"""So many answered short chunks, and lost full ones beside them, over a second, prove that only short ones
pass."""


class ChunkSize:
    """The size of chunks of one direction, for all its transfers.

    Args:
        fixed: the size that the user asked for, 1..239 bytes; None to choose it.

    Attributes:
        most: bytes of the longest chunk.
    """

    def __init__(self, fixed: int | None = None) -> None:
        self.most = MAX_DATA if fixed is None else fixed
        self._least = SHORT if fixed is None else fixed
        self.trying = False
        """Whether full and short chunks alternate, so that each request needs a size of its own."""
        self._short_until = inf  # chunks are short until then; inf: they are not
        self._lost = 0  # full chunks in a row; while trying: beside the short ones
        self._since = -inf  # requests sent before prove nothing more
        self._first_lost_at = 0.0
        self._shortest_lost = 0  # bytes: what is shorter proves nothing when it is answered
        self._answered = 0  # short chunks, while trying
        self._short_next = False

    @property
    def size(self) -> int:
        """Bytes of a chunk as far as that is settled."""
        return self.most if self._short_until == inf else self._least

    def next_size(self, now: float) -> int:
        """Return the bytes of the next chunk."""
        if self.trying:
            self._short_next = not self._short_next
            return self._least if self._short_next else self.most
        if now >= self._short_until:
            self._short_until = inf
        return self.size

    def on_answered(self, size: int, count: int, sent_at: float, now: float) -> None:
        """Note that `count` requests for `size` bytes each, sent then, were answered in time. Late answers
        prove nothing: a late server answers full ones, too, in the end."""
        if size > self._least:
            if size >= self._shortest_lost:
                self.trying, self._lost = False, 0
                self._since = max(self._since, sent_at)
        elif self.trying:
            if not self._answered:  # before that the whole link may have been away
                self._lost, self._since = 0, max(self._since, sent_at)
            self._answered += count
            self._judge_losses(now)

    def on_lost(self, size: int, sent_at: float, now: float) -> None:
        """Note that a request for `size` bytes, sent then, is lost."""
        if size > self._least and sent_at > self._since:
            if not self._lost:
                self._first_lost_at = now
                if not self.trying:
                    self._shortest_lost = size
            self._shortest_lost = min(self._shortest_lost, size)
            self._lost += 1
            self._short_next = False  # a short one is next, also where there is one request at a time
            self._judge_losses(now)

    def _judge_losses(self, now: float) -> None:
        """Try short chunks if long ones are lost; use short ones once they proved to come through."""
        seconds = now - self._first_lost_at
        if seconds < SUSPICIOUS_SECONDS:
            return
        if self.trying:
            if self._answered >= PROOF and self._lost >= PROOF:
                self.trying, self._short_until = False, now + SHORT_SECONDS
                self._lost, self._since = 0, now  # long ones are still in flight
        elif self._lost >= SUSPICIOUS_LOSSES or (self._lost >= LONE_LOSSES and seconds >= LONE_SECONDS):
            self.trying, self._answered = True, 0
