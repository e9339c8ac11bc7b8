"""What a link is to the layers above, and what links share. Layer: link.

A link moves bytes and does not interpret them. When a peer goes away and comes back, the link reopens by
itself and counts it. LinkClosed means that it will never work again.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.messages import Address

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

    def keep_peer(self) -> None:
        """Note that the peer that is served was heard just now. For some seconds no new connection takes its
        place."""
        ...

    def focus(self, system: int) -> None:
        """From now on only one system matters: a shared port leaves out frames that concern only others."""
        ...

    def descriptors(self) -> list[int]:
        """Return the open descriptors with which another process can go on (`opening.open_link`)."""
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
        self.size -= min(sent, len(item))
        if sent < len(item):
            self._items.appendleft(item[sent:])

    def clear(self) -> int:
        """Drop everything; return how many items that were."""
        count = len(self._items)
        self._items.clear()
        self.size = 0
        return count


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
