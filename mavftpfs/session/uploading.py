"""Serves uploads with the server session. Layer: session.

Where OpenFileWO was seen to keep a file's content an upload can be interrupted at any time: drain the window,
Terminate, and later OpenFileWO. Elsewhere that would begin the file anew, so the upload keeps the session
until its source has nothing more (design section 4).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from mavftpfs.cache.remote import UploadSource
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.driver import Driver
from mavftpfs.session.gate import Gate
from mavftpfs.session.holder import SessionHolder
from mavftpfs.session.opening import TERMINATE_LIMIT, OpenSession
from mavftpfs.session.policy import should_switch
from mavftpfs.session.turns import Turns
from mavftpfs.session.upload import Feed, QueuedUpload
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import (
    Armed,
    FileChanged,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    ProtocolError,
    RequestTimeout,
    SessionLost,
    VehicleLost,
)
from mavftpfs.shared.model import ROOT, split, wire_path
from mavftpfs.shared.traits import WriteTraits

STARVE = 1.5
"""Seconds an upload keeps the session with nothing to send: below the 2 s after which PX4 frees buffers."""

BRIEF_STARVE = 0.05
"""The same where it can be interrupted and somebody else waits."""

STALL = 2.0
"""Seconds without a reply after which a session that can be resumed is closed and opened anew."""

CHECKPOINT_EVERY = 60.0
"""Seconds after which an upload is terminated and resumed: what a lost session can cost."""

REOPENS = 5
"""How often the session may be lost without getting further in the file before the upload fails."""

_TURN = 0.5
_OFTEN = 0.25
_BEYOND_ANY_LISTING = 100_000
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


class Uploading:
    """All uploads, and the one that is running.

    traits: what the server was seen to do when written to. rival: how much of the session whoever else waits
    for it had lately, None if nobody waits. expire_waiters: fail those who have waited too long.
    when_armed_ok: write in flight, too.
    """

    def __init__(
        self,
        holder: SessionHolder,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        gate: Gate,
        *,
        clock: Callable[[], float],
        traits: Callable[[], WriteTraits],
        rival: Callable[[object], float | None],
        expire_waiters: Callable[[], None],
        op_deadline: float = 30.0,
        chunk: int = MAX_DATA,
        when_armed_ok: bool = False,
    ) -> None:
        self.uploads: list[QueuedUpload] = []
        self.turns = Turns(holder.wake)
        self.rearms = 0
        self._holder = holder
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._gate = gate
        self._clock = clock
        self._traits = traits
        self._rival = rival
        self._expire_waiters = expire_waiters
        self._op_deadline = op_deadline
        self._chunk = chunk
        self._when_armed_ok = when_armed_ok
        self._disarmed_by_paths = False
        self._transfer: WriteTransfer | None = None
        self._current: QueuedUpload | None = None
        self._opened_at = 0.0
        self._starved_at: float | None = None

    # --- what others ask for and tell

    def add(self, path: bytes, source: UploadSource, *, create: bool, ticket: int) -> QueuedUpload:
        """Queue an upload."""
        feed = Feed(source, self._chunk)
        upload = QueuedUpload(self, path, feed, create=create, ticket=ticket, asked_at=self._clock())
        self.uploads.append(upload)
        self._holder.wake()
        return upload

    @property
    def may_write(self) -> bool:
        """Whether the vehicle may be written to now (design promise 9)."""
        return self._when_armed_ok or not self._vehicle.armed

    def check_may_write(self) -> None:
        """Raise Armed or VehicleLost."""
        if not self.may_write:
            raise Armed("the vehicle is armed: nothing is written in flight")
        if self._vehicle.lost(self._clock()):
            raise VehicleLost("the vehicle is silent; waiting for its heartbeat")

    def on_news(self, upload: QueuedUpload) -> None:
        """See UploadHost."""
        if upload is self._current and self._transfer is not None:
            self._starved_at = None
            self._transfer.wake()
            self._driver.kick()
        self._holder.wake()

    def forget(self, upload: QueuedUpload) -> None:
        """See UploadHost."""
        if upload in self.uploads:
            self.uploads.remove(upload)

    def on_armed(self) -> None:
        """The armed state changed: whoever waits for an upload is told now, the running one ends itself."""
        now = self._clock()
        for upload in self.uploads:
            if not self.may_write and upload is not self._current and upload.finishing:
                upload.fail(Armed("the vehicle was armed"), now)
            if self.may_write:
                upload.retry_at = now
        self._holder.wake()

    def on_reboot(self) -> None:
        """Perhaps other firmware runs now; nothing under way gets an answer."""
        self._disarmed_by_paths = False
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    def on_batch(self) -> None:
        """A batch of replies was processed."""
        transfer = self._transfer
        if transfer is not None and (transfer.idle or transfer.done):
            self._holder.wake()

    # --- what the scheduler asks

    def due(self, now: float) -> list[QueuedUpload]:
        """Return the uploads for which there is something to do now."""
        if not self.may_write:
            return []
        lost = self._vehicle.lost(now)
        return [upload for upload in self.uploads if upload.is_due(now) and (upload.finishing or not lost)]

    def next_time(self, now: float) -> float:
        """When one becomes due that is not so now, infinite if none will by itself."""
        if not self.may_write:
            return float("inf")
        later = [upload.retry_at for upload in self.uploads if upload.wanted and upload.retry_at > now]
        return min(later, default=float("inf"))

    async def serve(self, upload: QueuedUpload) -> None:
        """Use the session for an upload. Its errors are told to the upload."""
        started = self._clock()
        upload.running, self._current = True, upload
        try:
            if not self._is_complete_already(upload):
                self.check_may_write()
                session = await self._open(upload)
                await self._run(upload, session)
        except SessionLost as lost:
            self._on_lost(upload, lost)
        except MavftpfsError as error:
            await self._on_error(upload, error)
        finally:
            now = self._clock()
            upload.running, self._current = False, None
            upload.use.add(now - started, now)
            upload.tell()

    @property
    def _resumable(self) -> bool:
        return self._traits().wo_truncates is False

    def _is_complete_already(self, upload: QueuedUpload) -> bool:
        """Whether there is nothing to send; an empty file has to be created once."""
        feed = upload.feed
        upload.mark()
        if feed.has_more() or feed.unproven or (upload.finishing and not feed.proven):
            return False
        upload.complete(more=False)
        return True

    # --- opening

    async def _open(self, upload: QueuedUpload) -> OpenSession:
        feed = upload.feed
        if not upload.create and not self._resumable:
            raise LocalProtocolError("how the vehicle opens a file for writing is not known (any more)")
        self._opened_at = self._clock()
        if self._resumable and (feed.proven or not upload.create):
            session = await self._holder.open(upload.path, Opcode.OPEN_FILE_WO)
            if session.size is not None and session.size < feed.reached:
                feed.roll_back(everything=True)
                await self._holder.close()
                raise SessionLost(f"the file has {session.size} bytes, not {feed.reached}", by_server=True)
            return session
        if feed.proven or feed.unproven:
            feed.roll_back(everything=True)
        return await self._holder.open(upload.path, Opcode.CREATE_FILE)

    # --- writing

    async def _run(self, upload: QueuedUpload, session: OpenSession) -> None:
        rearms = 0
        while True:
            transfer = WriteTransfer(session.id, upload.feed, self._chunk)
            stop = await self._drive(upload, session, transfer)
            if transfer.acked_bytes and rearms:
                self._disarmed_by_paths = True
                rearms = 0
            error = transfer.error
            if stop is not None and error is None:
                await self._let_go(upload, stop)
                return
            assert error is not None
            if not _is_disarmed(error) or rearms > 0:
                self._note_refusal(upload, transfer.failed_at, error)
                raise error
            rearms += 1
            await self._rearm(upload.path)

    async def _drive(
        self, upload: QueuedUpload, session: OpenSession, transfer: WriteTransfer
    ) -> Stop | None:
        """Run a transfer until there is a reason to let go, or it failed (None)."""
        self._transfer, self._starved_at = transfer, None
        self.turns.set_writing(self._disarmed_by_paths)
        self._driver.start(transfer, self._holder.wake)
        try:
            async with self._gate.passing():
                return await self._watch(upload, session, transfer)
        finally:
            self._transfer = None
            self.turns.set_writing(False)
            transfer.stop()
            self._driver.cancel(transfer)

    async def _watch(
        self, upload: QueuedUpload, session: OpenSession, transfer: WriteTransfer
    ) -> Stop | None:
        stop: Stop | None = None
        while not transfer.done:
            if self._holder.session is not session:
                raise SessionLost("the vehicle restarted", by_server=True)
            stop = stop or self._reason_to_stop(upload, transfer)
            if self._in_doubt(transfer):
                stop = Stop.DOUBT
            if stop is not None:
                transfer.pause()
                if transfer.drained or stop in _ABRUPT:
                    upload.mark()
                    return stop
            elif self._disarmed_by_paths and self.turns.wanted:
                await self._give_turn(upload, transfer)
            elif transfer.paused:
                self._go_on(transfer)
            self._expire_waiters()
            await self._holder.sleep(_OFTEN if transfer.starved or self._rival(upload) is not None else 1.0)
        return None

    def _reason_to_stop(self, upload: QueuedUpload, transfer: WriteTransfer) -> Stop | None:
        now = self._clock()
        if upload.aborted:
            return Stop.ABORTED
        if not self.may_write:
            return Stop.ARMED
        if self._holder.claimed(upload.path):
            return Stop.YIELD
        waiting_use = self._rival(upload)
        if transfer.starved:
            return self._reason_of_starved(upload, now, pressed=waiting_use is not None)
        self._starved_at = None
        if self._resumable and self._is_turn_over(upload, now, waiting_use):
            return Stop.YIELD
        return None

    def _reason_of_starved(self, upload: QueuedUpload, now: float, *, pressed: bool) -> Stop | None:
        if upload.finishing:
            return Stop.FINISHED
        if self._starved_at is None:
            self._starved_at = now
        patience = BRIEF_STARVE if pressed and self._resumable else STARVE
        return Stop.STARVED if now - self._starved_at >= patience else None

    def _is_turn_over(self, upload: QueuedUpload, now: float, waiting_use: float | None) -> bool:
        slice_ = now - self._opened_at
        if waiting_use is None:
            return slice_ >= CHECKPOINT_EVERY
        return should_switch(
            current_has_demand=True,
            current_slice=slice_,
            current_use=upload.use.recent(now),
            waiting_use=waiting_use,
            rtt=self._engine.rtt,
        )

    def _in_doubt(self, transfer: WriteTransfer) -> bool:
        """Whether it was silent for so long that the session may be somebody else's (servers.md 14.9).

        Where closing would cost the whole file, only if there is somebody else; the server tells the rest.
        """
        now = self._clock()
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        quiet_since = max(self._driver.last_reply_at, transfer.started_at)
        if transfer.idle or now - quiet_since <= limit:
            return False
        return self._resumable or self._vehicle.foreign_client(now)

    # --- path operations beside it

    async def _give_turn(self, upload: QueuedUpload, transfer: WriteTransfer) -> None:
        """Drain, let path operations pass, arm again, go on."""
        transfer.pause()
        if not transfer.drained:
            return
        await self.turns.give(max(_TURN, 4.0 * (self._engine.rtt or 0.0)))
        await self._rearm(upload.path)
        self._go_on(transfer)

    def _go_on(self, transfer: WriteTransfer) -> None:
        transfer.resume()
        self._driver.kick()

    async def _rearm(self, path: bytes) -> None:
        """List the storage's root, whose trailing slash fits PX4's whitelist; also clears a sticky errno.

        One request from beyond the end suffices; whatever it answers, the next write tells.
        """
        self.rearms += 1
        wire = wire_path(storage_root(path)).rstrip(b"/") + b"/"
        try:
            await self._driver.run(Simple(Opcode.LIST_DIRECTORY, wire, offset=_BEYOND_ANY_LISTING))
        except FtpNak:
            return

    # --- letting go

    async def _let_go(self, upload: QueuedUpload, stop: Stop) -> None:
        feed = upload.feed
        if stop is Stop.ABORTED:
            await self._holder.close_quietly()
            return
        limit = TERMINATE_LIMIT if stop is Stop.ARMED else self._op_deadline
        try:
            ours = await self._holder.close(limit)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        if not ours:
            raise SessionLost("the vehicle had closed the session before", by_server=True)
        feed.check_point()
        if stop is Stop.ARMED:
            upload.fail(Armed("the vehicle was armed"), self._clock())
        elif stop in (Stop.FINISHED, Stop.STARVED):
            more = feed.has_more()
            upload.complete(more=more)
            if not self._resumable and not upload.finishing:
                upload.hold_restart(self._clock())

    def _roll_back(self, upload: QueuedUpload) -> None:
        keep = not upload.create or (self._resumable and upload.feed.proven)
        if upload.feed.proven or upload.feed.unproven:
            upload.feed.roll_back(everything=not keep)
        else:
            upload.feed.put_back()

    def _note_refusal(self, upload: QueuedUpload, offset: int | None, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: the same place twice is enough."""
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL:
            if offset is not None and offset == upload.refused_at:
                raise nak
            upload.refused_at = offset

    def _on_lost(self, upload: QueuedUpload, lost: SessionLost) -> None:
        """Begin again from what is proven, a bounded number of times."""
        self._holder.abandon()
        if upload.aborted:
            return
        self._roll_back(upload)
        now = self._clock()
        failures = 1 if upload.feed.got_further() else upload.failures + 1
        if not self.may_write:
            upload.fail(Armed("the vehicle was armed"), now)
        elif failures > REOPENS:
            cause = lost.__cause__
            upload.fail(cause if isinstance(cause, MavftpfsError) else lost, now)
        else:
            upload.failures = failures
            upload.retry_at = now + (failures - 1) * 0.5

    async def _on_error(self, upload: QueuedUpload, error: MavftpfsError) -> None:
        """Close what can be closed, roll back what is not proven, and tell whoever waits."""
        refused = isinstance(error, FtpNak | ProtocolError | FileChanged)
        if isinstance(error, RequestTimeout):
            self._vehicle.note_timeout()
        if not refused or isinstance(error, RequestTimeout):
            self._holder.abandon()
            self._roll_back(upload)
        elif self._holder.session is not None and await self._holder.close_quietly():
            upload.feed.check_point()
        else:
            self._roll_back(upload)
        upload.fail(error, self._clock(), refused=refused)


def storage_root(path: bytes) -> bytes:
    """Return where the storage of a path is mounted: /fs/NAME on NuttX, else the parent directory."""
    parts = path.split(b"/")
    if len(parts) > 3 and parts[1] == b"fs":
        return b"/".join(parts[:3])
    return split(path)[0] or ROOT


def _is_disarmed(error: MavftpfsError) -> bool:
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _REFUSED_ARM
