"""Files that are read: what is wanted of each, and how the session serves one at a time. Layer: session.

A FileStream is the Reader that the caches hold. It outlives the server's session on its file: wants that are
not yet fulfilled are kept here and handed to whatever transfer is attached next.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf
from typing import Literal

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.queue import Queue, SessionUser
from mavftpfs.session.serversession import ServerSession
from mavftpfs.shared.errors import FileChanged, MavftpfsError, RemoteProtocolError, SessionLost
from mavftpfs.shared.extents import ExtentSet

ReadMode = Literal["window", "burst"]

STALL = 2.0
"""Seconds without any reply during a read after which the server's session is no longer believed in."""

FIRST_WANT = 0.05
"""Seconds an opened file is kept open for its first read although another file waits."""

REOPENS = 5
"""How often one want may lose its session without a byte of progress before it fails."""

RECENT = 10.0
"""Seconds for which what was read stays provisional, also of files that were closed since: another client is
noticed late, because servers answer it on its own link, and a router may pass on only some of that."""

_OFTEN = 0.25


class FileStream(SessionUser):
    """Implements cache.remote.Reader.

    Attributes:
        sink: where its bytes go; nothing does once it is closed, but that they are in doubt.
        size: by the first open ACK, in bytes; 0 before that. wants_open: somebody waits for that ACK.
        last_data_at: when bytes came, None if none did. lost: how often the session was, without progress.
    """

    def __init__(self, path: bytes, sink: ReadSink, size: int | None, reading: Reading) -> None:
        super().__init__(path)
        self.size = size or 0
        self.wants_open = size is None
        self.closed = False
        self.last_data_at: float | None = None
        self.lost = 0
        self.sink = sink
        self._reading = reading
        self._demand = ExtentSet()
        self._ahead = ExtentSet()
        self._opened = trio.Event()
        self._open_error: MavftpfsError | None = None
        self._removed = False
        self._transfer: ReadTransfer | None = None
        if not self.wants_open:
            self._opened.set()

    # --- the cache's side

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        """Ask for bytes of [start, stop), clamped to the size."""
        stop = min(stop, self.size)
        if start >= stop or self.closed:
            return
        if self._removed:
            self.sink.on_failed(FileChanged(f"{self.path!r} was removed or replaced"))
            return
        wanted = self._demand if demand else self._ahead
        for gap_start, gap_stop in self.sink.missing(start, stop):
            wanted.add(gap_start, gap_stop)
        if self._transfer is not None:
            self._transfer.want(start, stop, demand)
        self._reading.on_want(self)

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
        self._reading.on_closed(self)

    # --- the session's side

    def due_at(self) -> float:
        """See SessionUser."""
        return 0.0 if self.wants_open or not self._demand.empty else inf

    def prefetches(self) -> bool:
        """See SessionUser."""
        return not self._ahead.empty

    async def wait_opened(self) -> None:
        """Wait for the first open's outcome; raise its error."""
        await self._opened.wait()
        if self._open_error is not None:
            raise self._open_error

    def on_opened(self, size: int, at: float) -> None:
        """Bytes come from a session that was opened at that time, on a file of that size.

        Raises:
            FileChanged: the file is smaller than what was opened. A larger one only grew: it is served at
                its opened size.
        """
        self.wants_open = False
        if not self._opened.is_set():
            self.size = size
            self._opened.set()
        elif size < self.size:
            raise FileChanged(f"{self.path!r} shrank from {self.size} to {size} bytes")
        if not self.closed:
            self.sink.on_opened(at)

    def attach(self, transfer: ReadTransfer) -> None:
        """Hand what is wanted to a transfer; later wants go to it directly."""
        self._transfer = transfer
        for start, stop in self._demand:
            transfer.want(start, stop, True)
        for start, stop in self._ahead:
            transfer.want(start, stop, False)

    def detach(self, *, done: bool) -> None:
        """The transfer ended; done: everything wanted has come. Else the next one is to bring it."""
        self._transfer = None
        if done:
            self._demand.clear()
            self._ahead.clear()

    def on_batch(self) -> None:
        """A batch of data ended. What came is wanted no more, even if the cache soon drops it again."""
        if self.closed:
            return
        for wanted in (self._demand, self._ahead):
            before = list(wanted)
            wanted.clear()
            for start, stop in before:
                for gap_start, gap_stop in self.sink.missing(start, stop):
                    wanted.add(gap_start, gap_stop)
        self.sink.on_batch()

    def fail(self, error: MavftpfsError) -> None:
        """See SessionUser."""
        self.wants_open = False
        self._demand.clear()
        self._ahead.clear()
        if self._opened.is_set():
            self.sink.on_failed(error)
        else:
            self._open_error = error
            self._opened.set()

    def on_removed(self) -> None:
        """The file is gone from its path: nothing more of it can be had, and of its successor nothing may."""
        self._removed = True
        if self.due_at() < inf:
            self.fail(FileChanged(f"{self.path!r} was removed or replaced"))


class Reading:
    """Makes streams, and serves the one whose turn it is. mode: by which requests. chunks: their size."""

    def __init__(
        self,
        server: ServerSession,
        driver: Driver,
        queue: Queue,
        doubt: Doubt,
        mode: ReadMode,
        chunks: ChunkSize,
        clock: Callable[[], float],
    ) -> None:
        self._active: FileStream | None = None
        self._server = server
        self._driver = driver
        self._engine = driver.engine
        self._queue = queue
        self._vehicle = driver.vehicle
        self._doubt = doubt
        self._mode: ReadMode = mode
        self._chunks = chunks
        self._clock = clock
        self._transfer: ReadTransfer | None = None
        self._seen_bytes = 0
        self._closed: deque[FileStream] = deque()

    # --- streams

    def open_stream(self, path: bytes, sink: ReadSink, size: int | None) -> FileStream:
        """Register a reader; with size None it asks for an open ACK (await stream.wait_opened())."""
        stream = FileStream(path, sink, size, self)
        self._queue.add(stream)
        self.on_want(stream)
        return stream

    def on_want(self, stream: FileStream) -> None:
        """It wants something, perhaps of those that somebody waits for."""
        if stream.asked_at is None and stream.due_at() < inf:
            stream.asked_at = self._clock()
        self._server.wake()

    def on_closed(self, stream: FileStream) -> None:
        """It wants nothing any more, nor what is on its way. What it read stays provisional for a while."""
        if stream is self._active:
            self.cut_off()
        if stream in self._queue.users:
            self._closed.append(stream)
            self._forget_closed()
        self._queue.remove(stream)

    def on_doubt(self, reason: str) -> None:
        """What was read lately is provisional, also of files closed since."""
        self._forget_closed()
        for stream in [*self._queue.users, *self._closed]:
            if isinstance(stream, FileStream) and (stream is self._active or self._is_recent(stream)):
                stream.sink.on_suspect(reason)

    def _forget_closed(self) -> None:
        while self._closed and not self._is_recent(self._closed[0]):
            self._closed.popleft()

    def _is_recent(self, stream: FileStream) -> bool:
        return stream.last_data_at is not None and stream.last_data_at > self._clock() - RECENT

    # --- one turn

    def cut_off(self) -> None:
        """Whatever is under way gets no more answers, or none to be believed."""
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    async def serve(self, stream: FileStream) -> None:
        """Read for a stream. Its errors are told to the stream."""
        try:
            self._vehicle.require_there(self._clock())
            await self._open(stream)
            await self._read(stream)
        except SessionLost as error:
            self._on_session_lost(stream, error)
        except MavftpfsError as error:
            stream.fail(error)
        stream.asked_at = self._clock() if stream.due_at() < inf else None

    async def _open(self, stream: FileStream) -> None:
        """Have the stream's file open. Give who waited for that a moment to ask for its bytes, before another
        file takes its turn."""
        session = self._server.session
        awaited = stream.wants_open
        if session is None or session.path != stream.path or session.writing or awaited:
            session = await self._server.open(stream.path)
        try:
            if session.size is None:
                raise RemoteProtocolError("the vehicle's open reply holds no size")
            stream.on_opened(session.size, session.opened_at)
        except (FileChanged, RemoteProtocolError):
            await self._server.close_quietly()
            raise
        if awaited:
            with trio.move_on_after(FIRST_WANT):
                while not (stream.due_at() < inf or stream.prefetches() or stream.closed):
                    await self._server.sleep(FIRST_WANT)

    async def _read(self, stream: FileStream) -> None:
        session = self._server.session
        if session is None or not (stream.due_at() < inf or stream.prefetches()):
            return  # the vehicle restarted since it was opened, or nothing is wanted
        kind = BurstTransfer if self._mode == "burst" else ReadTransfer
        transfer = kind(session.id, stream.size, stream.sink, self._chunks)
        began = self._clock()
        self._active, self._transfer, self._seen_bytes = stream, transfer, 0
        stream.attach(transfer)
        self._driver.on_batch = self._on_batch
        self._let_bursts_wait(transfer)
        try:
            await self._driver.start(transfer, self._server.wake)
            while self._goes_on(stream, transfer, began):
                self._let_bursts_wait(transfer)
                # What woke us may be a new want, and with nothing in flight no answer would send for it.
                self._driver.kick()
                await self._server.sleep(_OFTEN)
                heard_at = max(self._driver.last_reply_at, transfer.progress_at)  # `bwlimit=` is no silence
                limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
                if not transfer.idle and self._clock() - heard_at > limit:
                    raise SessionLost("no answer for a while during a read", by_server=False)
        finally:
            self._active = self._transfer = self._driver.on_batch = None
            stream.detach(done=transfer.idle)
            self._driver.cancel(transfer)
            stream.on_turn(began, self._clock())
        if transfer.error is not None:
            raise transfer.error

    def _on_batch(self, now: float) -> None:
        """A batch of replies was processed: pass data on, once."""
        transfer, stream = self._transfer, self._active
        if transfer is None or stream is None:
            return
        if transfer.received_bytes != self._seen_bytes:
            self._seen_bytes = transfer.received_bytes
            stream.last_data_at = now
            stream.lost = 0
            stream.on_batch()
        if transfer.idle or transfer.done:
            self._server.wake()

    def _let_bursts_wait(self, transfer: ReadTransfer) -> None:
        """Let no burst follow another while somebody else waits for an answer: PX4 fills with a burst what
        the link holds, and the answer finds no room there."""
        if isinstance(transfer, BurstTransfer):
            transfer.by_requests = self._engine.in_flight > transfer.in_flight

    def _goes_on(self, stream: FileStream, transfer: ReadTransfer, began: float) -> bool:
        if transfer.done or transfer.idle or stream.closed or self._server.session is None:
            return False
        if self._server.is_excluded(stream.path):
            return False
        rival = self._queue.rival_use(stream)
        if rival is None:
            return True
        return stream.due_at() < inf and not stream.gives_way(rival, began, self._clock(), self._engine.rtt)

    def _on_session_lost(self, stream: FileStream, error: SessionLost) -> None:
        """Reopen and go on at the same offset (promise 5); what the lost session read is provisional."""
        self._server.abandon()
        if error.by_server:
            self._doubt.raise_it(str(error))
        stream.lost += 1
        if stream.lost > REOPENS:
            stream.fail(error)
