"""Serves one upload at a time: opens its file, sends what there is, closes, and judges. Layer: session.

A file is made by CreateFile. Where OpenFileWO was seen to keep a file's content an upload can be interrupted
at any time: Terminate right behind the window, and later OpenFileWO and what of that was not ACKed. Where it
was seen to empty files that would begin the file anew, so the upload keeps the session until its source has
nothing more. Where neither was seen yet, the upload is interrupted when somebody waits, and reopening its
file tells. What was ACKed before an ACKed Terminate is written.

PX4 on NuttX checks each WriteFile against a scratch buffer that every path operation overwrites
(docs/servers.md 8). Once that was seen, path operations and writes take turns.
"""

from __future__ import annotations

import errno
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from enum import Enum

import trio

from mavftpfs.cache.remote import UploadSource
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.queue import LIGHT_USE, Queue
from mavftpfs.session.serversession import TERMINATE_LIMIT, OpenSession, ServerSession
from mavftpfs.session.upload import Feed, Upload, UploadState
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
from mavftpfs.shared.traits import WriteTraits

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


class PathGate:
    """Keeps path operations out while an upload writes, and lets them in now and then.

    on_wanted: asks the writer to let somebody in.
    """

    def __init__(self, on_wanted: Callable[[], None]) -> None:
        self._on_wanted = on_wanted
        self._shut = False
        self._open = False
        self._waiting = 0
        self._inside = 0
        self._changed = trio.lowlevel.ParkingLot()

    @property
    def wanted(self) -> bool:
        """Whether a path operation waits to be let in."""
        return self._shut and self._waiting > 0

    def shut(self, shut: bool) -> None:
        """Begin or end to keep path operations out."""
        self._shut = shut
        self._changed.unpark_all()

    @asynccontextmanager
    async def passing(self) -> AsyncIterator[None]:
        """Wait to be let in, and stay inside for the length of the body."""
        self._waiting += 1
        try:
            while self._shut and not self._open:
                self._on_wanted()
                await self._changed.park()
        finally:
            self._waiting -= 1
            self._changed.unpark_all()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1
            self._changed.unpark_all()

    async def let_in(self, seconds: float) -> None:
        """Let path operations in for at most so long, and wait until the last of them is out."""
        self._open = True
        self._changed.unpark_all()
        with trio.move_on_after(seconds):
            while self._waiting or self._inside:
                await self._changed.park()
        self._open = False
        while self._inside:
            await self._changed.park()


class Uploading:
    """Makes uploads, and serves the one whose turn it is.

    Attributes:
        traits: what the server was seen to do. path_gate: what asks the server for a path passes it.
    """

    def __init__(
        self,
        server: ServerSession,
        driver: Driver,
        queue: Queue,
        doubt: Doubt,
        traits: WriteTraits,
        chunks: ChunkSize,
        clock: Callable[[], float],
    ) -> None:
        self.traits = traits
        self.path_gate = PathGate(server.wake)
        self._server = server
        self._driver = driver
        self._engine = driver.engine
        self._queue = queue
        self._vehicle = driver.vehicle
        self._doubt = doubt
        self._chunks = chunks
        self._clock = clock
        self._transfer: WriteTransfer | None = None

    def open_upload(self, path: bytes, source: UploadSource) -> Upload:
        """Queue an upload; nothing is sent before the source has something or `finish` is called."""
        feed = Feed(source, self._chunks.most)
        upload = Upload(path, feed, self._queue, self._server, self._vehicle, self._clock)
        self._queue.add(upload)
        return upload

    def cut_off(self) -> None:
        """The session is another file's, or nobody's."""
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    async def serve(self, upload: Upload) -> None:
        """Use the session for an upload; its errors are told to the upload."""
        began = self._clock()
        try:
            if upload.begin_turn(resumable=self._is_interruptible(upload)):
                self._vehicle.require_writable(began)
                session = await self._open(upload)
                await self._close(upload, await self._write(upload, session))
        except SessionLost as lost:
            self._on_lost(upload, lost)
        except MavftpfsError as error:
            await self._on_error(upload, error)
        finally:
            self._end_transfer()
            upload.end_turn(began)

    def _is_interruptible(self, upload: Upload) -> bool:
        """Whether its file can be closed and written on later: it was seen to be so, or this is to tell."""
        truncates = self.traits.wo_truncates
        return truncates is False or (truncates is None and upload.feed.reached > 0)

    # --- opening

    async def _open(self, upload: Upload) -> OpenSession:
        """Open an upload's file: to go on with it where that is possible, else to begin it."""
        feed = upload.feed
        if upload.reboots != self._vehicle.reboots:  # what was proven may not be there any more
            feed.roll_back(everything=True)
        upload.reboots = self._vehicle.reboots
        if feed.proven and feed.reached and self.traits.wo_truncates is None:
            await self._find_out(upload)
        if feed.proven and self.traits.wo_truncates is False:
            session = await self._reopen(upload)
            if session is not None:
                return session
        feed.roll_back(everything=True)
        if upload.state is UploadState.ENDING:  # its owner was told that nothing was begun
            raise LocalProtocolError("the upload was given up before its file was made")
        upload.resent |= upload.begun
        upload.begun = True  # what is there from now on may be ours
        try:
            session = await self._server.open(upload.path, Opcode.CREATE_FILE)
        except FtpNak as nak:
            upload.resent |= nak.retransmitted
            raise
        upload.resent |= session.resent
        return session

    async def _find_out(self, upload: Upload) -> None:
        """Find out on an interrupted file of ours what OpenFileWO does (docs/servers.md 8): the size tells,
        asked afterwards, since the reply to OpenFileWO may say what it was before. What is not seen to keep
        the file passes for emptying it."""
        reached = upload.feed.reached
        try:
            await self._server.open(upload.path, Opcode.OPEN_FILE_WO)
            size = (await self._server.open(upload.path)).size
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:  # else somebody removed the file
                self.traits.wo_truncates = True
        else:
            self.traits.wo_truncates = size is None or size < reached

    async def _reopen(self, upload: Upload) -> OpenSession | None:
        """Open an interrupted file to go on with it; None if it does not have what was proven."""
        try:
            session = await self._server.open(upload.path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            return None
        if session.size is None or session.size >= upload.feed.reached:
            return session
        await self._server.close()
        return None

    # --- writing

    async def _write(self, upload: Upload, session: OpenSession) -> Stop:
        """Write until there is a reason to stop. The session is open then, and what is in flight waits for
        nothing but its answers: `_end_transfer` follows when the session is closed.

        Raises:
            SessionLost, FtpNak, RequestTimeout, RemoteProtocolError: what the transfer failed with.
        """
        rearmed = False
        self.path_gate.shut(self._engine.traits.paths_disarm)
        try:
            while True:
                # Beside who is to wait for a window only, a short queue keeps a place for the Terminate.
                rival = self._queue.rival_use(upload)
                most = None if rival is None or rival >= LIGHT_USE else self._engine.traits.queue_limit
                transfer = WriteTransfer(
                    session.id, upload.feed, self._chunks, in_flight=most, on_starved=self._server.wake
                )
                stop = await self._run(upload, session, transfer)
                if transfer.acked_bytes and rearmed:
                    self._engine.traits.paths_disarm, rearmed = True, False
                error = transfer.error
                if error is None:
                    assert stop is not None
                    return stop
                if rearmed or not is_disarmed(error):
                    self._note_refusal(upload, transfer, error)
                    raise error
                rearmed = True
                # From now on path operations take turns with this upload: first those under way end.
                self.path_gate.shut(True)
                await self.path_gate.let_in(0.0)
                await self._rearm(upload.path)
        finally:
            self.path_gate.shut(False)

    async def _run(self, upload: Upload, session: OpenSession, transfer: WriteTransfer) -> Stop | None:
        """Run a transfer until there is a reason to let go, or it ended by itself (None)."""
        self._transfer = upload.transfer = transfer
        self._driver.on_batch = self._on_batch
        try:
            await self._driver.start(transfer, self._server.wake)
            return await self._watch(upload, session, transfer)
        finally:
            self._driver.on_batch = upload.transfer = None
            if not transfer.trailing:
                self._end_transfer()

    def _on_batch(self, now: float) -> None:
        """A batch of replies was processed."""
        transfer = self._transfer
        if transfer is not None and (transfer.idle or transfer.done):
            self._server.wake()

    async def _watch(self, upload: Upload, session: OpenSession, transfer: WriteTransfer) -> Stop | None:
        stop: Stop | None = None
        fed_at = self._clock()
        while not transfer.done:
            self._server.require(session)
            if not transfer.starved:
                fed_at = self._clock()
            stop = stop or self._reason_to_stop(upload, session, transfer, fed_at)
            if self._is_stalled(transfer):
                stop = Stop.DOUBT
            if stop is not None:
                transfer.paused = True
                if transfer.drained or stop in _ABRUPT or self._trails(upload, stop, transfer):
                    upload.endings += 1
                    return stop
            elif self.path_gate.wanted:
                await self._let_paths_in(upload, transfer)
            else:
                transfer.paused = False
            self._driver.kick()
            self._queue.expire_waiters()
            pressed = transfer.starved and self._queue.rival_use(upload) is not None
            await self._server.sleep(BRIEF_STARVE if pressed else _OFTEN)
        return None

    def _reason_to_stop(
        self, upload: Upload, session: OpenSession, transfer: WriteTransfer, fed_at: float
    ) -> Stop | None:
        """fed_at: when there was something to send the last time."""
        if upload.state is UploadState.ENDING:
            return Stop.ABORTED
        if not self._vehicle.may_write:
            return Stop.ARMED
        if self._server.is_excluded(upload.path):
            return Stop.YIELD
        now, rival = self._clock(), self._queue.rival_use(upload)
        interruptible = self._is_interruptible(upload)
        if transfer.starved:
            if upload.finishing:
                return Stop.FINISHED
            patience = STARVE
            if rival is not None and interruptible:
                patience = BRIEF_STARVE
            elif rival is not None and now - session.opened_at >= PATIENCE:
                patience = 0.0
            return Stop.STARVED if now - fed_at >= patience else None
        if rival is None:
            over = self.traits.wo_truncates is False and now - session.opened_at >= CHECKPOINT_EVERY
        else:
            over = interruptible and upload.gives_way(rival, session.opened_at, now, self._engine.rtt)
        return Stop.YIELD if over else None

    def _trails(self, upload: Upload, stop: Stop, transfer: WriteTransfer) -> bool:
        """Whether the Terminate goes out right behind the last requests: a round trip less for who waits.
        Servers carry them out in order; what gets lost is sent when the file is open again. Where others'
        paths cause refusals, the answers are waited for: that alone sets it right."""
        if stop is not Stop.YIELD or self.traits.wo_truncates is not False:
            return False
        if self._engine.traits.paths_disarm or self._server.is_excluded(upload.path):
            return False
        if transfer.all_out:
            transfer.repeat_nothing()
        return transfer.trailing

    def _is_stalled(self, transfer: WriteTransfer) -> bool:
        """Whether it was silent for so long that the session may be somebody else's (servers.md 14.9).

        Where closing would cost the whole file, only if there is somebody else; the server tells the rest.
        """
        now = self._clock()
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        if transfer.idle or now - max(self._driver.last_reply_at, transfer.progress_at) <= limit:
            return False
        return self.traits.wo_truncates is False or self._vehicle.foreign_client(now)

    def _end_transfer(self) -> MavftpfsError | None:
        """The session is closed, or lost: what was not ACKed goes back to the source. Return what failed of
        the last requests, which were on their way when it was closed."""
        transfer, self._transfer = self._transfer, None
        if transfer is None:
            return None
        if transfer.trailing and not transfer.drained:
            self._engine.stats.retransmissions += 1  # it goes again, and the first may come later than that
        transfer.stop()
        self._driver.cancel(transfer)
        return transfer.error

    def _note_refusal(self, upload: Upload, transfer: WriteTransfer, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: the same place twice is enough.

        Raises:
            FtpNak: it was the same place.
        """
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL and transfer.failed_at is not None:
            if transfer.failed_at == upload.refused_at:
                raise nak
            upload.refused_at = transfer.failed_at

    # --- path operations beside it

    async def _let_paths_in(self, upload: Upload, transfer: WriteTransfer) -> None:
        """Drain, let path operations pass, arm again, go on."""
        transfer.paused = True
        if transfer.drained:
            await self.path_gate.let_in(max(_TURN, 4.0 * (self._engine.rtt or 0.0)))
            await self._rearm(upload.path)
            transfer.paused = False

    async def _rearm(self, path: bytes) -> None:
        """List the storage's root, whose trailing slash fits PX4's whitelist; also clears a sticky errno.

        One request from beyond the end suffices; whatever it answers, the next write tells.
        """
        wire = wire_path(storage_root(path)).rstrip(b"/") + b"/"
        try:
            await self._driver.run(Simple(Opcode.LIST_DIRECTORY, wire, offset=_BEYOND_ANY_LISTING))
        except FtpNak:
            return

    # --- letting go

    async def _close(self, upload: Upload, stop: Stop) -> None:
        """Close the file, and judge by that what of it is written."""
        feed, transfer = upload.feed, self._transfer  # if there is one, its last requests are on their way
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
            self._note_refusal(upload, transfer, last)
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        feed.check_point()
        if isinstance(last, REFUSALS) and not is_disarmed(last):
            raise last
        if stop is Stop.ARMED:
            upload.fail(Armed("the vehicle was armed"))
        elif stop in (Stop.FINISHED, Stop.STARVED):
            upload.complete(resumable=self._is_interruptible(upload))

    async def _terminate(self, limit: float | None) -> bool:
        """Terminate; return whether what was ACKed counts as written.

        A vehicle that restarted before may have answered: ArduPilot ACKs the end of a session that it does
        not know. What it had in memory is lost then.
        """
        heard_at, reboots = self._driver.last_reply_at, self._vehicle.reboots
        ours = await self._server.close(limit)
        if self._vehicle.identity.away_since(heard_at, self._clock()):
            self._doubt.raise_it("the vehicle was away when a file was closed, and may have restarted")
        return ours and self._vehicle.reboots == reboots

    def _roll_back(self, upload: Upload) -> None:
        self._end_transfer()
        upload.feed.roll_back(everything=self.traits.wo_truncates is not False or not upload.feed.proven)

    def _on_lost(self, upload: Upload, lost: SessionLost) -> None:
        """Begin again from what is proven, a bounded number of times."""
        self._server.abandon()
        if lost.by_server:
            self._doubt.raise_it(str(lost))
        self._roll_back(upload)
        cause = lost.__cause__
        upload.lose_session(cause if isinstance(cause, MavftpfsError) else lost)

    async def _on_error(self, upload: Upload, error: MavftpfsError) -> None:
        """Close what can be closed, roll back what is not proven, and tell whoever waits."""
        self._end_transfer()
        refused, written = isinstance(error, REFUSALS), False
        session = self._server.session  # None where it failed before it got it
        if refused and session is not None and session.writing:
            with suppress(MavftpfsError):  # another failure is no news
                written = await self._terminate(TERMINATE_LIMIT)
        else:
            self._server.abandon()
        if written:
            upload.feed.check_point()
        else:
            self._roll_back(upload)
        upload.fail(error, refused=refused)


def storage_root(path: bytes) -> bytes:
    """Return where the storage of a path is mounted: /fs/NAME on NuttX, else the parent directory."""
    parts = path.split(b"/")
    if len(parts) > 3 and parts[1] == b"fs":
        return b"/".join(parts[:3])
    return split(path)[0] or ROOT


def is_disarmed(error: MavftpfsError) -> bool:
    """Whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _REFUSED_ARM
