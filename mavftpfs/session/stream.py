"""A remote file open for reading: the Reader that the caches hold. Layer: session.

A stream outlives the server's session on its file: wants that are not yet fulfilled are kept here and
handed to whatever transfer is attached next.
"""

from __future__ import annotations

from collections.abc import Callable

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.session.policy import Service
from mavftpfs.shared.errors import FileChanged, MavftpfsError
from mavftpfs.shared.extents import ExtentSet


class FileStream:
    """Implements cache.remote.Reader. The scheduler attaches and detaches transfers."""

    def __init__(
        self, path: bytes, sink: ReadSink, size: int | None, wake: Callable[[FileStream], None]
    ) -> None:
        self.path = path
        self._sink = sink
        self.closed = False
        self.use = Service()
        self.ticket: int | None = None
        self.asked_at = 0.0
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

    def used(self, now: float) -> float:
        """Return the seconds of service that still count. While it waits they do not fade: who is passed over
        again and again would pass for somebody who wants little."""
        return self.use.recent(now if self.ticket is None else min(now, self.asked_at))

    def on_served(self, started: float, now: float) -> None:
        """It had the session from `started` until now."""
        self.use = Service(self.used(started) + now - started, now)

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
