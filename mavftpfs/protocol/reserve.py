"""How many answers to keep in the link's queue, for the pauses of a server. Layer: protocol; pure.

A card that is busy for a tenth of a second (PX4 on NuttX) leaves a slow link idle for as long, unless
answers wait in the link's queue. So from the first such pause on some more requests are kept on the way,
up to 0.25 s and a round trip worth, which is what others then wait for the link at most; fewer while others
are about, and fewer again when pauses have become rare.

Where the server and not the link is the slowest part (USB), no answers wait in a link, and more requests
only overflow the server's buffer; and a link's queue may be short, too. So it begins with few, and there
are never many more than were seen to wait: what waits makes each answer as much later, what is lost does
not. Where a large buffer of the server holds them, pauses take as long as without, which ends it as well.
"""

from __future__ import annotations

from math import inf

MOST = 0.25
_MOST_ON_A_LONG_WAY = 0.45
BESIDE_OTHERS = 0.1
_LATELY = 10.0
"""Seconds for which others are expected to come again."""

_TRIAL = 0.05
_LEAST = 0.035
"""Fewer are none: as long may the small buffer of a quick server make them wait."""

_WAITS = 0.75
_DOUBTFUL_ROUNDS = 20
_TRIAL_ROUNDS = 7
"""In a row, since pauses that follow each other empty the queue for some; where nothing was ever seen to
wait the server's buffer overflows in each of them."""

_BOLDLY = 2.0
_CAREFULLY = 1.15
_FALL = 0.6
"""At most at once where some of it waited: pauses in a row look like a short queue for a while."""

_SOME = 0.3

_FADE = 0.985

_MEMORY = 0.9
_TELLING = 1.5
"""Seconds of pauses to expect before it is judged whether a reserve shortens them."""

_USELESS = 0.75
_BEARABLE = 0.1
"""The share of the time that pauses are expected to take at least: few were seen, perhaps by chance."""

_FIRST_HOLD = 6.0
_LONGEST_HOLD = 960.0


class Reserve:
    """Finds out how much helps.

    Attributes:
        seconds: of answers to keep in the link's queue.
        wanted: as many would bridge the pauses; 0 if there are none.
        others_at: when somebody last waited for an answer beside a transfer.
    """

    __slots__ = (
        "_bare_paused",
        "_bare_seconds",
        "_expected",
        "_held",
        "_hold",
        "_overfull",
        "_rounds",
        "_seen",
        "_until",
        "_waited",
        "others_at",
        "seconds",
        "wanted",
    )

    def __init__(self) -> None:
        self.seconds = 0.0
        self.wanted = 0.0
        self._held = _TRIAL  # so many seconds of it are known to wait in a queue, or are tried
        self._overfull = False  # more than the queue holds was tried
        self._rounds = 0  # in a row in which not all of it waited
        self._waited = 0.0  # at most in these
        self._bare_paused = 0.0  # seconds of pauses without a reserve, lately
        self._bare_seconds = 1.0
        self._expected = self._seen = 0.0  # seconds of pauses with it: as without it, and really
        self.others_at = -inf
        self._until = -inf  # there is none before
        self._hold = _FIRST_HOLD

    def want(self, now: float, rtt: float) -> None:
        """The server pauses. rtt: least round trip."""
        if now < self._until:
            return
        most = min(MOST + rtt, _MOST_ON_A_LONG_WAY)
        self.wanted = BESIDE_OTHERS if self.beside_others(now) else most
        self._settle()

    def beside_others(self, now: float) -> bool:
        """Whether somebody may soon wait for an answer beside a transfer, as lately."""
        return now < self.others_at + _LATELY

    def on_others(self, now: float) -> None:
        """Somebody waits for an answer beside a transfer, and may again soon."""
        self.others_at = now
        self.wanted = min(self.wanted, BESIDE_OTHERS)
        self._settle()

    def on_round(self, now: float, waited: float) -> None:
        """A round is over, whose quickest answer waited so long, not counting what the window alone explains;
        infinite if that is not known."""
        if self.seconds == 0.0 or waited == inf:
            return
        if waited >= _WAITS * self.seconds:
            self._rounds, self._waited = 0, 0.0
            if not self._overfull:
                self._held = max(self._held, _BOLDLY * self.seconds)
                self._settle()
            return
        self._rounds += 1
        self._waited = max(self._waited, waited)
        if self._rounds < (_DOUBTFUL_ROUNDS if self._held > _TRIAL else _TRIAL_ROUNDS):
            return
        least = _FALL * self.seconds if self._waited > _SOME * self.seconds else 0.0
        self._held, self._overfull = max(self._waited, least), True
        self._rounds, self._waited = 0, 0.0
        if self._held < _LEAST:
            self._give_up(now)
        self._settle()

    def end_period(self, now: float, rtt: float, seconds: float, paused: float, *, costly: bool) -> None:
        """Of the last `seconds`, pauses took `paused`, which may be so much that it matters."""
        if self.seconds == 0.0:
            self._bare_seconds = _MEMORY * self._bare_seconds + seconds
            self._bare_paused = _MEMORY * self._bare_paused + paused
            return
        if self._is_useless(seconds, paused):
            self._give_up(now)
        elif costly:
            self.want(now, rtt)
        else:
            self.wanted *= _FADE
        self._held *= _CAREFULLY
        self._settle()

    def _is_useless(self, seconds: float, paused: float) -> bool:
        """Whether pauses take as long as without a reserve; asked until it is known."""
        if self._expected >= _TELLING or self.seconds < self.wanted:
            return False
        self._expected += max(_BEARABLE, self._bare_paused / self._bare_seconds) * seconds
        self._seen += paused
        return self._expected >= _TELLING and self._seen > _USELESS * self._expected

    def _give_up(self, now: float) -> None:
        self.wanted = self._expected = self._seen = 0.0
        self._held, self._overfull = _TRIAL, False
        self._until, self._hold = now + self._hold, min(_LONGEST_HOLD, 2 * self._hold)

    def _settle(self) -> None:
        if self.wanted < _LEAST:
            self.wanted = 0.0
        self.seconds = min(self.wanted, self._held)
