"""Sends one upload's bytes until there is a reason to let go of the session. Layer: session.

Where OpenFileWO was seen to keep a file's content an upload can be interrupted at any time: Terminate right
behind the window, and later OpenFileWO and what of that was not ACKed. Where it was seen to empty files that
would begin the file anew, so the upload keeps the session until its source has nothing more. Where neither
was seen yet, the upload is interrupted when somebody waits, and reopening its file tells.

PX4 on NuttX checks each WriteFile against a scratch buffer that every path operation overwrites
(docs/servers.md 8). Once that was seen, path operations and writes take turns.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from enum import Enum

import trio

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.driver import Driver
from mavftpfs.session.fairness import LIGHT_USE, Queue
from mavftpfs.session.serversession import OpenSession, ServerSession
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError
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

_TURN = 0.5
_OFTEN = 0.25
_SELDOM = 1.0
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
        self._news = trio.Event()

    @property
    def wanted(self) -> bool:
        """Whether a path operation waits to be let in."""
        return self._shut and self._waiting > 0

    def shut(self, shut: bool) -> None:
        """Begin or end to keep path operations out."""
        self._shut = shut
        self._tell()

    @asynccontextmanager
    async def passing(self) -> AsyncIterator[None]:
        """Wait to be let in, and stay inside for the length of the body."""
        self._waiting += 1
        try:
            while self._shut and not self._open:
                self._on_wanted()
                await self._news.wait()
        finally:
            self._waiting -= 1
            self._tell()
        self._inside += 1
        try:
            yield
        finally:
            self._inside -= 1
            self._tell()

    async def let_in(self, seconds: float) -> None:
        """Let path operations in for at most so long, and wait until the last of them is out."""
        self._open = True
        self._tell()
        with trio.move_on_after(seconds):
            while self._waiting or self._inside:
                await self._news.wait()
        self._open = False
        while self._inside:
            await self._news.wait()

    def _tell(self) -> None:
        self._news.set()
        self._news = trio.Event()


class Writer:
    """Runs write transfers.

    may_write: whether the vehicle may be written to now.

    Attributes:
        current: the upload being run. rearms: how often PX4's scratch buffer had to be set right.
    """

    def __init__(
        self,
        server: ServerSession,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        queue: Queue,
        clock: Callable[[], float],
        chunks: ChunkSize,
        may_write: Callable[[], bool],
    ) -> None:
        self.path_gate = PathGate(server.wake)
        self.rearms = 0
        self.current: QueuedUpload | None = None
        self._server = server
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._clock = clock
        self._queue = queue
        self._chunks = chunks
        self._may_write = may_write
        self._disarmed_by_paths = False
        self._transfer: WriteTransfer | None = None
        self._last: WriteTransfer | None = None
        self._starved_at: float | None = None

    # --- news

    def on_more(self, upload: QueuedUpload) -> None:
        """The source of an upload has more, or somebody waits for its end."""
        if upload is self.current and self._transfer is not None:
            self._starved_at = None
            self._transfer.wake()
            self._driver.kick()

    def on_batch(self) -> None:
        """A batch of replies was processed."""
        transfer = self._transfer
        if transfer is not None and (transfer.idle or transfer.done):
            self._server.wake()

    def on_reboot(self) -> None:
        """Perhaps other firmware runs now; nothing under way gets an answer."""
        self._disarmed_by_paths = False
        self.cut_off()

    def cut_off(self) -> None:
        """The session is another file's, or nobody's."""
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    @property
    def resumable(self) -> bool:
        """Whether a file that was closed can be written on (WriteTraits.wo_truncates is False)."""
        return self._queue.write_traits.wo_truncates is False

    def may_try(self, upload: QueuedUpload) -> bool:
        """Whether reopening its file is to tell what OpenFileWO does: at most its own bytes go again."""
        unknown = self._queue.write_traits.wo_truncates is None
        return unknown and not upload.tried and upload.feed.reached > 0

    def starves(self, upload: QueuedUpload) -> bool:
        """Whether others are not to go before it any more."""
        return upload.share.waited_long(self._clock(), self._engine.rtt)

    # --- writing

    async def run(self, upload: QueuedUpload, session: OpenSession) -> Stop:
        """Write until there is a reason to stop; the session is still open then, and what is in flight waits
        for nothing but its answers: `end` follows when the session is closed.

        Raises:
            SessionLost, FtpNak, RequestTimeout, RemoteProtocolError: what the transfer failed with.
        """
        self.current = upload
        try:
            return await self._write(upload, session)
        finally:
            self.current = None
            self.path_gate.shut(False)

    async def _write(self, upload: QueuedUpload, session: OpenSession) -> Stop:
        rearms = 0
        self.path_gate.shut(self._disarmed_by_paths)
        while True:
            transfer = WriteTransfer(
                session.id,
                upload.feed,
                self._chunks,
                in_flight=self._most_in_flight(upload),
                on_starved=self._server.wake,
            )
            stop = await self._drive(upload, session, transfer)
            if transfer.acked_bytes and rearms:
                self._disarmed_by_paths = True
                rearms = 0
            error = transfer.error
            if stop is not None and error is None:
                return stop
            assert error is not None
            if not is_disarmed(error) or rearms > 0:
                self._note_refusal(upload, transfer.failed_at, error)
                raise error
            rearms += 1
            # From now on path operations take turns with this upload: first those that are under way end.
            self.path_gate.shut(True)
            await self.path_gate.let_in(0.0)
            await self._rearm(upload.path)

    def _most_in_flight(self, upload: QueuedUpload) -> int | None:
        """Beside somebody who is to wait for a window only a short queue keeps a place for the Terminate."""
        use = self._queue.rival_use(upload)
        return None if use is None or use >= LIGHT_USE else self._engine.traits.queue_limit

    async def _drive(
        self, upload: QueuedUpload, session: OpenSession, transfer: WriteTransfer
    ) -> Stop | None:
        """Run a transfer until there is a reason to let go, or it failed (None)."""
        self._transfer, self._starved_at = transfer, None
        self._driver.start(transfer, self._server.wake)
        try:
            async with self._server.traffic():
                return await self._watch(upload, session, transfer)
        finally:
            self._transfer, self._last = None, transfer
            if not transfer.trailing:
                self.end()

    def end(self) -> MavftpfsError | None:
        """The session is closed, or lost: what was not ACKed goes back to the source. Return what failed of
        the last requests, which were on their way when it was closed."""
        transfer, self._last = self._last, None
        if transfer is None:
            return None
        if transfer.trailing and not transfer.drained:
            self._engine.stats.retransmissions += 1  # it goes again, and the first may come later than that
        transfer.stop()
        self._driver.cancel(transfer)
        return transfer.error

    async def _watch(
        self, upload: QueuedUpload, session: OpenSession, transfer: WriteTransfer
    ) -> Stop | None:
        stop: Stop | None = None
        while not transfer.done:
            self._server.require(session)
            stop = stop or self._reason_to_stop(upload, session, transfer)
            if self._in_doubt(transfer):
                stop = Stop.DOUBT
            if stop is not None:
                transfer.pause()
                if transfer.drained or stop in _ABRUPT or self._trails(upload, stop, transfer):
                    upload.mark()
                    return stop
            elif self.path_gate.wanted:
                await self._give_turn(upload, transfer)
            elif transfer.paused:
                self._go_on(transfer)
            self._queue.expire_waiters()
            await self._server.sleep(self._nap(upload, transfer))
        return None

    def _trails(self, upload: QueuedUpload, stop: Stop, transfer: WriteTransfer) -> bool:
        """Whether the Terminate goes out right behind the last requests: a round trip less for who waits.
        Servers carry them out in order; what gets lost is sent when the file is open again. After a refusal,
        and where others' paths cause such, the answers are waited for: that alone sets it right."""
        if stop is not Stop.YIELD or not self.resumable or self._server.claimed(upload.path):
            return False
        if upload.refused_behind or self._disarmed_by_paths:
            return False
        if transfer.all_out:
            transfer.repeat_nothing()
        return transfer.trailing

    def _nap(self, upload: QueuedUpload, transfer: WriteTransfer) -> float:
        """How long nothing needs to be looked at, unless there is news."""
        pressed = self._queue.rival_use(upload) is not None
        if transfer.starved:
            return BRIEF_STARVE if pressed else _OFTEN
        return _OFTEN if pressed else _SELDOM

    def _reason_to_stop(
        self, upload: QueuedUpload, session: OpenSession, transfer: WriteTransfer
    ) -> Stop | None:
        now = self._clock()
        if upload.aborted:
            return Stop.ABORTED
        if not self._may_write():
            return Stop.ARMED
        if self._server.claimed(upload.path):
            return Stop.YIELD
        rival = self._queue.rival_use(upload)
        if transfer.starved:
            return self._reason_of_starved(upload, now - session.opened_at, pressed=rival is not None)
        self._starved_at = None
        return Stop.YIELD if self._is_turn_over(upload, session.opened_at, now, rival) else None

    def _reason_of_starved(self, upload: QueuedUpload, slice_: float, *, pressed: bool) -> Stop | None:
        if upload.finishing:
            return Stop.FINISHED
        now = self._clock()
        if self._starved_at is None:
            self._starved_at = now
        patience = STARVE
        if pressed and (self.resumable or self.may_try(upload)):
            patience = BRIEF_STARVE
        elif pressed and slice_ >= PATIENCE:
            patience = 0.0
        return Stop.STARVED if now - self._starved_at >= patience else None

    def _is_turn_over(self, upload: QueuedUpload, began: float, now: float, rival: float | None) -> bool:
        if rival is None:
            return self.resumable and now - began >= CHECKPOINT_EVERY
        may_stop = self.resumable or self.may_try(upload)
        return may_stop and upload.share.gives_way(rival, began, now, self._engine.rtt)

    def _in_doubt(self, transfer: WriteTransfer) -> bool:
        """Whether it was silent for so long that the session may be somebody else's (servers.md 14.9).

        Where closing would cost the whole file, only if there is somebody else; the server tells the rest.
        """
        now = self._clock()
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        if transfer.idle or now - max(self._driver.last_reply_at, transfer.progress_at) <= limit:
            return False
        return self.resumable or self._vehicle.foreign_client(now)

    def _note_refusal(self, upload: QueuedUpload, offset: int | None, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: the same place twice is enough."""
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL:
            if offset is not None and offset == upload.refused_at:
                raise nak
            upload.refused_at = offset

    # --- path operations beside it

    async def _give_turn(self, upload: QueuedUpload, transfer: WriteTransfer) -> None:
        """Drain, let path operations pass, arm again, go on."""
        transfer.pause()
        if not transfer.drained:
            return
        await self.path_gate.let_in(max(_TURN, 4.0 * (self._engine.rtt or 0.0)))
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


def storage_root(path: bytes) -> bytes:
    """Return where the storage of a path is mounted: /fs/NAME on NuttX, else the parent directory."""
    parts = path.split(b"/")
    if len(parts) > 3 and parts[1] == b"fs":
        return b"/".join(parts[:3])
    return split(path)[0] or ROOT


def is_disarmed(error: MavftpfsError) -> bool:
    """Whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _REFUSED_ARM
