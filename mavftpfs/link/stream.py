"""Byte streams that are reopened when they fail: what TCP and serial links share. Layer: link.

If a stream fails, the link drops and counts what waits to be sent. A helper task then asks the opener for a
new pipe until one opens, with growing pauses. After that `receive` returns REOPENED.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeAlias

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import REOPENED, Piece, Pipe, PipeLink

MAX_READS = 64
_READ_SIZE = 16 * 1024

FIRST_PAUSE = 0.25
LONGEST_PAUSE = 2.0
"""Seconds between attempts to reopen."""

Opened: TypeAlias = tuple[Pipe, NetAddress | None]
"""A pipe, and the address that opened it; None if this program opened it."""

Opener = Callable[[], Awaitable[Opened]]
"""Opens a pipe, waiting as long as it takes. Raises OSError: try again later."""


class StreamLink(PipeLink):
    """Implements link.base.Link over whatever `opener` opens.

    Args:
        pipe: the first one, if it is already open.
        outbox_limit: bytes to keep for a slow peer.
    """

    is_stream = True

    def __init__(
        self, description: str, opener: Opener, pipe: Pipe | None, *, is_serial: bool, outbox_limit: int
    ) -> None:
        super().__init__(description, pipe, outbox_limit)
        self.is_serial = is_serial
        self._opener = opener
        self._peer: NetAddress | None = None
        self._was_open = pipe is not None
        self._news: list[Piece] = []

    @property
    def connected(self) -> bool:
        """Whether there is a pipe at the moment."""
        return self._pipe is not None

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """Send frames in one write; drop and count whole frames that cannot be kept."""
        if self._pipe is None:
            self.stats.dropped_sends += len(frames)
            return
        if not self._outbox:
            data = b"".join(frames)
            sent = self._write(data, None)
            if sent == len(data):
                return
            if sent:
                self._keep(data[sent:], force=True)  # the rest of a frame must follow its beginning
                return
        for frame in frames:
            self._keep(frame)

    async def run(self) -> None:
        """Write what waits, and reopen what failed; run until cancelled."""
        async with trio.open_nursery() as nursery:
            nursery.start_soon(super().run)
            nursery.start_soon(self._keep_open)

    async def _keep_open(self) -> None:
        pause = FIRST_PAUSE
        while True:
            if self._pipe is not None or self._closed:
                pause = FIRST_PAUSE
                await self._changed.park()
                continue
            try:
                opened = await self._opener()
            except OSError:
                await trio.sleep(pause)
                pause = min(pause * 2, LONGEST_PAUSE)
            else:
                self._use(*opened)

    def _use(self, pipe: Pipe, peer: NetAddress | None) -> None:
        """Use a pipe that was opened."""
        if self._closed:
            pipe.close()
            return
        self._pipe, self._peer = pipe, peer
        if self._was_open:
            self.stats.reopened += 1
            self._news.append(REOPENED)
        self._was_open = True
        self._changed.unpark_all()

    async def aclose(self) -> None:
        """Close the link, and drop what the kernel does not accept now."""
        if self._outbox:
            self._write(*self._outbox[0])
        await super().aclose()

    def _take(self) -> list[Piece]:
        if self._news:
            return [self._news.pop()]
        pieces: list[Piece] = []
        while self._pipe is not None and len(pieces) < MAX_READS:
            try:
                data = os.read(self._pipe.fileno(), _READ_SIZE)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._drop_pipe()
                break
            pieces.append((data, self._peer))
            if len(data) < _READ_SIZE:
                break  # saves the read that would say "nothing more"
        return pieces

    def _write(self, data: bytes, to: NetAddress | None) -> int:
        if self._pipe is None:
            return len(data)
        try:
            sent = os.write(self._pipe.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError:
            self.stats.dropped_sends += 1
            self._drop_pipe()
            return len(data)
        self.stats.sent_bytes += sent
        return sent
