"""What becomes of an upload: its state, what of it is proven, and who waits for it. Layer: session."""

from __future__ import annotations

from enum import Enum
from math import inf

import trio

from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.scheduler import Scheduler, SessionUser
from mavftpfs.shared.errors import Armed, LocalProtocolError, MavftpfsError
from mavftpfs.shared.sending import Sending

LONGEST_BACKOFF = 30.0
"""Most seconds between two attempts after a failure of the link."""

REOPENS = 5
"""How often the session may be lost without getting further in the file before the upload fails."""


class UploadState(Enum):
    """What becomes of an upload next."""

    IDLE = "idle"
    """The card has all that was given, or nothing was."""

    QUEUED = "queued"
    """It wants the session, from `retry_at` on."""

    SENDING = "sending"
    """It has the session."""

    HELD = "held"
    """Only `finish` goes on with it: it was refused, or to go on means to send the whole file again."""

    ENDING = "ending"
    """Its owner gave it up, and it still has the session."""

    ENDED = "ended"
    """Its owner gave it up."""


UPLOAD_NEXT: dict[UploadState, frozenset[UploadState]] = {
    UploadState.IDLE: frozenset((UploadState.QUEUED, UploadState.ENDED)),
    UploadState.QUEUED: frozenset((UploadState.QUEUED, UploadState.SENDING, UploadState.ENDED)),
    UploadState.SENDING: frozenset(
        (UploadState.IDLE, UploadState.QUEUED, UploadState.HELD, UploadState.ENDING)
    ),
    UploadState.HELD: frozenset((UploadState.QUEUED, UploadState.ENDED)),
    UploadState.ENDING: frozenset((UploadState.ENDED,)),
    UploadState.ENDED: frozenset(),
}
"""All transitions there are."""


class UploadProgress(SessionUser):
    """What the owner of an upload and the scheduler see of it: cache.remote.Upload but for its turns.

    Attributes:
        state: see UploadState. error: why the last attempt failed; None while it goes well.
        transfer: what sends its bytes now. begun, resent: see cache.remote.Upload.
        reboots: of the vehicle, when its file was opened last.
        source: see Sending.
        endings: counted when a turn begins, and when all that the source had is out and the file is to be
            closed. What was given before is in that file: `complete` tells who called `finish` until then.
        refused_at: where a write was refused the last time as if the session were lost.
    """

    def __init__(self, path: bytes, source: Sending, scheduler: Scheduler) -> None:
        super().__init__(path, scheduler, scheduler.clock())
        self.source = source
        self.state = UploadState.QUEUED
        self.begun = self.resent = False
        self.error: MavftpfsError | None = None
        self.transfer: WriteTransfer | None = None
        self.reboots = scheduler.server.vehicle.reboots
        self.endings = 0
        self.refused_at: int | None = None
        self._vehicle = scheduler.server.vehicle
        self._driver = scheduler.server.driver
        self._engine = scheduler.server.engine
        self._clock = scheduler.clock
        self._traits = scheduler.traits
        self._retry_at = 0.0  # not to be touched before
        self._failures = 0
        self._furthest = 0  # in the file, when the session was lost the last time
        self._completed = 0  # the last of the endings that was ACKed
        self._awaited = 0  # the last of those that `finish` waits for
        self._changed = trio.lowlevel.ParkingLot()

    def _enter(self, state: UploadState) -> None:
        assert state in UPLOAD_NEXT[self.state], f"{self.state} does not become {state}"
        self.state = state
        self._changed.unpark_all()

    def _queue_up(self, at: float) -> None:
        self._enter(UploadState.QUEUED)
        self._retry_at = self.asked_at = at

    # --- the owner's side

    def wake(self) -> None:
        """The source has more."""
        if self.state is UploadState.IDLE:
            self._queue_up(self._clock())
        if self.transfer is not None:
            self.transfer.wake()
        self._server.wake()

    async def finish(self) -> None:
        """See cache.remote.Upload."""
        if self.state in (UploadState.ENDING, UploadState.ENDED):
            raise LocalProtocolError("the upload was aborted")
        resting, source = self.state in (UploadState.IDLE, UploadState.HELD), self.source
        if resting and source.closed and source.acked.empty and self.error is None and not source.has_more():
            return
        now = self._clock()
        self._vehicle.require(now, writing=True)
        if self.error is not None:
            self.error, self.refused_at, self._failures = None, None, 0
        if not self.finishing:
            self.asked_at = now
        self._retry_at = 0.0
        if resting:
            self._enter(UploadState.QUEUED)
        awaited = self._awaited = self.endings + 1
        self.wake()
        while awaited > self._completed:
            if self.error is not None:
                raise self.error
            await self._changed.park()

    async def abort(self) -> None:
        """See cache.remote.Upload."""
        self.error = LocalProtocolError("the upload was aborted")
        if self.state is UploadState.SENDING:
            self._enter(UploadState.ENDING)
        elif self.state not in (UploadState.ENDING, UploadState.ENDED):
            self._enter(UploadState.ENDED)
        self._server.wake()
        try:
            while self.state is UploadState.ENDING:
                await self._changed.park()
        finally:
            self._scheduler.remove(self)

    def status(self) -> dict[str, object]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "path": self.path.decode("utf-8", "replace"),
            "running": self.state is UploadState.SENDING,
            "reached": self.source.reached,
            "unproven": self.source.acked.total,
            "error": None if self.error is None else str(self.error),
        }

    # --- the scheduler's side

    @property
    def finishing(self) -> bool:
        """Whether somebody waits for the end."""
        return self._awaited > self._completed

    def due_at(self) -> float:
        """See SessionUser. A silent vehicle is only tried while somebody waits."""
        if self.state is not UploadState.QUEUED or not self._vehicle.may_write:
            return inf
        if not self.finishing and self._vehicle.lost(self._clock()):
            return inf
        return self._retry_at

    def expire(self, error: MavftpfsError) -> None:
        """Tell whoever waits; it keeps its place if nobody does."""
        if self.finishing:
            self.fail(error)

    def on_armed_changed(self) -> None:
        """Whoever waits for an upload is told now; the running one ends itself. On disarming it goes on."""
        if self.state is UploadState.QUEUED:
            if self._vehicle.may_write:
                self._queue_up(self._clock())
            elif self.finishing:
                self.fail(Armed("the vehicle was armed"))

    def fail(self, error: MavftpfsError, *, refused: bool = False) -> None:
        """Tell whoever waits, and try again in the background; refused: that is of no use before `finish`."""
        self.error = error
        self._failures += 1
        self._awaited = self._completed
        if self.state is UploadState.ENDING:
            self._changed.unpark_all()
        elif refused:
            self._enter(UploadState.HELD)
        else:
            self._queue_up(self._clock() + min(LONGEST_BACKOFF, 2.0 ** min(self._failures, 5)))

    # --- one turn

    def resumable(self) -> bool:
        """Whether its file can be closed and written on later: it was seen to be so, or this is to tell."""
        truncates = self._traits.wo_truncates
        return truncates is False or (truncates is None and self.source.reached > 0)

    def end_turn(self, began: float) -> None:
        """It has the session no more."""
        now = self._clock()
        self.on_turn(began, now)
        if self.state is UploadState.ENDING:
            self._enter(UploadState.ENDED)
        elif self.state is UploadState.SENDING:
            self._queue_up(now)
        self.asked_at = max(now, self._retry_at)
        if self.state is UploadState.QUEUED and self.finishing and not self._vehicle.may_write:
            self.fail(Armed("the vehicle was armed"))  # perhaps while its file was opened or closed

    def complete(self) -> None:
        """Everything given until `endings` was counted is ACKed, and the file was closed. Where it cannot be
        written on, more costs the whole file once more, so it is held until somebody waits for it.

        Raises:
            MavftpfsError: the source fails.
        """
        more, resumable = self.source.has_more(), self.resumable()
        self._completed = self.endings
        self.error = None
        self._failures = 0
        if self.state is UploadState.ENDING:
            return
        if self.finishing or (more and resumable):
            self._queue_up(self._clock())
        elif self.source.closed and not resumable:
            self._enter(UploadState.HELD)
        else:
            self._enter(UploadState.IDLE)

    def lose_session(self, error: MavftpfsError) -> None:
        """Try again from what is proven; after some times without getting further that is a failure."""
        if self.source.furthest > self._furthest:
            self._furthest, self._failures = self.source.furthest, 0
        self._failures += 1
        if self._failures > REOPENS:
            self.fail(error)
        elif self.state is UploadState.SENDING:
            self._queue_up(self._clock() + (self._failures - 1) * 0.5)
