"""Who may use the one server session, and when. Layer: session.

One task (`serve`) opens, reads and closes; streams and whole reads only say what they want and wake it.
Metadata requests do not need the session: they run beside it and carry its id (servers.md 1, ArduPilot).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import Operation
from mavftpfs.protocol.transfers import ReadToEof, ReadTransfer
from mavftpfs.session.driver import Driver
from mavftpfs.session.gate import Gate
from mavftpfs.session.opening import OpenSession, SessionOpener
from mavftpfs.session.policy import LIGHT_USE, should_switch
from mavftpfs.session.readmode import ReadSteering
from mavftpfs.session.stream import FileStream
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FileChanged, MavftpfsError, SessionLost, VehicleLost

IDLE_CLOSE = 1.5
"""Seconds a file stays open on the server without being read. Below the 2 s after which PX4 frees its
buffers and the 3 s after which ArduPilot gives the session away: so a session is never doubtful."""

STALL = 2.0
"""Seconds without any reply during a read after which the server's session is no longer believed in."""

FIRST_WANT = 0.05
"""Seconds an opened file is kept open for its first read although another file waits."""

REOPENS = 5
"""How often one want may lose its session without a byte of progress before it fails."""


@dataclass(eq=False)
class WholeRead:
    """An `@` file to be read to its end in one go."""

    path: bytes
    limit: int
    ticket: int
    finished: trio.Event = field(default_factory=trio.Event)
    data: bytes = b""
    error: MavftpfsError | None = None
    cancelled: bool = False


class Scheduler:
    """Serialises all use of the server session."""

    def __init__(
        self,
        driver: Driver,
        engine: Engine,
        vehicle: Vehicle,
        steering: ReadSteering,
        *,
        clock: Callable[[], float],
    ) -> None:
        self.gate = Gate()
        self.opener = SessionOpener(driver, engine, vehicle, self.gate, clock)
        self.session: OpenSession | None = None
        self.switches = 0
        self._driver = driver
        self._engine = engine
        self._vehicle = vehicle
        self._steering = steering
        self._clock = clock
        self._wake = trio.Event()
        self._tickets = count(1)
        self._streams: set[FileStream] = set()
        self._wholes: list[WholeRead] = []
        self._active: FileStream | None = None
        self._transfer: ReadTransfer | None = None
        self._seen_bytes = 0
        self._closing = False

    # --- what others ask for

    async def metadata(self, operation: Operation) -> None:
        """Run an operation that needs no session of its own.

        Raises:
            VehicleLost, or what the operation fails with.
        """
        self.require_link()
        async with self.gate.passing():
            await self._driver.run(operation)

    def open_stream(self, path: bytes, sink: ReadSink, size: int | None) -> FileStream:
        """Register a reader; with size None it asks for an open ACK (await stream.wait_opened())."""
        stream = FileStream(path, sink, size, self._on_want)
        self._streams.add(stream)
        if stream.wants_open:
            self._on_want(stream)
        return stream

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read a file to EOF whatever its size claims."""
        self.require_link()
        job = WholeRead(path, limit, next(self._tickets))
        self._wholes.append(job)
        self._wake.set()
        try:
            await job.finished.wait()
        finally:
            job.cancelled = True
            if job in self._wholes:
                self._wholes.remove(job)
            self._wake.set()
        if job.error is not None:
            raise job.error
        return job.data

    def require_link(self) -> None:
        """Raise VehicleLost while the vehicle is silent (promise 4: fail at once)."""
        if self._vehicle.lost(self._clock()):
            raise VehicleLost("the vehicle is silent; waiting for its heartbeat")

    # --- news

    def on_batch(self, now: float) -> None:
        """A batch of replies was processed: pass data on, once."""
        transfer, stream = self._transfer, self._active
        if transfer is None or stream is None:
            return
        if transfer.received_bytes != self._seen_bytes:
            self._seen_bytes = transfer.received_bytes
            stream.last_data_at = now
            stream.clean_failures = 0
            stream.sink.on_batch()
        if transfer.idle or transfer.done:
            self._wake.set()

    def on_suspect(self, reason: str, within: float = 10.0) -> None:
        """Another FTP client was heard: what was read lately is provisional."""
        now = self._clock()
        for stream in self._streams:
            if stream is self._active or (stream.last_data_at or -1e9) > now - within:
                stream.sink.on_suspect(reason)

    def on_reboot(self) -> None:
        """The vehicle restarted: nothing is open any more."""
        self.session = None
        self.opener.forget()
        if self._transfer is not None:
            self._driver.cancel(self._transfer)
        self._wake.set()

    def _on_news(self) -> None:
        self._wake.set()

    # --- the one task

    async def serve(self) -> None:
        """Run until cancelled."""
        while True:
            await trio.lowlevel.checkpoint()
            job = self._next()
            try:
                if job is None:
                    await self._idle()
                elif isinstance(job, WholeRead):
                    await self._serve_whole(job)
                else:
                    await self._serve_stream(job)
            except MavftpfsError:
                # Closing the previous file failed; whoever wants something is asked again by _next.
                self.session = None

    async def close(self) -> None:
        """Terminate the session, best effort; the caller bounds the wait and cancels `serve` first."""
        if self.session is not None:
            await self._close_session()
        else:
            await self.opener.close_doubtful()

    def _on_want(self, stream: FileStream) -> None:
        if stream.closed:
            self._streams.discard(stream)
        elif stream.ticket is None and stream.has_demand:
            stream.ticket = next(self._tickets)
        self._wake.set()

    def _next(self) -> WholeRead | FileStream | None:
        """Demand before readahead, who used little lately before who used much, then who asked first."""
        now = self._clock()
        demands: list[tuple[bool, int, WholeRead | FileStream]] = [
            (False, job.ticket, job) for job in self._wholes
        ]
        readahead: FileStream | None = None
        for stream in self._streams:
            if stream.has_demand:
                demands.append((stream.use.recent(now) >= LIGHT_USE, stream.ticket or 0, stream))
            elif stream.has_ahead and (readahead is None or self._is_open(stream)):
                readahead = stream
        if demands:
            return min(demands, key=lambda item: item[:2])[2]
        return readahead

    def _is_open(self, stream: FileStream) -> bool:
        return self.session is not None and self.session.path == stream.path

    async def _idle(self) -> None:
        if self.session is None:
            await self._sleep(float("inf"))
        elif not await self._sleep(IDLE_CLOSE) and self._next() is None:
            await self._close_session()

    async def _sleep(self, seconds: float) -> bool:
        """Wait for news; return False if there was none."""
        with trio.move_on_after(seconds):
            await self._wake.wait()
            self._wake = trio.Event()
            return True
        return False

    async def _close_session(self) -> None:
        session, self.session = self.session, None
        if session is not None:
            await self.opener.close(session)

    # --- whole reads

    async def _serve_whole(self, job: WholeRead) -> None:
        self._wholes.remove(job)
        try:
            await self._close_session()
            self.session = await self.opener.open(job.path)
            read = ReadToEof(self.session.id, self._steering.chunk, job.limit)
            async with self.gate.passing():
                await self._driver.run(read)
            job.data = read.data
            await self._close_session()
        except MavftpfsError as error:
            job.error = error
            if self.session is not None:
                await self._close_quietly()
        finally:
            job.finished.set()

    async def _close_quietly(self) -> None:
        """Close after a failure that is already being reported."""
        try:
            await self._close_session()
        except MavftpfsError:
            self.session = None

    # --- streams

    async def _serve_stream(self, stream: FileStream) -> None:
        try:
            self.require_link()
            if await self._ensure_open(stream):
                await self._await_first_want(stream)
            if stream.has_demand or stream.has_ahead:
                async with self.gate.passing():
                    await self._read(stream)
        except SessionLost as error:
            await self._on_session_lost(stream, error)
        except MavftpfsError as error:
            stream.fail(error)
        stream.ticket = next(self._tickets) if stream.has_demand else None

    async def _ensure_open(self, stream: FileStream) -> bool:
        """Have the stream's file open; return whether its opener was waiting for that."""
        session = self.session
        awaited = stream.wants_open
        if session is None or session.path != stream.path or awaited:
            if session is not None:
                await self._close_session()
                self.switches += 1
            session = self.session = await self.opener.open(stream.path)
        if session.size is not None:
            try:
                stream.on_opened(session.size)
            except FileChanged:
                await self._close_quietly()
                raise
        return awaited

    async def _await_first_want(self, stream: FileStream) -> None:
        """Give whoever opened a file a moment to ask for its bytes, before another file takes its turn."""
        with trio.move_on_after(FIRST_WANT):
            while not (stream.has_demand or stream.has_ahead or stream.closed):
                await self._sleep(FIRST_WANT)

    async def _read(self, stream: FileStream) -> None:
        session = self.session
        assert session is not None
        transfer = ReadTransfer(session.id, stream.size, stream.sink, self._steering.chunk)
        started = self._clock()
        self._active, self._transfer, self._seen_bytes = stream, transfer, 0
        stream.attach(transfer)
        self._driver.start(transfer, self._on_news)
        try:
            while self._go_on(stream, transfer, started):
                self._steering.steer(
                    transfer, stream.contiguous_want(), others_waiting=self._rival(stream) is not None
                )
                await self._sleep(self._patience())
                if self._stalled(transfer):
                    raise SessionLost("no answer for a while during a read", by_server=False)
        finally:
            self._active = self._transfer = None
            if transfer.idle:
                stream.on_idle()
            stream.detach()
            self._driver.cancel(transfer)
            self._steering.learn(transfer)
            now = self._clock()
            stream.use.add(now - started, now)
        if transfer.error is not None:
            raise transfer.error

    def _go_on(self, stream: FileStream, transfer: ReadTransfer, started: float) -> bool:
        if transfer.done or transfer.idle or stream.closed or self.session is None:
            return False
        rival = self._rival(stream)
        if rival is None:
            return True
        now = self._clock()
        return not should_switch(
            current_has_demand=stream.has_demand,
            current_slice=now - started,
            current_use=stream.use.recent(now),
            waiting_use=rival.use.recent(now) if isinstance(rival, FileStream) else 0.0,
            rtt=self._engine.rtt,
        )

    def _rival(self, stream: FileStream) -> WholeRead | FileStream | None:
        """Return somebody else who waits with demand, the lightest user first."""
        if self._wholes:
            return self._wholes[0]
        now = self._clock()
        rivals = [other for other in self._streams if other is not stream and other.has_demand]
        return min(rivals, key=lambda other: other.use.recent(now), default=None)

    def _patience(self) -> float:
        return 0.25 if len(self._streams) > 1 or self._wholes else STALL / 2

    def _stalled(self, transfer: ReadTransfer) -> bool:
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        quiet_since = max(self._driver.last_reply_at, transfer.started_at)
        return not transfer.idle and self._clock() - quiet_since > limit

    async def _on_session_lost(self, stream: FileStream, error: SessionLost) -> None:
        """Reopen and go on at the same offset (promise 5); what the lost session read is provisional."""
        session, self.session = self.session, None
        if session is not None:
            self.opener.abandon(session)
        if error.by_server:
            stream.sink.on_suspect(str(error))
        stream.clean_failures += 1
        if stream.clean_failures > REOPENS:
            stream.fail(error)
