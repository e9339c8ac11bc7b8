"""Whether who answers is still the vehicle that was there at first. Layer: session; pure.

Two vehicles have the same MAVLink address unless somebody gave them others: PX4's system id is 1 wherever it
is fresh. Who lands one and switches on the next has another card behind the same link: what is held for the
first must not be written to the second, nor what was read of one be completed from the other.
AUTOPILOT_VERSION tells the board's unique id. A vehicle that told it once has to tell it again after each
restart and after each silence, before anything else is believed or sent.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from mavftpfs.link.messages import AutopilotVersion

ABSENCE = 2.5
"""Seconds of silence in which a vehicle may have restarted, or have been exchanged for another: no autopilot
starts faster. (A cable that is moved reopens the link, which is told.)"""

PATIENCE = 20
"""Questions that a vehicle which is heard leaves unanswered before it is believed to be the same one: some
tell their id only once. From then on it is asked as before, but believed meanwhile."""


class Standing(Enum):
    """What is known of who answers."""

    TRUSTED = "trusted"
    DOUBTED = "doubted"
    STRANGER = "stranger"


class Identity:
    """Who the vehicle is.

    Attributes:
        standing: of who answers now; only a trusted one is asked for files.
        left_at: when it was heard last before it was away, the last time.
        on_doubt: it may have restarted, or be another one: it is to be asked.
        on_settled: called with whether it was a stranger meanwhile: it is trusted again.
    """

    def __init__(self) -> None:
        self.standing = Standing.TRUSTED
        self.on_doubt: Callable[[], None] = lambda: None
        self.on_settled: Callable[[bool], None] = lambda was_stranger: None
        self._known: AutopilotVersion | None = None
        self._strange = False
        self._mute = False
        self._moved = False
        self._unanswered = 0
        self._heard_at: float | None = None
        self._back_at = self.left_at = float("-inf")

    @property
    def trusted(self) -> bool:
        """Whether it is the vehicle that was there at first, as far as can be known."""
        return self.standing is Standing.TRUSTED

    @property
    def stranger(self) -> bool:
        """Whether another vehicle answers."""
        return self.standing is Standing.STRANGER

    def may_be_asked(self, now: float) -> bool:
        """Whether requests may go out now: not into a silence either, at whose end another one may hear."""
        if self._known is None or self._heard_at is None:
            return self.trusted
        return self.trusted and now - self._heard_at <= ABSENCE

    def heard(self, now: float) -> None:
        """Something came from the vehicle's address."""
        before, self._heard_at = self._heard_at, now
        if before is not None and now - before > ABSENCE:
            self.left_at, self._back_at = before, now
            self.doubt()

    def reopened(self, now: float) -> None:
        """The link was: it may have been away for less than that, or be another one."""
        if self._heard_at is not None:
            self.left_at, self._back_at = self._heard_at, now
        self.doubt()

    def moved(self, now: float) -> None:
        """Its network address is another one: only who it is makes it believed there, if it ever told."""
        self.reopened(now)
        self.standing, self._moved, self._unanswered = Standing.DOUBTED, True, 0

    def away_since(self, when: float, now: float) -> bool:
        """Return whether it was away after that, so that it may have restarted."""
        silent = self._heard_at is not None and now - self._heard_at > ABSENCE
        return silent or self._back_at > when

    def heard_since(self, when: float) -> bool:
        """Return whether something came from it after that."""
        return self._heard_at is not None and self._heard_at > when

    def doubt(self) -> None:
        """It may be another one since now: it restarted, or was silent."""
        tells = self._known is not None and not self._mute
        if tells and self.standing is not Standing.DOUBTED:
            self._strange |= self.stranger
            self.standing = Standing.DOUBTED
            self._unanswered = 0
        self.on_doubt()

    def told(self, version: AutopilotVersion) -> bool:
        """It told who it is; return whether it is the same as ever."""
        self._mute = False
        if self._known is not None and is_another(self._known, version):
            self._is_stranger()
            return False
        if self._known is None and (version.uid or any(version.uid2)):
            self._known = version
        self._settle()
        return True

    def unanswered(self) -> None:
        """It was heard, but did not tell who it is though it was asked."""
        self._unanswered += 1
        if self._unanswered < PATIENCE or self.standing is not Standing.DOUBTED:
            return
        if self._moved and self._known is not None and not self._mute:
            self._is_stranger()
        else:
            self._mute = True
            self._settle()

    def _is_stranger(self) -> None:
        was_trusted, self.standing = self.trusted, Standing.STRANGER
        if was_trusted:  # nobody asks, and ours may come back without a silence
            self.on_doubt()

    def _settle(self) -> None:
        if self.trusted:
            return
        strange = self._strange or self.stranger
        self.standing, self._strange, self._moved = Standing.TRUSTED, False, False
        self.on_settled(strange)


def is_another(known: AutopilotVersion, version: AutopilotVersion) -> bool:
    """Return whether two answers are of two boards.

    What one of them lacks tells nothing: uid2 is an extension, which MAVLink 1 frames do not carry.
    """
    if known.uid and version.uid and known.uid != version.uid:
        return True
    return any(known.uid2) and any(version.uid2) and known.uid2 != version.uid2
