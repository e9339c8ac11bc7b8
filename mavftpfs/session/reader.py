"""Reads one file, turn by turn: its pending ranges, and the requests of a turn. Layer: session."""

from __future__ import annotations

from functools import partial
from math import inf

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.reading import ReadTransfer, Wants
from mavftpfs.session.scheduler import Future, Scheduler, SessionUser, Turn
from mavftpfs.session.serversession import OpenSession
from mavftpfs.shared.errors import FileChanged, MavftpfsError, RemoteProtocolError, SessionLost
from mavftpfs.shared.sameness import Known, Opened, Sameness, compare

FIRST_WANT = 0.05
"""Seconds for which an opened file stays open for its first read although another file waits."""


class FileStream(SessionUser):
    """Implements cache.remote.Reader. A stream outlives the server's session on its file: ranges that did not
    arrive remain pending for the transfer of its next turn.

    expected_size: in bytes, if it is known without opening the file.

    Attributes:
        size: by the first open ACK, in bytes; 0 before that. first_open: ends when that ACK arrives, or with
            the error of the open.
        closed: the sink is called no more.
    """

    def __init__(self, path: bytes, sink: ReadSink, expected_size: int | None, scheduler: Scheduler) -> None:
        super().__init__(path)
        self.size = expected_size or 0
        self.closed = False
        self._sink = sink
        self._scheduler = scheduler
        self._server = scheduler.server
        self.first_open = Future()
        self._wants = Wants()
        self._removed = False
        self._transfer: ReadTransfer | None = None
        self._changed = trio.lowlevel.ParkingLot()
        if expected_size is not None:
            self.first_open.end()

    # --- the cache's side

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        """Ask for bytes of [start, stop), clamped to the size."""
        stop = min(stop, self.size)
        if start >= stop or self.closed:
            return
        if self._removed:
            self._sink.on_failed(FileChanged(f"{self.path!r} was removed or replaced"))
            return
        if self._wants.idle:
            self.tries.begin_anew()
        self._wants.add(self._sink.missing(start, stop), demand=demand)
        self.note_pressing(self._server.clock())
        self._changed.unpark_all()
        self._server.wake()

    def drop(self, *, demand: bool = True) -> None:
        """Drop all pending ranges; demand: False: only readahead. Requests in flight still bring their
        bytes."""
        self._wants.drop(demand=demand)
        self.note_pressing(self._server.clock())

    def close(self) -> None:
        """Close the stream: drop all pending ranges, and cancel the requests in flight."""
        self.closed = True
        self.drop()
        self._changed.unpark_all()
        if self._transfer is not None:
            self._server.driver.cancel(self._transfer)
        self._scheduler.remove(self)

    # --- the scheduler's side

    @property
    def pressing(self) -> bool:
        """See SessionUser."""
        return not (self.first_open.ended and self._wants.demand.empty)

    @property
    def idle(self) -> bool:
        """See SessionUser."""
        return self.closed or (self.first_open.ended and self._wants.idle)

    def goes_on(self, session: OpenSession) -> bool:
        """See SessionUser."""
        return session.path == self.path and not session.writing and self.first_open.ended

    def on_queued(self) -> None:
        """See SessionUser."""
        self._sink.on_queued()

    def on_removed(self) -> None:
        """Stop reading with an error, because the next file of that name is another one."""
        self._removed = True
        self._fail(FileChanged(f"{self.path!r} was removed or replaced"))

    def _fail(self, error: MavftpfsError) -> None:
        """Raise an error in the reads that wait, and drop their ranges."""
        self.drop()
        if not self.first_open.ended:
            self.first_open.end(error)
        elif not self.closed:
            self._sink.on_failed(error)

    # --- its task

    async def run(self) -> None:
        """Take turns whenever ranges are pending, until the stream is closed."""
        server = self._server
        while not self.closed:
            pause = inf if self.idle else self.tries.retry_at - server.clock()
            if pause > 0.0:
                with trio.move_on_after(pause):
                    await self._changed.park()
                continue
            if (failure := self._scheduler.failure(self)) is not None:
                self._fail(failure)
                continue
            try:
                async with self._scheduler.turn(self) as turn:
                    await self._open(turn)
                    await self._read(turn)
            except SessionLost as error:  # the next turn continues at the same offset (promise 5)
                # The turn is over, but nothing was awaited since, so nobody else has opened a file yet.
                self._scheduler.lose(self, error)
            except MavftpfsError as error:
                self._fail(error)
            self.note_pressing(server.clock())

    async def _open(self, turn: Turn) -> None:
        """Open the file unless it is open. After the first open, wait FIRST_WANT for the first read before
        another file may have the turn.

        Raises:
            FileChanged: the file is smaller than at its first open. A larger one only grew, and is served at
                its first size.
        """
        server, session, first = self._server, self._server.opened, not self.first_open.ended
        if session is None or not self.goes_on(session):
            session = await turn.open()
        if session.size is None:
            await server.close_quietly()
            raise RemoteProtocolError("the vehicle's open reply contains no size")
        if compare(Known(self.size), Opened(session.size)) is Sameness.OTHER:
            await server.close_quietly()
            raise FileChanged(f"{self.path!r} shrank from {self.size} to {session.size} bytes")
        if first:
            self.size = session.size
            self.first_open.end()
        if not self.closed:
            self._sink.on_opened(session.opened_at)
        if first:
            with trio.move_on_after(FIRST_WANT):
                while self.idle and not self.closed:
                    await server.sleep(FIRST_WANT)

    async def _read(self, turn: Turn) -> None:
        server, session = self._server, self._server.opened
        if session is None or self.idle:
            return  # `distrust` left the session meanwhile, or nothing is pending
        kind = BurstTransfer if self._scheduler.read_mode == "burst" else ReadTransfer
        transfer = kind(session.id, self.size, self._sink, self._scheduler.read_chunks, self._wants)
        engine = server.engine
        self._transfer = transfer
        if isinstance(transfer, BurstTransfer):
            transfer.by_requests = engine.in_flight > 0
        try:
            with server.running(transfer, partial(self._on_batch, transfer)):
                while not (transfer.done or transfer.idle or self.closed or server.opened is None):
                    if turn.is_over() or (turn.contended and not transfer.demanded):
                        break
                    if isinstance(transfer, BurstTransfer):
                        # Bursts do not follow one another while others wait for an answer, because PX4 fills
                        # the link with a burst, and the answer finds no room there.
                        transfer.by_requests = engine.serves_others(transfer)
                    await server.look_again()
                    if server.is_stalled(transfer):
                        raise SessionLost("no answer for a while during a read", by_server=False)
        finally:
            self._transfer = None

    def _on_batch(self, transfer: ReadTransfer, now: float) -> None:
        """Report to the sink, once for each batch of replies, how many bytes arrived."""
        count, transfer.received_bytes = transfer.received_bytes, 0
        if count:
            self.tries.begin_anew()
            self._sink.on_batch(count)
