"""Byte streams that are reopened when they fail: what TCP and serial links share. Layer: link.

A `Pipe` is an open, non-blocking file descriptor. When it fails, what waited to be sent is dropped and
counted: an old request is worse than a lost one. A helper task then asks the opener for a new pipe until it
gets one, with growing pauses. After that `receive` returns an empty list once: the caller resets its parser.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import DescriptorLink
from mavftpfs.shared.errors import LinkClosed

MAX_READS = 64
_READ_SIZE = 16 * 1024

FIRST_PAUSE = 0.25
LONGEST_PAUSE = 2.0
"""Seconds between attempts to reopen."""


class Pipe(Protocol):
    """A socket or a serial port, open and non-blocking."""

    def fileno(self) -> int:
        """The descriptor."""
        ...

    def close(self) -> None:
        """Close it; harmless twice."""
        ...


Opener = Callable[[], Awaitable[Pipe]]
"""Opens a new Pipe, waiting as long as it takes. Raises OSError or LinkClosed: try again later."""


class StreamLink(DescriptorLink):
    """Implements link.base.Link over whatever `opener` opens; without one, the owner calls `replace`.

    Args:
        pipe: the first one, where it is already open.
        outbox_limit: bytes to hold for a slow peer.
    """

    is_stream = True

    def __init__(
        self,
        description: str,
        opener: Opener | None,
        pipe: Pipe | None,
        *,
        is_serial: bool,
        outbox_limit: int,
    ) -> None:
        super().__init__(description, outbox_limit)
        self.is_serial = is_serial
        self._opener = opener
        self._pipe = pipe
        self._was_open = pipe is not None
        self._reopened = False
        self._peer: NetAddress | None = None
        self._changed = trio.Event()

    @property
    def connected(self) -> bool:
        """Whether there is a pipe at the moment."""
        return self._pipe is not None

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """Send frames in one write; drop and count, whole, what cannot be kept."""
        if self._pipe is None:
            self.stats.dropped_sends += len(frames)
            return
        if not self._outbox.size:
            data = b"".join(frames)
            sent = self._write(data)
            if sent == len(data):
                return
            if sent:
                self._keep(data[sent:], force=True)  # the rest of a frame must follow its beginning
                return
        for frame in frames:
            self._keep(frame)

    def sender(self, index: int) -> NetAddress | None:
        """Return the peer that connected; None where we opened the stream."""
        return self._peer

    def replace(self, pipe: Pipe, peer: NetAddress | None = None) -> None:
        """Go on with another pipe (a new connection). peer: the address that opened it, if it was not us."""
        if self._closed:
            pipe.close()
            return
        self._drop()
        self._pipe = pipe
        self._peer = peer
        self._reopened = self._was_open
        if self._was_open:
            self.stats.reopened += 1
        self._was_open = True
        self._notify()

    async def wait_disconnected(self) -> None:
        """Wait until there is no pipe."""
        while self.connected:
            await self._changed.wait()

    async def run(self) -> None:
        """Write what had to wait, and reopen what failed; runs until cancelled."""
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self.run_writer)
            if self._opener is not None:
                nursery.start_soon(self._keep_open, self._opener)

    async def aclose(self) -> None:
        """Close; what the kernel does not take now is lost."""
        head = self._outbox.head()
        if head is not None and self._pipe is not None:
            self._write(head)
        self._closed = True
        self._drop()
        self._notify()
        await trio.lowlevel.checkpoint()

    def _notify(self) -> None:
        self._changed.set()
        self._changed = trio.Event()

    def _drain(self) -> list[bytes] | None:
        if self._reopened:
            self._reopened = False
            return []
        pieces: list[bytes] = []
        while self._pipe is not None and len(pieces) < MAX_READS:
            try:
                data = os.read(self._pipe.fileno(), _READ_SIZE)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._lose()
                break
            pieces.append(data)
            if len(data) < _READ_SIZE:
                break  # saves the read that would say "nothing more"
        self.stats.received_bytes += sum(map(len, pieces))
        return pieces or None

    def _write(self, item: bytes) -> int:
        if self._pipe is None:
            return len(item)
        try:
            sent = os.write(self._pipe.fileno(), item)
        except BlockingIOError:
            return 0
        except OSError:
            self.stats.dropped_sends += 1
            self._lose()
            return len(item)
        self.stats.sent_bytes += sent
        self.stats.writes += 1
        return sent

    async def _wait_readable(self) -> None:
        if self._pipe is None:
            await self._changed.wait()
        else:
            await trio.lowlevel.wait_readable(self._pipe.fileno())

    async def _wait_writable(self) -> None:
        if self._pipe is not None:
            await trio.lowlevel.wait_writable(self._pipe.fileno())

    def _lose(self) -> None:
        self._drop()
        self._notify()

    def _drop(self) -> None:
        pipe, self._pipe = self._pipe, None
        if pipe is not None:
            trio.lowlevel.notify_closing(pipe.fileno())
            pipe.close()
        self.stats.dropped_sends += self._outbox.clear()

    async def _keep_open(self, opener: Opener) -> None:
        pause = FIRST_PAUSE
        while not self._closed:
            if self._pipe is not None:
                pause = FIRST_PAUSE
                await self._changed.wait()
                continue
            try:
                pipe = await opener()
            except (OSError, LinkClosed):
                await trio.sleep(pause)
                pause = min(pause * 2, LONGEST_PAUSE)
            else:
                self.replace(pipe)
