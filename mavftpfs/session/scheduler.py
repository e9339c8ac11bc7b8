"""Gives the one server session to one user after another. Layer: session.

One task (`serve`) opens, reads, writes and closes; streams, uploads and single requests only say what they
want and wake it. Metadata requests do not need the session: they run beside it and carry its id (servers.md
1).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from math import inf

import trio

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import Operation
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.reading import ReadToEof
from mavftpfs.session.doubt import Doubt, session_used_by
from mavftpfs.session.driver import Driver
from mavftpfs.session.queue import Queue, SessionUser
from mavftpfs.session.reader import RECENT, FileStream, Reading, ReadMode
from mavftpfs.session.serversession import OpenSession, ServerSession, State
from mavftpfs.session.upload import Upload
from mavftpfs.session.uploading import Uploading
from mavftpfs.shared.errors import DataUnproven, MavftpfsError, SessionLost
from mavftpfs.shared.traits import WriteTraits

IDLE_CLOSE = 1.5
"""Seconds a file stays open on the server without being read. Below the 2 s after which PX4 frees its
buffers and the 3 s after which ArduPilot gives the session away: so a session is never doubtful."""

_MAYBE_OPEN_RETRY = 5.0
_OPENING = frozenset((Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE))

Action = Callable[[OpenSession], Awaitable[None]]


class _Job(SessionUser):
    """One open, an action, one Terminate."""

    def __init__(self, path: bytes, opcode: Opcode, action: Action | None, now: float) -> None:
        super().__init__(path, now)
        self.opcode = opcode
        self.action = action
        self.session: OpenSession | None = None
        self.error: MavftpfsError | None = None
        self.finished = trio.Event()

    def due_at(self) -> float:
        """See SessionUser."""
        return inf if self.finished.is_set() else 0.0

    def fail(self, error: MavftpfsError) -> None:
        """See SessionUser."""
        self.error = error
        self.finished.set()


class Scheduler:
    """Serialises all use of the server session.

    op_deadline: seconds after which who waits for the session is told that it is not to be had.
    chunk: bytes that a request carries, 1..239; None: see ChunkSize.

    Attributes:
        traits: what the server was seen to do when written to; forgotten when it restarts.
        read_chunks, write_chunks: the size of requests.
    """

    def __init__(
        self,
        driver: Driver,
        *,
        clock: Callable[[], float],
        op_deadline: float = 30.0,
        read_mode: ReadMode = "window",
        chunk: int | None = None,
    ) -> None:
        self.traits = WriteTraits()
        self.read_mode: ReadMode = read_mode
        self.read_chunks, self.write_chunks = ChunkSize(chunk), ChunkSize(chunk)
        self.op_deadline = op_deadline
        self.doubt = Doubt(clock)
        self.server = ServerSession(driver, self.doubt, clock, op_deadline)
        self.queue = Queue(self.server, driver.engine, clock, op_deadline)
        parts = (self.server, driver, self.queue, self.doubt)
        self.reading = Reading(*parts, read_mode, self.read_chunks, clock)
        self.uploading = Uploading(*parts, self.traits, self.write_chunks, clock)
        self._driver = driver
        self._vehicle = driver.vehicle
        self._clock = clock
        self._used_at = clock()
        self._touched_at = -inf
        driver.engine.on_unexplained = self._on_unexplained
        self.doubt.on_raised = self.reading.on_doubt

    def uploads(self) -> list[Upload]:
        """Return those that were neither completed nor given up by their owners."""
        return [user for user in self.queue.users if isinstance(user, Upload)]

    # --- what others ask for

    async def metadata(self, operation: Operation) -> None:
        """Run an operation that needs no session of its own, and carries a path to be looked up: some servers
        take that amiss while a file is written.

        Raises:
            VehicleLost, or what the operation fails with.
        """
        self._vehicle.require_there(self._clock())
        async with self.uploading.path_gate.passing():
            await self._driver.run(operation)

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read a file to EOF whatever its size claims; once more if the session was lost or in doubt.

        Raises:
            DataUnproven: another FTP client may have used the session each time, so that the bytes may be
                another file's. Else as use_session.
        """
        data = b""

        async def read(session: OpenSession) -> None:
            nonlocal data
            began = self._clock()
            operation = ReadToEof(session.id, self.read_chunks.size, limit)
            await self._driver.run(operation)
            self.server.require(session)
            if self.doubt.reads_arose_since(began):
                raise DataUnproven(f"another FTP client was active while {path!r} was read")
            data = operation.data

        try:
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        except (SessionLost, DataUnproven):
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        return data

    async def use_session(self, path: bytes, opcode: Opcode, action: Action | None = None) -> OpenSession:
        """Open a file, do something, terminate; returns what the open ACK said.

        Raises:
            VehicleLost, RequestTimeout, or what opening, the action or closing fail with.
        """
        now = self._clock()
        self._vehicle.require_there(now)
        job = _Job(path, opcode, action, now)
        self.queue.add(job)
        try:
            await job.finished.wait()
        finally:
            self.queue.remove(job)
        if job.error is not None:
            raise job.error
        assert job.session is not None
        return job.session

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """A file or directory was renamed: who reads or writes it, or in it, goes on under the new path. What
        had the new name cannot be read any more."""
        self.on_removed(new)
        prefix = old + b"/"
        for user in self.queue.users:
            if isinstance(user, _Job):
                continue
            if user.path == old:
                user.path = new
            elif user.path.startswith(prefix):
                user.path = new + user.path[len(old) :]

    def on_removed(self, path: bytes) -> None:
        """The file of this name was removed or replaced: what its readers still want cannot be had."""
        for user in list(self.queue.users):  # who is told may close it
            if user.path == path and isinstance(user, FileStream):
                user.on_removed()

    # --- news

    def on_foreign(self, payload: bytes, *, newcomer: bool) -> None:
        """Another FTP client's payload was heard. newcomer: the first for a while, so earlier ones may have
        been missed."""
        now, session = self._clock(), session_used_by(payload)
        if session is not None and self.server.may_be_ours(session):
            self._touched_at = now
        # Whoever uses sessions may just have used ours, too, in a request that was not heard.
        reads = newcomer or now - self._touched_at <= RECENT
        self.doubt.raise_it("another FTP client is active", reads=reads)

    def _on_unexplained(self, reply: Payload, late: float) -> None:
        """An answer came that no request of ours explains. An older open that was carried out once more may
        have put its file in the place of ours (MAVSDK); all else is no other file's."""
        session = self.server.session
        opens = reply.opcode == Opcode.ACK and reply.req_opcode in _OPENING
        other = opens and session is not None and session.seq != reply.seq
        self.doubt.note_late(late)
        self.doubt.raise_it("an answer came that no request of ours explains", reads=other)
        if other:
            self._end_session()

    def _end_session(self) -> None:
        """What is open over there may be another file than we think, or nothing."""
        self.reading.cut_off()
        self.uploading.cut_off()
        self.server.abandon()

    def on_reboot(self) -> None:
        """The vehicle restarted, perhaps as another one: nothing is open, nothing is known of it."""
        self.doubt.raise_it("the vehicle restarted")
        self.traits.forget()
        self._end_session()

    def on_armed_changed(self) -> None:
        """On arming uploads are terminated and held; on disarming they go on (promise 9)."""
        for upload in self.uploads():
            upload.on_armed_changed()
        self.server.wake()

    # --- the one task

    async def serve(self) -> None:
        """Run until cancelled."""
        while True:
            await trio.lowlevel.checkpoint()
            await self.server.close_excluded()
            user, began = self.queue.first(), self._clock()
            try:
                if user is None:
                    await self._idle()
                    continue
                session = self.server.session
                if session is not None and session.path != user.path and not session.writing:
                    await self.server.close_quietly()
                    continue  # somebody may have come meanwhile who goes first
                if isinstance(user, _Job):
                    await self._serve_job(user)
                elif isinstance(user, Upload):
                    await self.uploading.serve(user)
                elif isinstance(user, FileStream):
                    await self.reading.serve(user)
            except MavftpfsError:
                # Closing the previous file failed; whoever wants something is asked again by the queue.
                self.server.abandon()
            self._used_at = self._clock()
            if self._driver.last_reply_at >= began:
                # The vehicle answered in this turn: who waits for a later one is not timed out.
                for other in list(self.queue.users):
                    if other is not user and isinstance(other, FileStream) and other.due_at() < inf:
                        other.sink.on_queued()

    async def _idle(self) -> None:
        now = self._clock()
        until_due = self.queue.next_due(now) - now
        if self.server.session is not None:
            # Counted from the last use, not from the last news: there may always be news.
            left = max(0.0, self._used_at + IDLE_CLOSE - now)
            if not await self.server.sleep(min(left, until_due)) and self.queue.first() is None:
                await self.server.close()
        elif self.server.state is State.MAYBE_OPEN and not self._vehicle.lost(now):
            # An open or a Terminate that was never answered: leave no orphan over there.
            if not await self.server.sleep(min(_MAYBE_OPEN_RETRY, until_due)):
                await self.server.close_maybe_open()
        else:
            await self.server.sleep(until_due)

    async def _serve_job(self, job: _Job) -> None:
        try:
            self._vehicle.require_there(self._clock())  # it may have died while others had the session
            job.session = await self.server.open(job.path, job.opcode)
            if job.action is not None:
                await job.action(job.session)
            await self.server.close()
        except MavftpfsError as error:
            job.error = error
            await self.server.close_quietly()
        finally:
            job.finished.set()

    async def close(self) -> None:
        """Terminate the session, best effort: a server forgets it by itself, sooner or later. The caller
        bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_maybe_open()
