"""What a link is to the layers above, and what links have in common. Layer: link.

A link moves bytes and does not interpret them. When a peer goes away and comes back, the link reopens by
itself and counts it. LinkClosed means that it will never work again.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Protocol

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.messages import Address
from mavftpfs.shared.errors import LinkClosed

MAX_DATAGRAM = 1400
"""Bytes: below any usual MTU, and far below PX4's receive buffer (31 frames in one datagram were cut)."""


@dataclass(slots=True)
class LinkStats:
    """Counters for status; plain sums since the link was opened."""

    received_bytes: int = 0
    sent_bytes: int = 0
    writes: int = 0
    dropped_sends: int = 0
    reopened: int = 0


@dataclass(frozen=True, slots=True)
class Seat:
    """Our place on a shared port: our MAVLink address there, and the link id in our signatures, which keeps
    their times apart from those of others."""

    own: Address
    number: int


class Link(Protocol):
    """A byte or datagram pipe.

    Attributes:
        seat: our place on a shared port, None on a port of our own. It may change when the link is reopened.
    """

    stats: LinkStats
    seat: Seat | None

    @property
    def description(self) -> str:
        """SOURCE as a person would write it."""
        ...

    @property
    def is_stream(self) -> bool:
        """True for TCP and serial: where one piece ends means nothing."""
        ...

    @property
    def is_serial(self) -> bool:
        """True for serial ports: small receive buffers are likely at the far end."""
        ...

    @property
    def backlog(self) -> int:
        """Bytes accepted by send_nowait and not yet handed to the kernel."""
        ...

    async def receive(self) -> list[bytes]:
        """Wait for input and return 1..256 pieces, draining what is there.

        Returns an empty list when the link was reopened (the caller resets its parser).

        Raises:
            LinkClosed: the link will never work again (aclose was called).
        """
        ...

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """Send whole MAVLink frames, several to a datagram or write where they fit in 1400 bytes.

        Never blocks and never raises for a full or absent peer: what cannot be kept within a
        bounded backlog is dropped and counted, as a radio would.
        """
        ...

    def sender(self, index: int) -> NetAddress | None:
        """Return the sender of a piece that `receive` returned last; None where there is only one sender."""
        ...

    def answer(self, address: NetAddress) -> None:
        """From now on send to this address. Only a link that hears several senders has a choice."""
        ...

    def focus(self, system: int) -> None:
        """From now on only one system matters: a shared port leaves out frames that concern only others."""
        ...

    async def aclose(self) -> None:
        """Flush what can be flushed at once and close."""
        ...


async def look_up(host: str, port: int, kind: socket.SocketKind, flags: int = 0) -> list[Any]:
    """Return what `getaddrinfo` says.

    Raises:
        OSError: there is no such host; also for a text that cannot be a host name.
    """
    try:
        return await trio.socket.getaddrinfo(host, port, type=kind, flags=flags)
    except UnicodeError as exc:
        raise socket.gaierror(socket.EAI_NONAME, f"{host!r} is no host name") from exc


def pack(frames: Sequence[bytes]) -> Iterable[bytes]:
    """Yield datagrams of whole frames, in order, each up to 1400 bytes unless one frame is longer."""
    if len(frames) == 1:
        yield frames[0]
        return
    batch: list[bytes] = []
    size = 0
    for frame in frames:
        if batch and size + len(frame) > MAX_DATAGRAM:
            yield b"".join(batch)
            batch, size = [], 0
        batch.append(frame)
        size += len(frame)
    if batch:
        yield b"".join(batch)


class Outbox:
    """What a link has accepted and the kernel has not: first in, first out, with a limit on the sum.

    What does not fit is refused whole, so that a stream is never cut inside a frame.
    """

    def __init__(self, limit: int) -> None:
        self.size = 0
        self._limit = limit
        self._items: deque[bytes] = deque()

    def offer(self, item: bytes, *, force: bool = False) -> bool:
        """Append an item; return False, changing nothing, where it does not fit and is not forced."""
        if not force and self.size + len(item) > self._limit:
            return False
        self._items.append(item)
        self.size += len(item)
        return True

    def head(self) -> bytes | None:
        """Return the oldest item."""
        return self._items[0] if self._items else None

    def advance(self, sent: int) -> None:
        """Drop the first `sent` bytes of the oldest item."""
        item = self._items.popleft()
        self.size -= sent
        if sent < len(item):
            self._items.appendleft(item[sent:])

    def clear(self) -> int:
        """Drop everything; return how many items that were."""
        count = len(self._items)
        self._items.clear()
        self.size = 0
        return count


class DescriptorLink:
    """What links over a descriptor have in common: they wait for it, and keep what the kernel does not take.

    Args:
        outbox_limit: bytes to keep for a slow peer.
    """

    is_stream = False
    is_serial = False

    def __init__(self, description: str, outbox_limit: int) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.description = description
        self._outbox = Outbox(outbox_limit)
        self._work = trio.Event()
        self._closed = False

    @property
    def backlog(self) -> int:
        """Bytes accepted by send_nowait and not yet handed to the kernel."""
        return self._outbox.size

    async def receive(self) -> list[bytes]:
        """See Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        waited = False
        while not self._closed:
            pieces = self._drain()
            if pieces is not None:
                if not waited:  # one checkpoint per batch, and none where data could be lost
                    await trio.lowlevel.cancel_shielded_checkpoint()
                return pieces
            if self._closed:
                break
            waited = True
            with suppress(trio.ClosedResourceError, OSError):  # closed or replaced meanwhile; look again
                await self._wait_readable()
        raise LinkClosed(f"{self.description} is closed")

    def answer(self, address: NetAddress) -> None:
        """Nothing to choose."""

    def focus(self, system: int) -> None:
        """Nothing to leave out."""

    async def run_writer(self) -> None:
        """Send what had to wait for the kernel; runs until cancelled."""
        while True:
            await self._work.wait()
            self._work = trio.Event()
            while not self._closed and (item := self._outbox.head()) is not None:
                taken = self._write(item)
                if taken and self._outbox.head() is item:  # a pipe that broke has emptied the outbox
                    self._outbox.advance(taken)
                if taken < len(item):
                    with suppress(trio.ClosedResourceError, OSError):
                        await self._wait_writable()

    def _keep(self, item: bytes, *, force: bool = False) -> None:
        """Keep what the kernel did not take; drop and count it where there is no room."""
        if self._outbox.offer(item, force=force):
            self._work.set()
        else:
            self.stats.dropped_sends += 1

    def _drain(self) -> list[bytes] | None:
        """Return what is there: None for nothing, an empty list where the link was reopened. It may find that
        the link is closed."""
        raise NotImplementedError

    def _write(self, item: bytes) -> int:
        """Hand an item to the kernel; return how many bytes it took. What is lost counts as taken."""
        raise NotImplementedError

    async def _wait_readable(self) -> None:
        """Wait until there is something to take, or the descriptor is closed."""
        raise NotImplementedError

    async def _wait_writable(self) -> None:
        """Wait until the kernel has room, or the descriptor is closed."""
        raise NotImplementedError


class SocketLink(DescriptorLink):
    """A link over one socket of whole messages, which is never replaced."""

    def __init__(self, sock: socket.socket, description: str, outbox_limit: int) -> None:
        super().__init__(description, outbox_limit)
        self._sock = sock

    async def aclose(self) -> None:
        """Close; what the kernel has not taken by now is lost."""
        self._close()
        await trio.lowlevel.checkpoint()

    def _close(self) -> None:
        if not self._closed:
            self._closed = True
            trio.lowlevel.notify_closing(self._sock)
            self._sock.close()

    async def _wait_readable(self) -> None:
        await trio.lowlevel.wait_readable(self._sock)

    async def _wait_writable(self) -> None:
        await trio.lowlevel.wait_writable(self._sock)


@asynccontextmanager
async def background(
    task: Callable[[], Awaitable[None]], close: Callable[[], Awaitable[None]]
) -> AsyncIterator[None]:
    """Run `task` beside the body; when the body ends, `close` (shielded) and cancel the task.

    An Exception of the body comes out as itself, not inside an ExceptionGroup as a bare nursery would
    have it: callers catch LinkClosed by name.
    """
    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        nursery.start_soon(task)
        try:
            yield
        except Exception as exc:
            failure = exc
        finally:
            with trio.CancelScope(shield=True):
                await close()
            nursery.cancel_scope.cancel()
    if failure is not None:
        raise failure
