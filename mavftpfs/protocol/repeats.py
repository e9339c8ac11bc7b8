"""Second answers that are no news of the path: we asked twice. Layer: protocol; pure.

Whoever asks again while a card is busy, or a queue is long, is answered twice, and each copy that could do
harm was executed before anything that was sent later. Only an answer beyond those, or one that newer requests
overtook, tells that the path doubles, holds back or mixes what it carries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

from mavftpfs.protocol.requests import WORKING, Request, Transmission

_MOST = 1024
_LATER = 2.0
"""Times as long as the answer that came took: what takes longer was held back, though nothing overtook it."""


@dataclass(slots=True)
class _Rest:
    """What is still to come of one request. left: answers; patience: seconds for each; works: they may come
    after those to newer ones."""

    sent: dict[int, Transmission]
    left: int
    patience: float
    works: bool


class Repeats:
    """Knows which answers are still to come. overtaken: whether a newer request than those sent then was
    answered by now."""

    __slots__ = ("_overtaken", "_rests")

    def __init__(self, overtaken: Callable[[float], bool]) -> None:
        self._overtaken = overtaken
        self._rests: dict[int, _Rest] = {}

    def on_answered(self, request: Request, answered: int, now: float) -> None:
        """A request that was sent more than once is answered, under this seq."""
        sent, since = _transmissions(request), request.first_sent
        if sent[answered].single:  # else nobody knows which of them this answers
            since = sent.pop(answered).sent_at
        self._note(_Rest(sent, request.sends - 1, _LATER * (now - since), _works(request)))

    def on_given_up(self, request: Request) -> None:
        """Nobody waits for the answers to a request any more; none came."""
        if request.sends:
            self._note(_Rest(_transmissions(request), request.sends, inf, _works(request)))

    def _note(self, rest: _Rest) -> None:
        for answer in rest.sent:
            self._rests.pop(answer, None)
            self._rests[answer] = rest
        while len(self._rests) > _MOST:
            del self._rests[next(iter(self._rests))]

    def explain(self, answer: int, now: float) -> bool:
        """Return whether an answer that nobody waits for was to come, and comes in its turn."""
        rest = self._rests.get(answer)
        if rest is None or rest.left == 0:
            return False
        sent = rest.sent[answer]
        rest.left -= 1
        if sent.single:
            del self._rests[answer]
        if rest.works:
            return True
        return not self._overtaken(sent.sent_at) and now - sent.sent_at <= rest.patience


def _works(request: Request) -> bool:
    return request.manner.family in WORKING


def _transmissions(request: Request) -> dict[int, Transmission]:
    """Return them by the seq of their answers."""
    sent = dict(request.aliases or {})
    sent[request.seq + 1] = Transmission(request.order, request.sent_at, request.single, request.outrun)
    return sent
