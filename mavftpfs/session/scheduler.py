"""Who may use the one server session, and when. Layer: session.

One task (`serve`) opens, reads, writes and closes; streams, uploads and jobs only say what they want and
wake it. Metadata requests do not need the session: they run beside it and carry its id (servers.md 1).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.remote import ReadSink, UploadSource
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import Operation
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.reading import ReadToEof
from mavftpfs.session.doubt import Doubt, touches_session
from mavftpfs.session.driver import Driver
from mavftpfs.session.fairness import ReadMode, Share
from mavftpfs.session.reader import FileStream, Reading
from mavftpfs.session.serversession import OpenSession, ServerSession, State
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.session.uploads import Uploading
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import DataUnproven, MavftpfsError, RequestTimeout, SessionLost
from mavftpfs.shared.traits import WriteTraits

IDLE_CLOSE = 1.5
"""Seconds a file stays open on the server without being read. Below the 2 s after which PX4 frees its
buffers and the 3 s after which ArduPilot gives the session away: so a session is never doubtful."""

RECENT = 10.0
"""Seconds for which what was read stays provisional, also of files that were closed since: another client is
noticed late, because servers answer it on its own link, and a router may pass on only some of that."""

_UNSURE_RETRY = 5.0
_OPENING = frozenset((Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE))


@dataclass(eq=False)
class _Job:
    """One open, an action, one Terminate."""

    path: bytes
    opcode: Opcode
    action: Callable[[OpenSession], Awaitable[None]]
    share: Share
    session: OpenSession | None = None
    error: MavftpfsError | None = None
    finished: trio.Event = field(default_factory=trio.Event)

    def fail(self, error: MavftpfsError) -> None:
        """End it before it began."""
        self.error = error
        self.finished.set()


_User = _Job | FileStream | QueuedUpload


async def _do_nothing(session: OpenSession) -> None:
    """The open and the Terminate are all."""


class Scheduler:
    """Serialises all use of the server session.

    op_deadline: seconds after which who waits for the session is told that it is not to be had.
    when_armed_ok: write in flight, too. chunk: bytes that a request carries, 1..239; None: see ChunkSize.

    Attributes:
        read_chunks, write_chunks: the size of requests.
    """

    def __init__(
        self,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        *,
        clock: Callable[[], float],
        op_deadline: float = 30.0,
        when_armed_ok: bool = False,
        read_mode: ReadMode = "window",
        chunk: int | None = None,
    ) -> None:
        self.doubt = Doubt(clock)
        self.server = ServerSession(driver, engine, vehicle, self.doubt, clock, op_deadline)
        self.write_traits = WriteTraits()
        self.op_deadline = op_deadline
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self.read_mode: ReadMode = read_mode
        self.read_chunks, self.write_chunks = ChunkSize(chunk), ChunkSize(chunk)
        self._clock = clock
        self._used_at = clock()
        self._touched_at = float("-inf")
        self._streams: dict[FileStream, None] = {}
        self._closed_streams: list[FileStream] = []
        self._jobs: list[_Job] = []
        parts = (self.server, driver, engine, self, self.doubt, clock)
        self._reading = Reading(*parts, read_mode, self.read_chunks)
        self._uploading = Uploading(*parts, vehicle, self.write_chunks, when_armed_ok=when_armed_ok)
        engine.on_stray = self._on_stray
        self.doubt.on_raised = self._on_doubt

    @property
    def session(self) -> OpenSession | None:
        """What is open on the server."""
        return self.server.session

    @property
    def uploads(self) -> list[QueuedUpload]:
        """The uploads that were neither completed nor aborted by their owners."""
        return list(self._uploading.uploads)

    # --- what others ask for

    async def metadata(self, operation: Operation, *, disturbs: bool = True) -> None:
        """Run an operation that needs no session of its own; `disturbs`: it carries a path to be looked up,
        which some servers take amiss while a file is written.

        Raises:
            VehicleLost, or what the operation fails with.
        """
        self.require_link()
        if not disturbs:
            await self.server.run(operation)
            return
        async with self._uploading.writer.path_gate.passing():
            await self.server.run(operation)

    def open_stream(self, path: bytes, sink: ReadSink, size: int | None) -> FileStream:
        """Register a reader; with size None it asks for an open ACK (await stream.wait_opened())."""
        stream = FileStream(path, sink, size, self._on_want)
        self._streams[stream] = None
        if stream.wants_open:
            self._on_want(stream)
        return stream

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
            await self.server.run(operation)
            self.server.require(session)
            if self.doubt.reads_arose_since(began):
                raise DataUnproven(f"another FTP client was active while {path!r} was read")
            data = operation.data

        try:
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        except (SessionLost, DataUnproven):
            await self.use_session(path, Opcode.OPEN_FILE_RO, read)
        return data

    async def use_session(
        self,
        path: bytes,
        opcode: Opcode,
        action: Callable[[OpenSession], Awaitable[None]] = _do_nothing,
    ) -> OpenSession:
        """Open a file, do something, terminate; returns what the open ACK said.

        Raises:
            VehicleLost, RequestTimeout, or what opening, the action or closing fail with.
        """
        self.require_link()
        job = _Job(path, opcode, action, Share(self._clock()))
        self._jobs.append(job)
        self.server.wake()
        try:
            await job.finished.wait()
        finally:
            if job in self._jobs:
                self._jobs.remove(job)
            self.server.wake()
        if job.error is not None:
            raise job.error
        assert job.session is not None
        return job.session

    def open_upload(self, path: bytes, source: UploadSource) -> QueuedUpload:
        """Queue an upload."""
        return self._uploading.add(path, source)

    def moved(self, old: bytes, new: bytes) -> None:
        """A file or directory was renamed: who reads or writes it, or in it, goes on under the new path."""
        prefix = old + b"/"
        users: list[FileStream | QueuedUpload] = [*self._streams, *self._uploading.uploads]
        for user in users:
            if user.path == old:
                user.path = new
            elif user.path.startswith(prefix):
                user.path = new + user.path[len(old) :]

    def gone(self, path: bytes) -> None:
        """The file of this name was removed or replaced: what its readers still want cannot be had."""
        for stream in list(self._streams):
            if stream.path == path:
                stream.orphan()

    def require_link(self) -> None:
        """Raise VehicleLost while the vehicle is silent (promise 4: fail at once)."""
        self._vehicle.require_there(self._clock())

    def check_may_write(self) -> None:
        """Raise Armed or VehicleLost (promises 4 and 9)."""
        self._uploading.check_may_write()

    # --- news

    def on_batch(self, now: float) -> None:
        """A batch of replies was processed: pass data on, once."""
        self._reading.on_batch(now)
        self._uploading.writer.on_batch()

    def on_foreign(self, payload: bytes, *, newcomer: bool) -> None:
        """Another FTP client's payload was heard. newcomer: the first for a while, so earlier ones may have
        been missed."""
        now = self._clock()
        if touches_session(payload, self.server.may_be_ours):
            self._touched_at = now
        # Whoever uses sessions may just have used ours, too, in a request that was not heard.
        reads = newcomer or now - self._touched_at <= RECENT
        self.doubt.raise_it("another FTP client is active", reads=reads)

    def _on_doubt(self, reason: str) -> None:
        """What was read lately is provisional, also of files closed since."""
        self._forget_closed()
        for stream in [*self._streams, *self._closed_streams]:
            if stream is self._reading.active or self._is_recent(stream):
                stream.on_suspect(reason)

    def _on_stray(self, reply: Payload, late: float) -> None:
        """An answer came that no request of ours explains. An older open that was carried out once more may
        have put its file in the place of ours (MAVSDK); all else is no other file's."""
        opens = reply.opcode == Opcode.ACK and reply.req_opcode in _OPENING
        other = opens and self.session is not None and self.session.seq != reply.seq
        self.doubt.note_late(late)
        self.doubt.raise_it("an answer came that no request of ours explains", reads=other)
        if other:
            self._end_session()

    def _end_session(self) -> None:
        """What is open over there may be another file than we think, or nothing."""
        self._reading.cut_off()
        self._uploading.writer.cut_off()
        self.server.abandon()

    def on_reboot(self) -> None:
        """The vehicle restarted, perhaps as another one: nothing is open, nothing is known of it."""
        self.doubt.raise_it("the vehicle restarted")
        self.write_traits = WriteTraits()
        self._end_session()
        self.server.forget_server()
        self._uploading.on_reboot()

    def armed_changed(self, armed: bool) -> None:
        """On arming uploads are terminated and held; on disarming they go on (promise 9)."""
        self._uploading.on_armed()

    def on_link_back(self) -> None:
        """Heartbeats are heard again."""
        self.server.wake()

    # --- the one task

    async def serve(self) -> None:
        """Run until cancelled."""
        while True:
            await trio.lowlevel.checkpoint()
            await self.server.honour_claims()
            user, began = self._next(), self._clock()
            try:
                if user is None:
                    await self._idle()
                    continue
                if isinstance(user, _Job):
                    await self._serve_job(user)
                elif isinstance(user, QueuedUpload):
                    await self._uploading.serve(user)
                elif await self._reading.serve(user):
                    user.share.asked_at = self._clock() if user.has_demand else None
            except MavftpfsError:
                # Closing the previous file failed; whoever wants something is asked again by _next.
                self.server.abandon()
            self._used_at = self._clock()
            if self._driver.last_reply_at >= began:
                self._tell_queue(user)

    def _tell_queue(self, served: _User | None) -> None:
        """Somebody had a turn in which the vehicle answered: who waits for the next ones is not timed out."""
        for stream in self._streams:
            if stream is not served and stream.has_demand:
                stream.on_queued()

    async def close(self) -> None:
        """Terminate the session, best effort; the caller bounds the wait and cancels `serve` first."""
        await self.server.close_quietly()
        await self.server.close_unsure()

    def _on_want(self, stream: FileStream) -> None:
        if stream.closed:
            self._on_closed(stream)
        elif stream.has_demand:
            stream.share.ask(self._clock())
        self.server.wake()

    def _on_closed(self, stream: FileStream) -> None:
        if stream in self._streams:
            del self._streams[stream]
            self._closed_streams.append(stream)
            self._forget_closed()

    def _forget_closed(self) -> None:
        self._closed_streams = [stream for stream in self._closed_streams if self._is_recent(stream)]

    def _is_recent(self, stream: FileStream) -> bool:
        return stream.last_data_at is not None and stream.last_data_at > self._clock() - RECENT

    def _waiting(self, now: float) -> list[_User]:
        """All who want the session and could use it now."""
        users: list[_User] = [*self._jobs, *(stream for stream in self._streams if stream.has_demand)]
        users += self._uploading.due(now)
        return [user for user in users if not self.server.claimed(user.path)]

    def _next(self) -> _User | None:
        """Whoever is to use the session now; readahead only if nobody waits for anything."""
        now, rtt = self._clock(), self._engine.rtt
        waiting = self._waiting(now)
        if waiting:
            return min(waiting, key=lambda user: user.share.rank(now, rtt))
        ahead = [
            stream for stream in self._streams if stream.has_ahead and not self.server.claimed(stream.path)
        ]
        return min(ahead, key=lambda stream: not self._is_open(stream), default=None)

    def _is_open(self, stream: FileStream) -> bool:
        session = self.session
        return session is not None and session.path == stream.path and not session.writing

    def rival_use(self, user: object) -> float | None:
        """Return how much the lightest of the others who wait used lately; None if nobody waits."""
        now = self._clock()
        return min((other.share.used(now) for other in self._waiting(now) if other is not user), default=None)

    def expire_waiters(self) -> None:
        """Somebody holds the session and cannot be interrupted: do not let others wait for ever."""
        now = self._clock()
        error = RequestTimeout("the vehicle's only session is taken by an upload that cannot be interrupted")
        for user in self._waiting(now):
            asked_at = user.share.asked_at
            if asked_at is None or asked_at >= now - self.op_deadline:
                continue
            if isinstance(user, QueuedUpload):
                self._uploading.expire(user, error)
                continue
            user.share.asked_at = None  # who asks again waits anew
            user.fail(error)
            if isinstance(user, _Job):
                self._jobs.remove(user)

    async def _idle(self) -> None:
        now = self._clock()
        until_upload = max(0.0, self._uploading.next_time(now) - now)
        if self.session is not None:
            # Counted from the last use, not from the last news: there may always be news.
            left = max(0.0, self._used_at + IDLE_CLOSE - now)
            if not await self.server.sleep(min(left, until_upload)) and self._next() is None:
                await self.server.close()
        elif self.server.state is State.UNSURE and not self._vehicle.lost(now):
            # An open or a Terminate that was never answered: leave no orphan over there.
            if not await self.server.sleep(min(_UNSURE_RETRY, until_upload)):
                await self.server.close_unsure()
        else:
            await self.server.sleep(until_upload)

    async def _serve_job(self, job: _Job) -> None:
        self._jobs.remove(job)
        try:
            self.require_link()  # it may have died while others had the session
            job.session = await self.server.open(job.path, job.opcode)
            await job.action(job.session)
            await self.server.close()
        except MavftpfsError as error:
            job.error = error
            await self.server.close_quietly()
        finally:
            job.finished.set()
