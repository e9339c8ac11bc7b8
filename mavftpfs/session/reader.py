"""Files that are read: what is wanted of each, and how the session serves one at a time. Layer: session.

A FileStream is the Reader that the caches hold. It outlives the server's session on its file: wants that are
not yet fulfilled are kept here and handed to whatever transfer is attached next.
"""

from __future__ import annotations

from collections.abc import Callable

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.fairness import Queue, ReadMode, Share
from mavftpfs.session.serversession import ServerSession
from mavftpfs.shared.errors import FileChanged, MavftpfsError, RemoteProtocolError, SessionLost
from mavftpfs.shared.extents import ExtentSet

STALL = 2.0
"""Seconds without any reply during a read after which the server's session is no longer believed in."""

FIRST_WANT = 0.05
"""Seconds an opened file is kept open for its first read although another file waits."""

REOPENS = 5
"""How often one want may lose its session without a byte of progress before it fails."""

_OFTEN = 0.25


class FileStream:
    """Implements cache.remote.Reader. The scheduler attaches and detaches transfers."""

    def __init__(
        self, path: bytes, sink: ReadSink, size: int | None, wake: Callable[[FileStream], None]
    ) -> None:
        self.path = path
        self._sink = sink
        self.closed = False
        self.share = Share()
        self.wants_open = size is None
        self.last_data_at: float | None = None
        self.clean_failures = 0
        self._size = size
        self._demand = ExtentSet()
        self._ahead = ExtentSet()
        self._wake = wake
        self._opened = trio.Event()
        self._open_error: MavftpfsError | None = None
        self._orphaned = False
        self._transfer: ReadTransfer | None = None

    # --- the cache's side

    @property
    def size(self) -> int:
        """Size by the first open ACK, in bytes."""
        return self._size or 0

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        """Ask for bytes of [start, stop), clamped to the size."""
        stop = min(stop, self.size)
        if start >= stop or self.closed:
            return
        if self._orphaned:
            self._sink.on_failed(self._gone())
            return
        wanted = self._demand if demand else self._ahead
        for gap_start, gap_stop in self._sink.missing(start, stop):
            wanted.add(gap_start, gap_stop)
        if self._transfer is not None:
            self._transfer.want(start, stop, demand)
        self._wake(self)

    def drop_readahead(self) -> None:
        """Forget what nobody waits for."""
        self._ahead.clear()
        if self._transfer is not None:
            self._transfer.drop_readahead()

    def close(self) -> None:
        """No more wants; what is still wanted is forgotten."""
        self.closed = True
        self._demand.clear()
        self._ahead.clear()
        self.wants_open = False
        self._wake(self)

    # --- the scheduler's side

    @property
    def has_demand(self) -> bool:
        """Whether somebody waits for this file."""
        if self.closed:
            return False
        return self.wants_open or not self._demand.empty

    @property
    def has_ahead(self) -> bool:
        """Whether readahead is wanted."""
        return not self.closed and not self._ahead.empty

    async def wait_opened(self) -> None:
        """Wait for the first open's outcome; raise its error."""
        if self._size is None:
            await self._opened.wait()
        if self._open_error is not None:
            raise self._open_error

    def on_opened(self, size: int) -> None:
        """Take the size of an open ACK.

        Raises:
            FileChanged: the file is smaller than what was opened. A larger one only grew: it is served at
                its opened size.
        """
        self.wants_open = False
        if self._size is None:
            self._size = size
            self._opened.set()
        elif size < self._size:
            raise FileChanged(f"{self.path!r} shrank from {self._size} to {size} bytes")

    def on_session(self, opened_at: float) -> None:
        """Bytes come from a session that was opened at that time."""
        if not self.closed:
            self._sink.on_opened(opened_at)

    def attach(self, transfer: ReadTransfer) -> None:
        """Hand what is wanted to a transfer; later wants go to it directly."""
        self._transfer = transfer
        for start, stop in self._demand:
            transfer.want(start, stop, True)
        for start, stop in self._ahead:
            transfer.want(start, stop, False)

    # Being the transfer's sink, the stream keeps what is on its way when it is closed from its own sink.

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) that the cache does not hold."""
        return self._sink.missing(start, stop)

    def on_data(self, offset: int, data: bytes) -> None:
        """Pass bytes on."""
        if not self.closed:
            self._sink.on_data(offset, data)

    def on_batch(self) -> None:
        """A batch of data ended. What came is wanted no more, even if the cache soon drops it again."""
        if not self.closed:
            self._demand = self._unmet(self._demand)
            self._ahead = self._unmet(self._ahead)
            self._sink.on_batch()

    def on_queued(self) -> None:
        """It waits for its turn, and the queue before it moved: the vehicle is not silent."""
        if not self.closed:
            self._sink.on_queued()

    def on_suspect(self, reason: str) -> None:
        """What was read lately is provisional, even if it was closed since."""
        self._sink.on_suspect(reason)

    def detach(self) -> None:
        """Take back what the transfer did not deliver."""
        self._transfer = None

    def on_idle(self) -> None:
        """Everything wanted has come."""
        self._demand.clear()
        self._ahead.clear()

    def fail(self, error: MavftpfsError) -> None:
        """What is wanted cannot be had now; whoever waits gets the error."""
        self.wants_open = False
        self._demand.clear()
        self._ahead.clear()
        if self._size is None:
            self._open_error = error
            self._opened.set()
        else:
            self._sink.on_failed(error)

    def orphan(self) -> None:
        """The file is gone from its path: nothing more of it can be had, and of its successor nothing may."""
        self._orphaned = True
        if self.has_demand:
            self.fail(self._gone())

    def _gone(self) -> FileChanged:
        return FileChanged(f"{self.path!r} was removed or replaced")

    def _unmet(self, wanted: ExtentSet) -> ExtentSet:
        unmet = ExtentSet()
        for start, stop in wanted:
            for gap_start, gap_stop in self._sink.missing(start, stop):
                unmet.add(gap_start, gap_stop)
        return unmet


class Reading:
    """Runs read transfers. mode: by which requests. chunks: their size."""

    def __init__(
        self,
        server: ServerSession,
        driver: Driver,
        engine: Engine,
        queue: Queue,
        doubt: Doubt,
        clock: Callable[[], float],
        mode: ReadMode,
        chunks: ChunkSize,
    ) -> None:
        self.active: FileStream | None = None
        self._server = server
        self._driver = driver
        self._engine = engine
        self._queue = queue
        self._doubt = doubt
        self._mode: ReadMode = mode
        self._chunks = chunks
        self._clock = clock
        self._transfer: ReadTransfer | None = None
        self._seen_bytes = 0

    def on_batch(self, now: float) -> None:
        """A batch of replies was processed: pass data on, once."""
        transfer, stream = self._transfer, self.active
        if transfer is None or stream is None:
            return
        if transfer.received_bytes != self._seen_bytes:
            self._seen_bytes = transfer.received_bytes
            stream.last_data_at = now
            stream.clean_failures = 0
            stream.on_batch()
        if transfer.idle or transfer.done:
            self._server.wake()

    def cut_off(self) -> None:
        """Whatever is under way gets no more answers, or none to be believed."""
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    async def serve(self, stream: FileStream) -> bool:
        """Read for a stream. Its errors are told to the stream. False: only another file was closed for it,
        and who came meanwhile may be next."""
        try:
            self._queue.require_link()
            if await self._server.made_room(stream.path):
                return False
            if await self._ensure_open(stream):
                await self._await_first_want(stream)
            if stream.has_demand or stream.has_ahead:
                async with self._server.traffic():
                    await self._read(stream)
        except SessionLost as error:
            self._on_session_lost(stream, error)
        except MavftpfsError as error:
            stream.fail(error)
        return True

    async def _ensure_open(self, stream: FileStream) -> bool:
        """Have the stream's file open; return whether its opener was waiting for that."""
        session = self._server.session
        awaited = stream.wants_open
        if session is None or session.path != stream.path or session.writing or awaited:
            session = await self._server.open(stream.path)
        try:
            if session.size is None:
                raise RemoteProtocolError("the vehicle's open reply holds no size")
            stream.on_opened(session.size)
            stream.on_session(session.opened_at)
        except (FileChanged, RemoteProtocolError):
            await self._server.close_quietly()
            raise
        return awaited

    async def _await_first_want(self, stream: FileStream) -> None:
        """Give whoever opened a file a moment to ask for its bytes, before another file takes its turn."""
        with trio.move_on_after(FIRST_WANT):
            while not (stream.has_demand or stream.has_ahead or stream.closed):
                await self._server.sleep(FIRST_WANT)

    async def _read(self, stream: FileStream) -> None:
        session = self._server.session
        if session is None:  # the vehicle restarted since it was opened
            return
        kind = BurstTransfer if self._mode == "burst" else ReadTransfer
        transfer = kind(session.id, stream.size, stream, self._chunks)
        started = self._clock()
        self.active, self._transfer, self._seen_bytes = stream, transfer, 0
        stream.attach(transfer)
        self._give_way(transfer)
        self._driver.start(transfer, self._server.wake)
        try:
            while self._go_on(stream, transfer, started):
                others = self._queue.rival_use(stream) is not None
                self._give_way(transfer)
                # What woke us may be a new want, and with nothing in flight no answer would send for it.
                self._driver.kick()
                await self._server.sleep(_OFTEN if others else STALL / 2)
                if self._stalled(transfer):
                    raise SessionLost("no answer for a while during a read", by_server=False)
        finally:
            self.active = self._transfer = None
            if transfer.idle:
                stream.on_idle()
            stream.detach()
            self._driver.cancel(transfer)
            stream.share.on_turn(started, self._clock())
        if transfer.error is not None:
            raise transfer.error

    def _give_way(self, transfer: ReadTransfer) -> None:
        """Let no burst follow another while somebody else waits for an answer: PX4 fills with a burst what
        the link holds, and the answer finds no room there."""
        if isinstance(transfer, BurstTransfer):
            transfer.by_requests = self._engine.in_flight > transfer.in_flight

    def _go_on(self, stream: FileStream, transfer: ReadTransfer, started: float) -> bool:
        if transfer.done or transfer.idle or stream.closed or self._server.session is None:
            return False
        if self._server.claimed(stream.path):
            return False
        rival = self._queue.rival_use(stream)
        if rival is None:
            return True
        return stream.has_demand and not stream.share.gives_way(
            rival, started, self._clock(), self._engine.rtt
        )

    def _stalled(self, transfer: ReadTransfer) -> bool:
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        quiet_since = max(self._driver.last_reply_at, transfer.started_at)
        return not transfer.idle and self._clock() - quiet_since > limit

    def _on_session_lost(self, stream: FileStream, error: SessionLost) -> None:
        """Reopen and go on at the same offset (promise 5); what the lost session read is provisional."""
        self._server.abandon()
        if error.by_server:
            self._doubt.raise_it(str(error))
        stream.clean_failures += 1
        if stream.clean_failures > REOPENS:
            stream.fail(error)
