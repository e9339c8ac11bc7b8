"""How an upload uses its turns: opens its file, sends what there is, closes, and judges. Layer: session.

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

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.scheduler import LIGHT_USE
from mavftpfs.session.serversession import TERMINATE_LIMIT, OpenSession
from mavftpfs.session.upload import UploadProgress, UploadState
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
from mavftpfs.shared.model import ROOT, split, wire_path

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


class Upload(UploadProgress):
    """Implements cache.remote.Upload. Nothing is sent before the source has something."""

    async def turn(self) -> None:
        """See SessionUser."""
        began, source = self._clock(), self.source
        self._enter(UploadState.SENDING)
        self.endings += 1
        try:
            # An empty file has to be made, too, once.
            if source.has_more() or not source.acked.empty or (self.finishing and not source.closed):
                self._vehicle.require(began, writing=True)
                session = await self._open()
                await self._close(await self._write(session))
            else:
                self.complete()
        except SessionLost as lost:  # begin again from what is proven, a bounded number of times
            self._server.abandon()
            if lost.by_server:
                self._server.doubt.raise_it(str(lost))
            self._roll_back()
            cause = lost.__cause__
            self.lose_session(cause if isinstance(cause, MavftpfsError) else lost)
        except MavftpfsError as error:
            await self._clean_up(error)
            self.fail(error, refused=isinstance(error, REFUSALS))
        finally:
            self._end_transfer()
            self.end_turn(began)

    # --- opening

    async def _open(self) -> OpenSession:
        """Open the upload's file: to go on with it where that is possible, else to begin it."""
        source, server = self.source, self._server
        if self.reboots != self._vehicle.reboots:  # what was proven may not be there any more
            source.roll_back(everything=True)
        self.reboots = self._vehicle.reboots
        if source.closed and source.reached and self._traits.wo_truncates is None:
            await self._find_out()
        if source.closed and self._traits.wo_truncates is False:
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

    async def _find_out(self) -> None:
        """Find out on an interrupted file of ours what OpenFileWO does (docs/servers.md 8): the size tells,
        asked afterwards, since the reply to OpenFileWO may say what it was before. What is not seen to keep
        the file passes for emptying it."""
        path, reached = self.path, self.source.reached
        try:
            await self._server.open(path, Opcode.OPEN_FILE_WO)
            size = (await self._server.open(path)).size
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:  # else somebody removed the file
                self._traits.wo_truncates = True
        else:
            self._traits.wo_truncates = size is None or size < reached

    async def _reopen(self) -> OpenSession | None:
        """Open an interrupted file to go on with it; None if it does not have what was proven."""
        try:
            session = await self._server.open(self.path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            return None
        if session.size is None or session.size >= self.source.reached:
            return session
        await self._server.close()
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
                # Beside who is to wait for a window only, a short queue keeps a place for the Terminate.
                rival = self._scheduler.rival_use(self)
                most = None if rival is None or rival >= LIGHT_USE else traits.queue_limit
                chunks = self._scheduler.write_chunks
                transfer = WriteTransfer(
                    session.id, self.source, chunks, in_flight=most, on_starved=server.wake
                )
                self.transfer = server.transfer = transfer
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
                    self._note_refusal(transfer, error)
                    raise error
                rearmed = True
                # From now on path operations take turns with this upload: first those under way end.
                await gate.let_in(0.0)
                await self._rearm()
        finally:
            gate.open()

    def _on_batch(self, now: float) -> None:
        """A batch of replies was processed."""
        transfer = self.transfer
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
                rivals = self._traits.wo_truncates is False or self._vehicle.foreign_client(clock())
                stop = Stop.DOUBT if rivals else stop
            if stop is not None:
                transfer.paused = True
                if transfer.drained or stop in _ABRUPT or self._trails(stop, transfer):
                    self.endings += 1
                    return stop
            elif gate.shut and gate.waiting:
                transfer.paused = True
                if transfer.drained:
                    await gate.let_in(max(_PATHS_TURN, 4.0 * (self._engine.rtt or 0.0)))
                    await self._rearm()
                    transfer.paused = False
            else:
                transfer.paused = False
            driver.kick()
            self._scheduler.expire_waiters()
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
        now, resumable = self._clock(), self.resumable()
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
            over = self._traits.wo_truncates is False and now - session.opened_at >= CHECKPOINT_EVERY
        else:
            over = resumable and self.gives_way(rival, session.opened_at, now, self._engine.rtt)
        return Stop.YIELD if over else None

    def _trails(self, stop: Stop, transfer: WriteTransfer) -> bool:
        """Whether the Terminate goes out right behind the last requests: a round trip less for who waits.
        Servers carry them out in order; what gets lost is sent when the file is open again. Where others'
        paths cause refusals, the answers are waited for: that alone sets it right."""
        if stop is not Stop.YIELD or self._traits.wo_truncates is not False:
            return False
        if self._engine.traits.paths_disarm or self._server.is_excluded(self.path):
            return False
        if transfer.all_out:
            transfer.repeat_nothing()
        return transfer.trailing

    def _end_transfer(self) -> MavftpfsError | None:
        """The session is closed, or lost: what was not ACKed goes back to the source. Return what failed of
        the last requests, which were on their way when it was closed."""
        transfer = self.transfer
        if transfer is None:
            return None
        self.transfer = self._server.transfer = None
        if transfer.trailing and not transfer.drained:
            self._engine.stats.retransmissions += 1  # it goes again, and the first may come later than that
        transfer.finish()
        self._driver.cancel(transfer)
        return transfer.error

    def _note_refusal(self, transfer: WriteTransfer, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: the same place twice is enough.

        Raises:
            FtpNak: it was the same place.
        """
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL and transfer.failed_at is not None:
            if transfer.failed_at == self.refused_at:
                raise nak
            self.refused_at = transfer.failed_at

    async def _rearm(self) -> None:
        """List the storage's root, whose trailing slash fits PX4's whitelist; also clears a sticky errno.

        One request from beyond the end suffices; whatever it answers, the next write tells.
        """
        wire = wire_path(storage_root(self.path)).rstrip(b"/") + b"/"
        with suppress(FtpNak):
            await self._driver.run(Simple(Opcode.LIST_DIRECTORY, wire, offset=_BEYOND_ANY_LISTING))

    # --- letting go

    async def _close(self, stop: Stop) -> None:
        """Close the file, and judge by that what of it is written."""
        transfer = self.transfer  # if any, its last requests are on their way
        if stop is Stop.ABORTED:
            await self._server.close_quietly()
            return
        try:
            ours = await self._terminate(TERMINATE_LIMIT if stop is Stop.ARMED else None)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        last = self._end_transfer()
        if last is not None and transfer is not None:
            self._engine.traits.paths_disarm |= is_disarmed(last)
            self._note_refusal(transfer, last)
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        self.source.check_point()
        if isinstance(last, REFUSALS) and not is_disarmed(last):
            raise last
        if stop is Stop.ARMED:
            self.fail(Armed("the vehicle was armed"))
        elif stop in (Stop.FINISHED, Stop.STARVED):
            self.complete()

    async def _terminate(self, limit: float | None) -> bool:
        """Terminate; return whether what was ACKed counts as written.

        A vehicle that restarted before may have answered: ArduPilot ACKs the end of a session that it does
        not know. What it had in memory is lost then.
        """
        server, vehicle = self._server, self._vehicle
        heard_at, reboots = self._driver.last_reply_at, vehicle.reboots
        ours = await server.close(limit)
        if vehicle.identity.away_since(heard_at, server.clock()):
            server.doubt.raise_it("the vehicle was away when a file was closed, and may have restarted")
        return ours and vehicle.reboots == reboots

    async def _clean_up(self, error: MavftpfsError) -> None:
        """Close what can be closed, and roll back what is not proven."""
        self._end_transfer()
        written, session = False, self._server.session  # None where it failed before it got it
        if isinstance(error, REFUSALS) and session is not None and session.writing:
            with suppress(MavftpfsError):  # another failure is no news
                written = await self._terminate(TERMINATE_LIMIT)
        else:
            self._server.abandon()
        if written:
            self.source.check_point()
        else:
            self._roll_back()

    def _roll_back(self) -> None:
        self._end_transfer()
        self.source.roll_back(everything=self._traits.wo_truncates is not False or not self.source.closed)


def storage_root(path: bytes) -> bytes:
    """Return where the storage of a path is mounted: /fs/NAME on NuttX, else the parent directory."""
    parts = path.split(b"/")
    if len(parts) > 3 and parts[1] == b"fs":
        return b"/".join(parts[:3])
    return split(path)[0] or ROOT


def is_disarmed(error: MavftpfsError) -> bool:
    """Whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _REFUSED_ARM
