"""All uploads: which are due, how their files open and close, and what becomes of failures. Layer: session.

A file is made by CreateFile. Where its upload was interrupted it goes on by OpenFileWO, if the server was
seen to keep what a file has; else the file is sent anew. What was ACKed before an ACKed Terminate is written.
"""

from __future__ import annotations

import errno
from collections.abc import Callable

from mavftpfs.cache.remote import UploadSource
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.fairness import Queue
from mavftpfs.session.serversession import TERMINATE_LIMIT, OpenSession, ServerSession
from mavftpfs.session.upload import Feed, QueuedUpload
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.session.writer import Stop, Writer, is_disarmed
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

REFUSALS = (FtpNak, ProtocolError, SpoolFailed)
"""Errors that do not pass by themselves."""

REOPENS = 5
"""How often the session may be lost without getting further in the file before the upload fails."""


class Uploading:
    """Queues uploads and serves one at a time. when_armed_ok: write in flight, too.

    Attributes:
        uploads: those that their owners neither completed nor gave up. writer: sends what they have.
    """

    def __init__(
        self,
        server: ServerSession,
        driver: Driver,
        engine: Engine,
        queue: Queue,
        doubt: Doubt,
        clock: Callable[[], float],
        vehicle: Vehicle,
        chunks: ChunkSize,
        *,
        when_armed_ok: bool = False,
    ) -> None:
        self.uploads: list[QueuedUpload] = []
        self.writer = Writer(server, driver, engine, vehicle, queue, clock, chunks, lambda: self.may_write)
        self._server = server
        self._driver = driver
        self._queue = queue
        self._vehicle = vehicle
        self._doubt = doubt
        self._clock = clock
        self._chunk = chunks.most
        self._when_armed_ok = when_armed_ok

    # --- what others ask for and tell

    def add(self, path: bytes, source: UploadSource) -> QueuedUpload:
        """Queue an upload."""
        upload = QueuedUpload(self, path, Feed(source, self._chunk), self._clock())
        self.uploads.append(upload)
        self._server.wake()
        return upload

    @property
    def may_write(self) -> bool:
        """Whether the vehicle may be written to now (design promise 9)."""
        return self._when_armed_ok or not self._vehicle.armed

    def check_may_write(self) -> None:
        """Raise Armed or VehicleLost."""
        if not self.may_write:
            raise Armed("the vehicle is armed: nothing is written in flight")
        self._vehicle.require_there(self._clock())

    def now(self) -> float:
        """See UploadHost."""
        return self._clock()

    def on_news(self, upload: QueuedUpload) -> None:
        """See UploadHost."""
        self.writer.on_more(upload)
        self._server.wake()

    def forget(self, upload: QueuedUpload) -> None:
        """See UploadHost."""
        if upload in self.uploads:
            self.uploads.remove(upload)

    def on_armed(self) -> None:
        """The armed state changed: whoever waits for an upload is told now, the running one ends itself."""
        now = self._clock()
        for upload in self.uploads:
            if not self.may_write and not upload.running and upload.finishing:
                upload.fail(Armed("the vehicle was armed"), now)
            if self.may_write:
                upload.rest_until(now)
        self._server.wake()

    def on_reboot(self) -> None:
        """What was proven may not be there any more, and what OpenFileWO does was forgotten."""
        for upload in self.uploads:
            upload.restarted, upload.tried = True, False
        self.writer.on_reboot()

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
        times = [upload.retry_at for upload in self.uploads if upload.wanted]
        return min((time for time in times if time > now), default=float("inf"))

    def expire(self, upload: QueuedUpload, error: MavftpfsError) -> None:
        """Tell whoever waits for an upload that it got no turn."""
        if upload.finishing and not upload.running:
            upload.fail(error, self._clock())

    async def serve(self, upload: QueuedUpload) -> bool:
        """Use the session for an upload; its errors are told to the upload.

        Returns:
            False if only another file was closed for it. Somebody may have come meanwhile who goes first.
        """
        started = self._clock()
        upload.running = served = True
        try:
            if not self._is_complete_already(upload):
                self.check_may_write()
                served = await self._serve(upload)
        except SessionLost as lost:
            self._on_lost(upload, lost)
        except MavftpfsError as error:
            await self._on_error(upload, error)
        finally:
            now = self._clock()
            upload.running = False
            upload.share.on_turn(started, now)
            if served:
                upload.share.asked_at = max(now, upload.retry_at)
            else:
                upload.feed.put_back()
            if not self.may_write and upload.finishing and upload.error is None:
                upload.fail(Armed("the vehicle was armed"), now)  # while its file was opened or closed
            upload.tell()
        return served

    async def _serve(self, upload: QueuedUpload) -> bool:
        """Open, write and close; return False if another file was closed for it and it is not yet open."""
        if not self.writer.starves(upload) and await self._server.made_room(upload.path):
            return False
        session = await self._open(upload)
        try:
            await self._let_go(upload, await self.writer.run(upload, session))
        finally:
            self.writer.end()
        return True

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
        if upload.restarted and (feed.proven or feed.unproven):
            feed.roll_back(everything=True)
        upload.restarted = False
        if feed.proven and self.writer.may_try(upload):
            await self._find_out(upload)
        if feed.proven and self.writer.resumable:
            session = await self._reopen(upload)
            if session is not None:
                return session
        if feed.proven or feed.unproven:
            feed.roll_back(everything=True)
        if upload.aborted:  # its owner was told that nothing was begun
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

    async def _find_out(self, upload: QueuedUpload) -> None:
        """Find out on an interrupted file of ours what OpenFileWO does (docs/servers.md 8): the size tells,
        asked afterwards, since the reply to OpenFileWO may say what it was before."""
        traits, reached = self._queue.write_traits, upload.feed.reached
        upload.tried = True
        try:
            await self._server.open(upload.path, Opcode.OPEN_FILE_WO)
            size = (await self._server.open(upload.path)).size
        except FtpNak:
            return  # it is refused, or somebody removed the file: what is not seen stays unknown
        if size == 0:
            traits.wo_truncates = True
        elif size is not None and size >= reached:
            traits.wo_truncates = False

    async def _reopen(self, upload: QueuedUpload) -> OpenSession | None:
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

    # --- letting go

    async def _let_go(self, upload: QueuedUpload, stop: Stop) -> None:
        feed = upload.feed
        if stop is Stop.ABORTED:
            await self._server.close_quietly()
            return
        try:
            ours = await self._close(TERMINATE_LIMIT if stop is Stop.ARMED else None)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        last = self.writer.end()
        upload.refused_behind = last is not None
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        feed.check_point()
        if isinstance(last, REFUSALS) and not is_disarmed(last):
            raise last
        if stop is Stop.ARMED:
            upload.fail(Armed("the vehicle was armed"), self._clock())
        elif stop in (Stop.FINISHED, Stop.STARVED):
            upload.complete(more=feed.has_more())
            upload.waits_for_finish = not self.writer.resumable and not self.writer.may_try(upload)

    async def _close(self, limit: float | None) -> bool:
        """Terminate; return whether what was ACKed counts as written.

        A vehicle that restarted before may have answered: ArduPilot ACKs the end of a session that it does
        not know. What it had in memory is lost then.
        """
        heard_at, reboots = self._driver.last_reply_at, self._vehicle.reboots
        ours = await self._server.close(limit)
        if self._vehicle.identity.away_since(heard_at, self._clock()):
            self._doubt.raise_it("the vehicle was away when a file was closed, and may have restarted")
        return ours and self._vehicle.reboots == reboots

    async def _close_refused(self, upload: QueuedUpload) -> bool:
        """Close after a refusal that is reported, if the file is open. Another failure is no news."""
        session = self._server.session  # None where it failed before it got it
        if session is None or not session.writing or session.path != upload.path:
            return False
        try:
            return await self._close(TERMINATE_LIMIT)
        except MavftpfsError:
            return False

    def _roll_back(self, upload: QueuedUpload) -> None:
        keep = self.writer.resumable and upload.feed.proven
        if upload.feed.proven or upload.feed.unproven:
            upload.feed.roll_back(everything=not keep)
        else:
            upload.feed.put_back()

    def _on_lost(self, upload: QueuedUpload, lost: SessionLost) -> None:
        """Begin again from what is proven, a bounded number of times."""
        self._server.abandon()
        if lost.by_server:
            self._doubt.raise_it(str(lost))
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
            upload.rest_until(now + (failures - 1) * 0.5)

    async def _on_error(self, upload: QueuedUpload, error: MavftpfsError) -> None:
        """Close what can be closed, roll back what is not proven, and tell whoever waits."""
        refused = isinstance(error, REFUSALS)
        if isinstance(error, RequestTimeout):
            self._vehicle.note_timeout()
        if not refused or isinstance(error, RequestTimeout):
            self._server.abandon()
            self._roll_back(upload)
        elif await self._close_refused(upload):
            upload.feed.check_point()
        else:
            self._roll_back(upload)
        upload.fail(error, self._clock(), refused=refused)
