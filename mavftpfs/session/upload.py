"""One upload: its callers, what it does next, and how it uses its turns. Layer: session.

CreateFile makes the file. Whether an upload can be interrupted depends on the server's OpenFileWO:

| OpenFileWO | the upload |
|---|---|
| keeps the content | may stop at any time: Terminate once its requests are answered, and later OpenFileWO |
| empties the file | keeps the session until its source has nothing more: resuming means to start anew |
| is not known yet | stops when another user waits; reopening the file shows which of the two is true |

Bytes that were ACKed before an ACKed Terminate are written.
"""

from __future__ import annotations

from math import inf

import trio

from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.writing import WriteTransfer, is_path_refusal
from mavftpfs.session.scheduler import Future, Scheduler, SessionUser, Turn
from mavftpfs.session.serversession import TERMINATE_LIMIT, OpenSession
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    ProtocolError,
    SessionLost,
)
from mavftpfs.shared.model import is_on_nuttx, split, wire_path
from mavftpfs.shared.sending import SendBuffer

RETRY_AFTER = 5.0
"""Seconds after a failure of the link before it is tried again in the background."""

DRAINED_SECONDS = 0.5
"""Seconds for which an upload keeps the session with nothing to send, because PX4 frees buffers after 2 s,
and a log that a program appends to each second must not keep the session for ever."""

CHECKPOINT_EVERY = 60.0
"""Seconds after which an upload terminates and resumes, because a lost session costs all bytes since the last
Terminate."""

REFUSALS = (FtpNak, ProtocolError)
"""Errors after which the upload is tried again only at the next `finish`."""


class Upload(SessionUser):
    """Implements cache.remote.Upload. The upload sends nothing before its source has something, or `finish`
    is called.

    Attributes:
        may_exist, made_twice: see cache.remote.Upload.
    """

    def __init__(self, path: bytes, source: SendBuffer, scheduler: Scheduler) -> None:
        super().__init__(path, writing=True)
        self._source = source
        self.may_exist = self.made_twice = False
        self._scheduler = scheduler
        self._server = scheduler.server
        self._vehicle = scheduler.server.vehicle
        self._engine = scheduler.server.engine
        self._clock = scheduler.clock
        self._finishers: dict[Future, float] = {}  # of those that wait for the end, with when they began to
        self._scope = trio.CancelScope()  # of its task: cancelled when its owner gives it up
        self._over = trio.Event()  # set when its task ended
        self._changed = trio.lowlevel.ParkingLot()
        self._transfer: WriteTransfer | None = None  # what sends its bytes now
        self._furthest = 0  # one past the highest byte that was ever ACKed
        self._cannot_resume = False  # its file was not found again as it was left

    # --- the owner's side

    def wake(self) -> None:
        """Note that the source has more."""
        self._changed.unpark_all()
        self._server.wake()

    async def finish(self) -> None:
        """See cache.remote.Upload."""
        if self._scope.cancel_called:
            raise LocalProtocolError("the upload was ended")
        self._vehicle.require(self._clock(), writing=True)
        self.tries.begin_anew()
        finisher = Future()
        self._finishers[finisher] = self._clock()
        self.wake()
        try:
            await finisher.wait()
        finally:
            del self._finishers[finisher]

    async def end(self) -> None:
        """See cache.remote.Upload."""
        self._scope.cancel()
        self._fail(LocalProtocolError("the upload was ended"))
        self._scheduler.remove(self)
        await self._over.wait()

    def status(self) -> dict[str, object]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "path": self.path.decode("utf-8", "replace"),
            "running": self._transfer is not None,
            "reached": self._source.reached,
            "unproven": self._source.acked.total,
        }

    @property
    def awaited(self) -> bool:
        """Whether a caller waits in `finish`."""
        return self.awaited_since is not None

    @property
    def awaited_since(self) -> float | None:
        """See SessionUser."""
        return min((since for finisher, since in self._finishers.items() if not finisher.ended), default=None)

    def on_armed_changed(self) -> None:
        """Raise Armed in the callers at once if the upload waits for a turn. In a turn, `_watch` notices that
        the vehicle is armed. The upload resumes when the vehicle disarms."""
        if not self._vehicle.may_write:
            self._scheduler.refuse(self, Armed("the vehicle was armed"))
        self._changed.unpark_all()

    # --- its task

    async def run(self) -> None:
        """Take a turn whenever there is something to send, until `end`. After a failure it is tried again in
        the background."""
        try:
            with self._scope:
                while True:
                    try:
                        await self._go_on()
                    except MavftpfsError as error:
                        self._fail(error)
        finally:
            self._over.set()

    async def _go_on(self) -> None:
        """Do the next thing: wait, let callers go, or take a turn. An empty file, too, takes one."""
        if self.awaited:
            self._vehicle.require(self._clock(), writing=True)
        if (pause := self._due_in()) > 0.0:
            with trio.move_on_after(pause):
                await self._changed.park()
        elif self._source.has_checkpoint and not self._source.has_more():
            self._complete(list(self._finishers))
        else:
            if (failure := self._scheduler.failure(self)) is not None:
                raise failure
            async with self._scheduler.turn(self) as turn:
                await self._use(turn)

    def _due_in(self) -> float:
        """Return in how many seconds the upload needs a turn, unless it is woken before. While the vehicle is
        armed, it needs none, so that no reader yields to it. If its file cannot be resumed, more bytes cost
        the whole file once more, so they wait for the next `finish`."""
        costs_all = self._source.has_checkpoint and not self._may_interrupt
        wanted = self.awaited or (self._source.has_more() and not costs_all)
        if not wanted or not self._vehicle.may_write:
            return inf
        return self.tries.retry_at - self._clock()

    def _fail(self, error: MavftpfsError) -> None:
        """Raise an error in each `finish` that waits, and try again after RETRY_AFTER; after a refusal only
        at the next `finish`."""
        for finisher in self._finishers:
            finisher.end(error)
        self.tries.begin_anew(inf if isinstance(error, REFUSALS) else self._clock() + RETRY_AFTER)

    async def _use(self, turn: Turn) -> None:
        """Use a turn: open, write, close."""
        try:
            session = await self._open(turn)
            await self._write(turn, session)
            # All that was given by now is in the file that is closed next; what comes later is not.
            complete, finishers = self._source.ranges.empty, list(self._finishers)
            await self._close(session)
            if complete:
                self._complete(finishers)
        except MavftpfsError as error:
            self._on_failure(error)

    def _on_failure(self, error: MavftpfsError) -> None:
        """Have all bytes since the last checkpoint sent again, because a turn failed. A lost session is no
        error, because the upload tries again.

        Raises:
            MavftpfsError: what it failed with; Armed if the vehicle is armed.
        """
        self._source.roll_back()
        if not isinstance(error, SessionLost):
            self._server.leave()
            raise error if self._vehicle.may_write else Armed(readonly.ARMED)
        self._scheduler.lose(self, error)

    @property
    def _keeps_content(self) -> bool:
        """Whether OpenFileWO was seen to keep what a file has."""
        return self._engine.traits.wo_truncates is False

    @property
    def _may_interrupt(self) -> bool:
        """Whether the file may be closed now and resumed later: the server keeps the content, or closing and
        reopening this file is the way to learn that."""
        to_tell = self._engine.traits.wo_truncates is None and not self._cannot_resume
        return self._keeps_content or (to_tell and self._source.reached > 0)

    def _complete(self, finishers: list[Future]) -> None:
        """Return from these callers' `finish`: all bytes that the source had then are ACKed, and the file was
        closed."""
        for finisher in finishers:
            finisher.end()
        self.tries.begin_anew()

    # --- opening

    async def _open(self, turn: Turn) -> OpenSession:
        """Open the upload's file: resume it if possible, otherwise create it."""
        source = self._source
        if source.has_checkpoint and self._may_interrupt:
            session = await self._reopen(turn)
            if session is not None:
                return session
            self._cannot_resume = True
        source.start_over()
        self.made_twice |= self.may_exist
        self.may_exist = True
        try:
            session = await turn.open(Opcode.CREATE_FILE)
        except FtpNak as nak:
            self.made_twice |= nak.retransmitted
            raise
        self.made_twice |= session.resent
        return session

    async def _reopen(self, turn: Turn) -> OpenSession | None:
        """Open an interrupted file to resume it; return None if it lacks bytes of the last checkpoint. Each
        open closes the one before.

        The first call since the vehicle's start finds out whether OpenFileWO empties files (docs/servers.md
        8), by the size in the ACK of a later OpenFileRO, because the ACK of OpenFileWO may hold the size
        before. After a refusal, only this upload stops being interrupted, because a refusal proves nothing of
        the server.
        """
        traits, reached = self._engine.traits, self._source.reached
        try:
            session = await turn.open(Opcode.OPEN_FILE_WO)
            if traits.wo_truncates is None:
                size = (await turn.open()).size
                if size is not None:
                    traits.wo_truncates = size < reached
                if not self._keeps_content:
                    return None
                session = await turn.open(Opcode.OPEN_FILE_WO)
        except FtpNak:  # the file is gone, or this server opens none like that
            return None
        return session if session.size is None or session.size >= reached else None

    # --- writing

    async def _write(self, turn: Turn, session: OpenSession) -> None:
        """Write until there is a reason to stop. The session is still open then, and all sent bytes are
        ACKed, unless the server went silent or the vehicle is armed.

        Raises:
            SessionLost, FtpNak, RequestTimeout, RemoteProtocolError: what the transfer failed with.
        """
        server = self._server
        # An interactive user that waits gets the session after these requests. On a slow radio a whole queue
        # of them takes a quarter of a second.
        queue = self._engine.traits.queue_limit
        transfer = WriteTransfer(
            session.id,
            self._source,
            self._scheduler.write_chunks,
            root=storage_root(self.path),
            in_flight=queue // 2 if queue and turn.interactive_waits else None,
        )
        self._transfer = transfer
        try:
            with server.running(transfer, self._on_batch):
                await self._watch(turn, session, transfer)
        except FtpNak as error:
            if is_path_refusal(error) and self._server.others.are_heard(self._clock()):
                # That client's requests with a path do not alternate with these writes; the next turns try
                # again.
                raise SessionLost(f"beside another FTP client: {error}") from error
            raise
        finally:
            self._transfer = None

    def _on_batch(self, now: float) -> None:
        """Note progress. Bytes that were ACKed before the session was lost are none."""
        if self._source.reached > self._furthest:
            self._furthest = self._source.reached
            self.tries.begin_anew()

    async def _watch(self, turn: Turn, session: OpenSession, transfer: WriteTransfer) -> None:
        """Return when the upload is to close its file: the vehicle is armed, the source has nothing more, the
        server is silent, or another user is to go first and all sent bytes are ACKed."""
        server, clock = self._server, self._clock
        fed_at = clock()
        while not transfer.done and self._vehicle.may_write:
            server.require_open(session)
            if not transfer.drained:
                fed_at = clock()
            elif self.awaited or clock() - fed_at >= DRAINED_SECONDS:
                return
            if server.is_stalled(transfer) and self._may_close_after_silence:
                if self.tries.barren_for(clock()) > 0.0:
                    raise SessionLost("no answer for a while during a write", by_server=False)
                return
            transfer.paused = self._yields(turn, session)
            if transfer.paused and transfer.idle:
                return
            await server.look_again()

    @property
    def _may_close_after_silence(self) -> bool:
        """Whether a silence ends the turn: the session may be gone (servers.md 14.9), which the answer to
        Terminate shows. If closing costs the whole file, the upload closes it only if another client was
        heard; otherwise the transfer's own patience ends it."""
        return self._keeps_content or self._server.others.are_heard(self._clock())

    def _yields(self, turn: Turn, session: OpenSession) -> bool:
        """Return whether the file should be closed now, to be resumed in a later turn."""
        if self._scheduler.is_excluded(self.path):
            return True
        if turn.contended:
            return self._may_interrupt and turn.is_over()
        return self._keeps_content and self._clock() - session.opened_at >= CHECKPOINT_EVERY

    # --- letting go

    async def _close(self, session: OpenSession) -> None:
        """Close the file, and take all ACKed bytes for written if that worked.

        A vehicle that restarted before may ACK the Terminate, too, because ArduPilot ACKs that of any
        session. But a restart makes ACKs suspect, so the file is compared; and `_reopen` compares its size.
        """
        self._server.require_open(session)
        if not await self._server.close(inf if self._vehicle.may_write else TERMINATE_LIMIT):
            raise SessionLost("the vehicle had closed the session before", by_server=True)
        self._source.check_point()


def storage_root(path: bytes) -> bytes:
    """Return the directory, with a slash at its end, that fits PX4's whitelist for writes: `/fs/NAME/` on
    NuttX, else where the file is."""
    root = b"/".join(path.split(b"/")[:3]) if is_on_nuttx(path) else split(path)[0]
    return wire_path(root).rstrip(b"/") + b"/"
