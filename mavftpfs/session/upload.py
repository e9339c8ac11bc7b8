"""One upload: who waits for it, what becomes of it next, and how it uses its turns. Layer: session.

A file is made by CreateFile. Where OpenFileWO was seen to keep a file's content an upload can be interrupted
at any time: Terminate right behind the window, and later OpenFileWO and what of that was not ACKed. Where it
was seen to empty files that would begin the file anew, so the upload keeps the session until its source has
nothing more. Where neither was seen yet, the upload is interrupted when somebody waits, and reopening its
file tells. What was ACKed before an ACKed Terminate is written.

PX4 on NuttX checks each WriteFile against a scratch buffer that every path operation overwrites
(docs/servers.md 8). Once that was seen, path operations and writes take turns (`PathGate`).
"""

from __future__ import annotations

import errno
from contextlib import suppress
from enum import Enum
from math import inf

import trio

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.scheduler import LIGHT_USE, Scheduler, SessionUser
from mavftpfs.session.serversession import TERMINATE_LIMIT, OpenSession
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    ProtocolError,
    RequestTimeout,
    SessionLost,
    SpoolFailed,
)
from mavftpfs.shared.model import split, wire_path
from mavftpfs.shared.sending import Sending

LONGEST_BACKOFF = 30.0
"""Most seconds between two attempts after a failure of the link."""

REOPENS = 5
"""How often the session may be lost without getting further in the file before the upload fails."""

STARVE = 1.5
"""Seconds an upload keeps the session with nothing to send: below the 2 s after which PX4 frees buffers."""

BRIEF_STARVE = 0.05
"""The same where it can be interrupted and somebody else waits."""

PATIENCE = 10.0
"""Seconds of the session after which one that cannot be interrupted, and has nothing to send at the moment,
lets go of it for who waits: a log that trickles would keep it for ever."""

STALL = 2.0
"""Seconds without a reply after which a session that can be resumed is closed and opened anew."""

CHECKPOINT_EVERY = 60.0
"""Seconds after which an upload is terminated and resumed: what a lost session can cost."""

REFUSALS = (FtpNak, ProtocolError, SpoolFailed)
"""Errors that do not pass by themselves."""

_PATHS_TURN = 0.5
_OFTEN = 0.25
_REFUSED_ARM = frozenset((NakCode.FILE_PROTECTED, NakCode.FILE_EXISTS))


class Stop(Enum):
    """Why an upload lets go of the session."""

    FINISHED = "finished"
    STARVED = "starved"
    YIELD = "yield"
    DOUBT = "doubt"
    ARMED = "armed"
    ABORTED = "aborted"


_ABRUPT = frozenset((Stop.DOUBT, Stop.ARMED, Stop.ABORTED))


class UploadState(Enum):
    """What becomes of an upload next.

    IDLE: the card has all that was given, or nothing was. QUEUED: it wants the session, now or later.
    SENDING: it has the session. HELD: only `finish` goes on with it: it was refused, or to go on means to
    send the whole file again. ENDING: its owner gave it up, and it still has the session. ENDED: it was
    given up.
    """

    IDLE = "idle"
    QUEUED = "queued"
    SENDING = "sending"
    HELD = "held"
    ENDING = "ending"
    ENDED = "ended"


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


class Upload(SessionUser):
    """Implements cache.remote.Upload. Nothing is sent before the source has something.

    Attributes:
        state: see UploadState. error: why the last attempt failed; None while it goes well.
        begun, resent: see cache.remote.Upload.
    """

    def __init__(self, path: bytes, source: Sending, scheduler: Scheduler) -> None:
        super().__init__(path, scheduler, scheduler.clock())
        self._source = source
        self.state = UploadState.QUEUED
        self.begun = self.resent = False
        self.error: MavftpfsError | None = None
        self._transfer: WriteTransfer | None = None  # what sends its bytes now
        self._reboots = scheduler.server.vehicle.reboots  # when its file was opened last
        self._refused_at: int | None = None  # where a write was refused last as if the session were lost
        # Counted when a turn begins, and when all that the source had is out and the file is to be closed.
        # What was given before is in that file: who called `finish` until then is told by `_complete`.
        self._endings = 0
        self._completed = 0  # the last of them that was ACKed
        self._awaited = 0  # the last of them that `finish` waits for
        self._vehicle = scheduler.server.vehicle
        self._driver = scheduler.server.driver
        self._engine = scheduler.server.engine
        self._clock = scheduler.clock
        self._retry_at = 0.0  # not to be touched before
        self._failures = 0
        self._furthest = 0  # in the file, when the session was lost the last time
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
        if self._transfer is not None:
            self._transfer.wake()
        self._server.wake()

    async def finish(self) -> None:
        """See cache.remote.Upload."""
        if self.state in (UploadState.ENDING, UploadState.ENDED):
            raise LocalProtocolError("the upload was ended")
        self._vehicle.require(now := self._clock(), writing=True)
        if self.error is not None:
            self.error, self._refused_at, self._failures = None, None, 0
        if not self.finishing:
            self.asked_at = now
        self._retry_at = 0.0
        if self.state in (UploadState.IDLE, UploadState.HELD):
            self._enter(UploadState.QUEUED)
        awaited = self._awaited = self._endings + 1
        self.wake()
        while awaited > self._completed:
            if self.error is not None:
                raise self.error
            await self._changed.park()

    async def end(self) -> None:
        """See cache.remote.Upload."""
        self.error = LocalProtocolError("the upload was ended")
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
            "reached": self._source.reached,
            "unproven": self._source.acked.total,
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

    async def turn(self) -> None:
        """See SessionUser."""
        began, source = self._clock(), self._source
        self._enter(UploadState.SENDING)
        self._endings += 1
        try:
            # An empty file has to be made, too, once.
            if source.has_more() or not source.acked.empty or (self.finishing and not source.closed):
                self._vehicle.require(began, writing=True)
                session = await self._open()
                await self._close(await self._write(session))
            else:
                self._complete()
        except SessionLost as lost:  # begin again from what is proven, a bounded number of times
            self._server.abandon()
            if lost.by_server:
                self._server.doubt.raise_it(str(lost))
            self._roll_back()
            cause = lost.__cause__
            if self._source.furthest > self._furthest:
                self._furthest, self._failures = self._source.furthest, 0
            self._failures += 1
            if self._failures > REOPENS:
                self.fail(cause if isinstance(cause, MavftpfsError) else lost)
            elif self.state is UploadState.SENDING:
                self._queue_up(self._clock() + (self._failures - 1) * 0.5)
        except MavftpfsError as error:
            await self._clean_up(error)
            self.fail(error, refused=isinstance(error, REFUSALS))
        finally:
            self._end_transfer()
            now = self._clock()
            self.on_turn(began, now)
            if self.state is UploadState.ENDING:
                self._enter(UploadState.ENDED)
            elif self.state is UploadState.SENDING:
                self._queue_up(now)
            self.asked_at = max(now, self._retry_at)
            if self.state is UploadState.QUEUED and self.finishing and not self._vehicle.may_write:
                self.fail(Armed("the vehicle was armed"))  # perhaps while its file was opened or closed

    def _resumable(self) -> bool:
        """Whether its file can be closed and written on later: it was seen to be so, or this is to tell."""
        truncates = self._engine.traits.wo_truncates
        return truncates is False or (truncates is None and self._source.reached > 0)

    def _complete(self) -> None:
        """Everything given until `endings` was counted is ACKed, and the file was closed. Where it cannot be
        written on, more costs the whole file once more, so it is held until somebody waits for it.

        Raises:
            MavftpfsError: the source fails.
        """
        more, resumable = self._source.has_more(), self._resumable()
        self._completed = self._endings
        self.error = None
        self._failures = 0
        if self.state is UploadState.ENDING:
            return
        if self.finishing or (more and resumable):
            self._queue_up(self._clock())
        elif self._source.closed and not resumable:
            self._enter(UploadState.HELD)
        else:
            self._enter(UploadState.IDLE)

    # --- opening

    async def _open(self) -> OpenSession:
        """Open the upload's file: to go on with it where that is possible, else to begin it."""
        source, server = self._source, self._server
        if self._reboots != self._vehicle.reboots:  # what was proven may not be there any more
            source.roll_back(everything=True)
        self._reboots = self._vehicle.reboots
        unknown = self._engine.traits.wo_truncates is None and source.reached
        if source.closed and (unknown or self._engine.traits.wo_truncates is False):
            session = await self._reopen()
            if session is not None:
                return session
        source.roll_back(everything=True)
        if self.state is UploadState.ENDING:  # its owner was told that nothing was begun
            raise LocalProtocolError("the upload was given up before its file was made")
        self.resent |= self.begun
        self.begun = True  # what is there from now on may be ours
        try:
            session = await server.open(self.path, Opcode.CREATE_FILE)
        except FtpNak as nak:
            self.resent |= nak.retransmitted
            raise
        self.resent |= session.resent
        return session

    async def _reopen(self) -> OpenSession | None:
        """Open an interrupted file to go on with it; None if it does not have what was proven.

        The first time in a mount that finds out what OpenFileWO does (docs/servers.md 8): the size tells,
        asked afterwards, since the reply to OpenFileWO may say what it was before. What is not seen to keep
        the file passes for emptying it.
        """
        server, traits, reached = self._server, self._engine.traits, self._source.reached
        try:
            session = await server.open(self.path, Opcode.OPEN_FILE_WO)
            if traits.wo_truncates is None:
                size = (await server.open(self.path)).size
                traits.wo_truncates = size is None or size < reached
                if traits.wo_truncates:
                    return None
                session = await server.open(self.path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:  # somebody removed the file
                return None
            if traits.wo_truncates is not None:
                raise
            traits.wo_truncates = True
            return None
        if session.size is None or session.size >= reached:
            return session
        await server.close()
        return None

    # --- writing

    async def _write(self, session: OpenSession) -> Stop:
        """Write until there is a reason to stop. The session is open then, and what is in flight waits for
        nothing but its answers: `_end_transfer` follows when the session is closed.

        Raises:
            SessionLost, FtpNak, RequestTimeout, RemoteProtocolError: what the transfer failed with.
        """
        server, traits, gate = self._server, self._engine.traits, self._server.path_gate
        rearmed = False
        gate.shut = traits.paths_disarm
        try:
            while True:
                # While a light user waits, a short queue is half filled: the Terminate finds a place in it,
                # and is not behind as many writes.
                rival = self._scheduler.rival_use(self)
                queue = traits.queue_limit
                most = queue // 2 if queue and rival is not None and rival < LIGHT_USE else None
                chunks = self._scheduler.write_chunks
                transfer = WriteTransfer(
                    session.id, self._source, chunks, in_flight=most, on_starved=server.wake
                )
                self._transfer = server.transfer = transfer
                self._driver.on_batch = self._on_batch
                try:
                    await self._driver.start(transfer, server.wake)
                    stop = await self._watch(session, transfer)
                finally:
                    self._driver.on_batch = None
                    if not transfer.trailing:
                        self._end_transfer()
                if transfer.acked_bytes and rearmed:
                    traits.paths_disarm, rearmed = True, False
                error = transfer.error
                if error is None:
                    assert stop is not None
                    return stop
                if rearmed or not is_disarmed(error):
                    self._check_refusal(transfer, error)
                    raise error
                rearmed = True
                # From now on path operations take turns with this upload: first those under way end.
                await gate.let_in(0.0)
                await self._rearm()
        finally:
            gate.open()

    def _on_batch(self, now: float) -> None:
        """A batch of replies was processed."""
        transfer = self._transfer
        if transfer is not None and (transfer.idle or transfer.done):
            self._server.wake()

    async def _watch(self, session: OpenSession, transfer: WriteTransfer) -> Stop | None:
        """Return the reason to let go; None if the transfer ended by itself."""
        server, driver, gate, clock = self._server, self._driver, self._server.path_gate, self._server.clock
        stop: Stop | None = None
        fed_at = clock()
        while not transfer.done:
            if server.session is not session:
                raise SessionLost("the vehicle restarted, or opened another file", by_server=True)
            if not transfer.starved:
                fed_at = clock()
            rival = self._scheduler.rival_use(self)
            stop = stop or self._reason_to_stop(session, transfer, fed_at, rival)
            limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
            if not transfer.idle and clock() - max(driver.last_reply_at, transfer.progress_at) > limit:
                # The session may be somebody else's (servers.md 14.9). Where closing would cost the whole
                # file, only if there is somebody else; the server tells the rest.
                rivals = self._engine.traits.wo_truncates is False or self._vehicle.foreign_client(clock())
                stop = Stop.DOUBT if rivals else stop
            if stop is not None:
                transfer.paused = True
                if transfer.idle or stop in _ABRUPT or self._let_trail(stop, transfer):
                    self._endings += 1
                    return stop
            elif gate.shut and gate.waiting:
                transfer.paused = True
                if transfer.idle:
                    await gate.let_in(max(_PATHS_TURN, 4.0 * (self._engine.rtt or 0.0)))
                    await self._rearm()
                    transfer.paused = False
            else:
                transfer.paused = False
            driver.kick()
            self._scheduler.expire_waiters()
            self._scheduler.expire_held()
            pressed = transfer.starved and rival is not None
            await server.sleep(BRIEF_STARVE if pressed else _OFTEN)
        return None

    def _reason_to_stop(
        self, session: OpenSession, transfer: WriteTransfer, fed_at: float, rival: float | None
    ) -> Stop | None:
        """fed_at: when there was something to send the last time. rival: see Scheduler.rival_use."""
        if self.state is UploadState.ENDING:
            return Stop.ABORTED
        if not self._vehicle.may_write:
            return Stop.ARMED
        if self._server.is_excluded(self.path):
            return Stop.YIELD
        now, resumable = self._clock(), self._resumable()
        if transfer.starved:
            if self.finishing:
                return Stop.FINISHED
            patience = STARVE
            if rival is not None and resumable:
                patience = BRIEF_STARVE
            elif rival is not None and now - session.opened_at >= PATIENCE:
                patience = 0.0
            return Stop.STARVED if now - fed_at >= patience else None
        if rival is None:
            over = self._engine.traits.wo_truncates is False and now - session.opened_at >= CHECKPOINT_EVERY
        else:
            over = resumable and self.gives_way(rival, session.opened_at, now, self._engine.rtt)
        return Stop.YIELD if over else None

    def _let_trail(self, stop: Stop, transfer: WriteTransfer) -> bool:
        """Have the Terminate go out right behind the last requests if that is right; return whether it does.

        It is a round trip less for who waits.
        Servers carry them out in order; what gets lost is sent when the file is open again. Where others'
        paths cause refusals, the answers are waited for: that alone sets it right."""
        if stop is not Stop.YIELD or self._engine.traits.wo_truncates is not False:
            return False
        if self._engine.traits.paths_disarm or self._server.is_excluded(self.path):
            return False
        if transfer.all_out:
            transfer.repeat_nothing()
        return transfer.trailing

    def _end_transfer(self) -> MavftpfsError | None:
        """The session is closed, or lost: what was not ACKed goes back to the source. Return what failed of
        the last requests, which were on their way when it was closed."""
        transfer = self._transfer
        if transfer is None:
            return None
        self._transfer = self._server.transfer = None
        if transfer.trailing and not transfer.idle:
            self._engine.stats.retransmissions += 1  # it goes again, and the first may come later than that
        transfer.finish()
        self._driver.cancel(transfer)
        return transfer.error

    def _check_refusal(self, transfer: WriteTransfer, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: raise it where it is the second one
        at the same place.

        Raises:
            FtpNak.
        """
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL and transfer.failed_at is not None:
            if transfer.failed_at == self._refused_at:
                raise nak
            self._refused_at = transfer.failed_at

    async def _rearm(self) -> None:
        """List the storage's root, whose trailing slash fits PX4's whitelist; also clears a sticky errno.

        One request from beyond any end suffices; whatever it answers, the next write tells.
        """
        parts = self.path.split(b"/")
        on_nuttx = len(parts) > 3 and parts[1] == b"fs"  # then it is /fs/NAME, else the parent directory
        root = b"/".join(parts[:3]) if on_nuttx else split(self.path)[0]
        wire = wire_path(root).rstrip(b"/") + b"/"
        with suppress(FtpNak):
            await self._driver.run(Simple(Opcode.LIST_DIRECTORY, wire, offset=100_000))

    # --- letting go

    async def _close(self, stop: Stop) -> None:
        """Close the file, and judge by that what of it is written.

        A vehicle that restarted before may ACK it, too (ArduPilot ACKs the end of any session). That restart
        is news that takes the bytes back (`_open`) and has the file compared (`Doubt`).
        """
        transfer = self._transfer  # if any, its last requests are on their way
        if stop is Stop.ABORTED:
            await self._server.close_quietly()
            return
        try:
            ours = await self._server.close(TERMINATE_LIMIT if stop is Stop.ARMED else None)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        last = self._end_transfer()
        if last is not None and transfer is not None:
            self._engine.traits.paths_disarm |= is_disarmed(last)
            self._check_refusal(transfer, last)
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        self._source.check_point()
        if isinstance(last, REFUSALS) and not is_disarmed(last):
            raise last
        if stop is Stop.ARMED:
            self.fail(Armed("the vehicle was armed"))
        elif stop in (Stop.FINISHED, Stop.STARVED):
            self._complete()

    async def _clean_up(self, error: MavftpfsError) -> None:
        """Close what can be closed, and roll back what is not proven."""
        self._end_transfer()
        written, session = False, self._server.session  # None where it failed before it got it
        if isinstance(error, REFUSALS) and session is not None and session.writing:
            with suppress(MavftpfsError):  # another failure is no news
                written = await self._server.close(TERMINATE_LIMIT)
        else:
            self._server.abandon()
        if written:
            self._source.check_point()
        else:
            self._roll_back()

    def _roll_back(self) -> None:
        self._end_transfer()
        self._source.roll_back(
            everything=self._engine.traits.wo_truncates is not False or not self._source.closed
        )


def is_disarmed(error: MavftpfsError) -> bool:
    """Whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _REFUSED_ARM
