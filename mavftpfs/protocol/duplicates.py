"""Answers that fit nothing outstanding: repetitions of ours, or the network's. Layer: protocol; pure.

Whoever asks twice may be answered twice. Any further answer means that the network delivered a request, or
its answer, more than once, so that a request may be carried out once more at any time.
"""

from __future__ import annotations

from mavftpfs.protocol.requests import Request

_MOST = 1024
"""Requests that are remembered; a window holds fewer."""


class DuplicateDetector:
    """Knows which answers are still to come, and when requests that change names went out.

    Answers are known by their seq, which is the request's plus one.
    """

    __slots__ = ("_expected", "_sent")

    def __init__(self) -> None:
        self._expected: dict[int, int] = {}
        self._sent: dict[int, float] = {}

    def on_sent(self, request: Request, now: float) -> None:
        """A request went out; the first time counts for one that keeps its seq."""
        if request.manner.same_seq:
            if request.sends == 1:
                self._sent.pop(request.seq + 1, None)
            self._sent.setdefault(request.seq + 1, now)
            _shorten(self._sent)

    def on_answered(self, request: Request, seq: int) -> None:
        """A request is answered under this seq."""
        if request.sends > 1:
            self._expect(request, seq)

    def on_given_up(self, request: Request) -> None:
        """Nobody waits for the answers to a request any more."""
        if request.sends:
            self._expect(request, -1)

    def explains(self, seq: int) -> bool:
        """Return whether an answer that nobody waits for was still to come; it is not expected again."""
        left = self._expected.get(seq, 0)
        if left > 1:
            self._expected[seq] = left - 1
        else:
            self._expected.pop(seq, None)
        return left > 0

    def late_by(self, seq: int, now: float) -> float:
        """Return the seconds since the request with this answer went out first; 0 if that is not known."""
        return now - self._sent.get(seq, now)

    def _expect(self, request: Request, answered: int) -> None:
        seqs = {request.seq + 1, *(request.aliases or ())}
        for seq in seqs:
            # With several seqs nobody knows how often each was sent.
            left = request.sends - (len(seqs) - 1) - (seq == answered)
            if left > 0:
                self._expected.pop(seq, None)
                self._expected[seq] = left
        _shorten(self._expected)


def _shorten(remembered: dict[int, int] | dict[int, float]) -> None:
    while len(remembered) > _MOST:
        del remembered[next(iter(remembered))]
