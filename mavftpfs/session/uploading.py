"""All uploads: which are due, how they open and close, and what becomes of their failures. Layer: session."""

from __future__ import annotations

import trio

from mavftpfs.cache.remote import FREE_FOR, UploadSource
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.closing import close_refused, close_written
from mavftpfs.session.copies import Span, WriteLog
from mavftpfs.session.echoes import feared_for
from mavftpfs.session.kit import Kit, Queue
from mavftpfs.session.occupants import require_free
from mavftpfs.session.opening import TERMINATE_LIMIT, OpenSession
from mavftpfs.session.reopening import Reopening
from mavftpfs.session.turns import Turns
from mavftpfs.session.upload import Feed, QueuedUpload
from mavftpfs.session.vehicle import FOREIGN_MEMORY
from mavftpfs.session.writing import Stop, Writer, is_disarmed
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileChanged,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    ProtocolError,
    RequestTimeout,
    SessionLost,
    SpoolFailed,
)

REFUSALS = (FtpNak, ProtocolError, FileChanged, AlreadyExists, SpoolFailed)
"""Errors that do not pass by themselves."""

REOPENS = 5
"""How often the session may be lost without getting further in the file before the upload fails."""


class Uploading:
    """Queues uploads and serves one at a time.

    op_deadline: seconds to wait for the Terminate that ends a file.
    when_armed_ok: write in flight, too.
    """

    def __init__(
        self,
        kit: Kit,
        queue: Queue,
        *,
        op_deadline: float = 30.0,
        when_armed_ok: bool = False,
    ) -> None:
        self.uploads: list[QueuedUpload] = []
        self.writer = Writer(kit, queue, lambda: self.may_write)
        self._holder = kit.holder
        self._kit = kit
        self._queue = queue
        self._vehicle = kit.vehicle
        self._clock = kit.clock
        self._echoes = kit.echoes
        self._op_deadline = op_deadline
        self._when_armed_ok = when_armed_ok
        self._engine = kit.engine
        self._reopening = Reopening(kit, queue, self.writer)
        self.written = WriteLog(kit.engine.stats, lambda: kit.engine.traits, kit.clock, kit.write_chunks.most)
        self._written: QueuedUpload | None = None
        self._written_at = float("-inf")
        self._heir: QueuedUpload | None = None  # waits for what is left of that to be dead, and is next
        self._dead_at = float("-inf")

    @property
    def turns(self) -> Turns:
        """Where path operations and writes take turns."""
        return self.writer.turns

    # --- what others ask for and tell

    def add(self, path: bytes, source: UploadSource, *, create: bool, ticket: int) -> QueuedUpload:
        """Queue an upload."""
        feed = Feed(source, self._kit.write_chunks.most)
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
        self._vehicle.require_there(self._clock())

    def now(self) -> float:
        """See UploadHost."""
        return self._clock()

    def repeats(self) -> bool:
        """See UploadHost."""
        stats = self._engine.stats
        return stats.strays + stats.retransmissions > 0

    async def outlast_copies(self, created_at: float | None, *, repeated: bool) -> None:
        """See UploadHost. What is verified after that stays as it is."""
        if created_at is not None:
            rest = self._feared_until(created_at, repeated=repeated) - self._clock()
            if rest > 0.0:
                await trio.sleep(rest)

    def _feared_until(self, sent_at: float, *, repeated: bool = False) -> float:
        """Return until when a copy of a request may still come, if this link was seen to be of that kind, or
        we made one ourselves.

        A WriteFile names no file: a late one would be written to the next.
        """
        if not self._engine.stats.strays and not repeated:
            return sent_at
        return sent_at + feared_for(self._engine, self._clock())

    def heard_stranger(self, since: float) -> bool:
        """See UploadHost."""
        foreign = self._vehicle.foreign_at
        return foreign is not None and foreign > since - FOREIGN_MEMORY

    def on_news(self, upload: QueuedUpload) -> None:
        """See UploadHost."""
        self.writer.on_more(upload)
        self._holder.wake()

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
                upload.retry_at = now
        self._holder.wake()

    def on_reboot(self) -> None:
        """Perhaps it is another vehicle: what was proven of a new file is not there, whatever its size.

        What OpenFileWO does was forgotten: a file may tell it once more, or others wait for its end.
        """
        for upload in self.uploads:
            upload.anew, upload.tried = True, False
            upload.feed.forget_proof()
        self.written.forget()
        self.writer.on_reboot()

    # --- what the scheduler asks

    def due(self, now: float) -> list[QueuedUpload]:
        """Return the uploads for which there is something to do now."""
        if not self.may_write or now < self._held_until:
            return []
        lost = self._vehicle.lost(now)
        due = [upload for upload in self.uploads if upload.is_due(now) and (upload.finishing or not lost)]
        # Before the one it waited for, which may have more to send each time.
        return [u for u in due if u is self._heir and not self._holder.claimed(u.path)] or due

    def next_time(self, now: float) -> float:
        """When one becomes due that is not so now, infinite if none will by itself."""
        if not self.may_write:
            return float("inf")
        times = [max(upload.retry_at, self._held_until) for upload in self.uploads if upload.wanted]
        return min((time for time in times if time > now), default=float("inf"))

    def expire(self, oldest: float, error: MavftpfsError) -> None:
        """Tell those who have waited since before `oldest` for an upload that got no turn."""
        now = self._clock()
        for upload in self.uploads:
            if upload.finishing and not upload.running and upload.asked_at < oldest:
                upload.fail(error, now)

    async def serve(self, upload: QueuedUpload) -> bool:
        """Use the session for an upload. Its errors are told to the upload. False: it sent nothing, for who
        waited, or may have come while another file was closed for it, goes first."""
        started = self._clock()
        upload.running = served = True
        try:
            if not self._is_complete_already(upload):
                self.check_may_write()
                served = not self._lets_stragglers_pass(upload) and await self._serve(upload)
        except SessionLost as lost:
            self._on_lost(upload, lost)
        except MavftpfsError as error:
            await self._on_error(upload, error)
        finally:
            now = self._clock()
            upload.running = False
            if served:
                upload.asked_at = upload.waits_since = now
            else:
                upload.feed.put_back()
            upload.use.add(now - started, now)
            if not self.may_write and upload.finishing and upload.error is None:
                upload.fail(Armed("the vehicle was armed"), now)  # while its file was opened or closed
            upload.tell()
        return served

    async def _serve(self, upload: QueuedUpload) -> bool:
        """Open, write and close; return False if it was somebody else's turn before it could write.

        Opening takes up to four round trips, and who came meanwhile would wait for all of them.
        """
        if not self.writer.starves(upload) and await self._holder.made_room(upload.path):
            return False
        session = await self._open(upload)
        if session is not None:
            await self._write(upload, session)
        return session is not None

    async def _write(self, upload: QueuedUpload, session: OpenSession) -> None:
        try:
            upload.again = upload.again or self.written.lately(upload.path, upload.overwrites)
            made = upload.create and not upload.feed.proven
            self.written.begin(upload.path, session.seq, upload.feed.span, upload.overwrites, made=made)
            await self._let_go(upload, await self.writer.run(upload, session))
        finally:
            self.writer.end()
            self.written.end()
            self._written, self._written_at = upload, self._clock()

    def on_probed(self, session: OpenSession, size: int) -> None:
        """`size` bytes were written to a file that only shows what the server does."""
        self.written.begin(session.path, session.seq, Span(0, size), None, made=True)
        self._written, self._written_at = None, self._clock()

    def _lets_stragglers_pass(self, upload: QueuedUpload) -> bool:
        """Whether it is not its turn before what is left of the file before is dead; readers go on, but not
        the upload of that file, or there would be more of it each time."""
        until = self._feared_until(self._written_at)
        if until <= self._clock():
            self._heir = None
            return False
        if self._heir is None:
            if upload is self._written:
                return False
            self._heir = upload
        self._dead_at = until
        return True

    @property
    def _held_until(self) -> float:
        """When what is left is dead that the next upload waits for."""
        return float("-inf") if self._heir is None else self._dead_at

    def _is_complete_already(self, upload: QueuedUpload) -> bool:
        """Whether there is nothing to send; an empty file has to be created once."""
        feed = upload.feed
        upload.mark()
        if feed.has_more() or feed.unproven or (upload.finishing and not feed.proven):
            return False
        upload.complete(more=False)
        return True

    # --- opening

    async def _open(self, upload: QueuedUpload) -> OpenSession | None:
        """None: it gave way."""
        feed = upload.feed
        if not upload.create and not self.writer.resumable:
            raise LocalProtocolError("how the vehicle opens a file for writing is not known (any more)")
        if upload.anew and upload.create and (feed.proven or feed.unproven):
            feed.roll_back(everything=True)
        upload.anew = False
        if feed.proven and self.writer.may_try(upload):
            await self._reopening.find_out(upload)
        if self.writer.resumable and (feed.proven or not upload.create):
            return await self._reopening.reopen(upload, max(feed.reached, upload.least))
        if feed.proven or feed.unproven:
            feed.roll_back(everything=True)
        if upload.free_at is not None and self._clock() - upload.free_at > FREE_FOR:
            await require_free(self._holder, upload.path)
        if upload.aborted:  # its owner was told that nothing was begun
            raise LocalProtocolError("the upload was given up before its file was made")
        upload.free_at, upload.begun = None, True  # what is there from now on may be ours
        before, upload.created_twice = upload.created_twice, True  # for all that is known, if this fails
        try:
            session = await self._holder.open(upload.path, Opcode.CREATE_FILE)
        except FtpNak as nak:
            upload.created_twice = before or nak.retransmitted
            raise
        finally:
            upload.created_at = self._clock()
        upload.opened, upload.created_twice = True, before or session.repeated
        return session

    # --- letting go

    async def _let_go(self, upload: QueuedUpload, stop: Stop) -> None:
        feed = upload.feed
        if stop is Stop.ABORTED:
            await self._holder.close_quietly()
            return
        limit = TERMINATE_LIMIT if stop is Stop.ARMED else self._op_deadline
        try:
            ours = await close_written(self._kit, upload, limit)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        last = self.writer.end()
        upload.refused_behind = last is not None
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        feed.check_point()
        upload.left_at = self._clock()
        if isinstance(last, REFUSALS) and not is_disarmed(last):
            raise last
        if stop is Stop.ARMED:
            upload.fail(Armed("the vehicle was armed"), self._clock())
        elif stop in (Stop.FINISHED, Stop.STARVED):
            more = feed.has_more()
            upload.complete(more=more)
            if not upload.finishing and not self.writer.resumable and not self.writer.may_try(upload):
                upload.hold_restart(self._clock())

    def _roll_back(self, upload: QueuedUpload) -> None:
        keep = not upload.create or (self.writer.resumable and upload.feed.proven)
        if upload.feed.proven or upload.feed.unproven:
            upload.feed.roll_back(everything=not keep)
        else:
            upload.feed.put_back()

    def _on_lost(self, upload: QueuedUpload, lost: SessionLost) -> None:
        """Begin again from what is proven, a bounded number of times."""
        self._holder.abandon()
        if upload.aborted:
            return
        self._roll_back(upload)
        upload.usurped |= lost.by_server
        if lost.by_server:
            self._kit.doubt.raise_it(str(lost))
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
        refused = isinstance(error, REFUSALS)
        if isinstance(error, RequestTimeout):
            self._vehicle.note_timeout()
        if not refused or isinstance(error, RequestTimeout):
            self._holder.abandon()
            self._roll_back(upload)
        elif await close_refused(self._kit, upload):
            upload.feed.check_point()
        else:
            self._roll_back(upload)
        upload.fail(error, self._clock(), refused=refused)
