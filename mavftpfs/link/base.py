"""The interface of links, and the base of links over a descriptor. Layer: link.

A link moves bytes and does not interpret them. If a peer goes away and comes back, the link reopens by itself
and `receive` says so. LinkClosed means that the link will never work again.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.messages import Address
from mavftpfs.shared.errors import LinkClosed

MAX_DATAGRAM = 1400
"""Bytes: below any usual MTU, and far below PX4's receive buffer (31 frames in one datagram were cut)."""

Piece: TypeAlias = tuple[bytes, NetAddress | None]
"""Bytes that arrived together, and the address that sent them; None where there is only one sender."""

REOPENED: Piece = (b"", None)
"""The piece that marks a reopened link: the rest of a half-received frame will not arrive."""


@dataclass(slots=True)
class LinkStats:
    """Counters for status; plain sums since the link was opened."""

    received_bytes: int = 0
    sent_bytes: int = 0
    dropped_sends: int = 0
    reopened: int = 0


@dataclass(frozen=True, slots=True)
class Seat:
    """This program's place on a shared port: its MAVLink address there, and the link id in its signatures,
    which keeps their times apart from those of other programs."""

    own: Address
    number: int


class Link(Protocol):
    """A byte or datagram pipe. The context manager that opened it closes it.

    Attributes:
        seat: the place on a shared port, None on another one. It may change when the link is reopened.
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
        """Bytes accepted by `send` and not yet handed to the kernel."""
        ...

    async def receive(self) -> list[Piece]:
        """Wait for input and return 1..256 pieces: everything that has arrived.

        Raises:
            LinkClosed: the link will never work again.
        """
        ...

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """Send whole MAVLink frames, several to a datagram or write where they fit in 1400 bytes.

        to: an address that `receive` returned. None: the only peer, or where there may be several, the one
        that was heard last. Never blocks, and never raises for a full or absent peer: the link drops and
        counts what exceeds a bounded backlog, as a radio would.
        """
        ...


async def look_up(host: str, port: int, kind: socket.SocketKind, flags: int = 0) -> list[Any]:
    """Return the result of `getaddrinfo`.

    Raises:
        OSError: there is no such host; also for a text that cannot be a host name.
    """
    try:
        return await trio.socket.getaddrinfo(host, port, type=kind, flags=flags)
    except UnicodeError as exc:
        raise socket.gaierror(socket.EAI_NONAME, f"{host!r} is not a host name") from exc


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


class Pipe(Protocol):
    """A socket or a serial port, open and non-blocking."""

    def fileno(self) -> int:
        """Return the descriptor."""
        ...

    def close(self) -> None:
        """Close the pipe; harmless twice."""
        ...


class PipeLink:
    """A link over a descriptor: waits for the descriptor, and keeps what the kernel refuses.

    Args:
        pipe: None if it is opened later.
        outbox_limit: bytes to keep for a slow peer. Frames without room are dropped whole, because a stream
            must never be cut inside a frame.

    Attributes:
        backlog: see Link.
    """

    is_stream = False
    is_serial = False

    def __init__(self, description: str, pipe: Pipe | None, outbox_limit: int) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.description = description
        self.backlog = 0
        self._pipe = pipe
        self._closed = False
        self._limit = outbox_limit
        self._outbox: deque[Piece] = deque()
        self._changed = trio.lowlevel.ParkingLot()  # signals bytes that wait, or another pipe

    async def receive(self) -> list[Piece]:
        """See Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        waited = False
        while not self._closed:
            pieces = self._take()
            if pieces:
                if not waited:  # one checkpoint per batch, and none where a cancellation would lose data
                    await trio.lowlevel.cancel_shielded_checkpoint()
                self.stats.received_bytes += sum(len(data) for data, _ in pieces)
                return pieces
            waited = True
            if not self._closed:
                await self._until(trio.lowlevel.wait_readable)
        raise LinkClosed(f"{self.description} is closed")

    async def run(self) -> None:
        """Send what waits for the kernel; run until cancelled."""
        while True:
            if not self._outbox:
                await self._changed.park()
                continue
            taken = self._write(*self._outbox[0])
            if not self._outbox:
                continue  # the pipe broke
            data, to = self._outbox.popleft()
            self.backlog -= taken
            if taken < len(data):
                self._outbox.appendleft((data[taken:], to))
                await self._until(trio.lowlevel.wait_writable)

    async def wait_closed(self) -> None:
        """Wait until the link is closed."""
        while not self._closed:
            await self._changed.park()

    async def aclose(self) -> None:
        """Close the link, and drop what the kernel has not accepted."""
        self._closed = True
        self._drop_pipe()
        await trio.lowlevel.checkpoint()

    def _keep(self, data: bytes, to: NetAddress | None = None, *, force: bool = False) -> None:
        """Keep what the kernel did not accept; drop and count it where there is no room."""
        if force or self.backlog + len(data) <= self._limit:
            self._outbox.append((data, to))
            self.backlog += len(data)
            self._changed.unpark_all()
        else:
            self.stats.dropped_sends += 1

    def _drop_pipe(self) -> None:
        """Close the pipe, and drop what waits for it, because an old request does more harm than a lost
        one."""
        pipe, self._pipe = self._pipe, None
        if pipe is not None:
            trio.lowlevel.notify_closing(pipe.fileno())
            pipe.close()
        self.stats.dropped_sends += len(self._outbox)
        self._outbox.clear()
        self.backlog = 0
        self._changed.unpark_all()

    async def _until(self, ready: Callable[[int], Awaitable[None]]) -> None:
        """Wait until the pipe is ready or gone; without a pipe, until there is one."""
        if self._pipe is None:
            await self._changed.park()
        else:
            with suppress(trio.ClosedResourceError, OSError):  # closed meanwhile; the caller looks again
                await ready(self._pipe.fileno())

    def _take(self) -> list[Piece]:
        """Return all pieces that have arrived. May drop a broken pipe."""
        raise NotImplementedError

    def _write(self, data: bytes, to: NetAddress | None) -> int:
        """Hand an item to the kernel; return the number of bytes it took. Lost bytes count as taken."""
        raise NotImplementedError


@asynccontextmanager
async def plain_nursery() -> AsyncIterator[trio.Nursery]:
    """Give a nursery whose tasks end with the body.

    An Exception of the body leaves as itself, while a bare nursery would wrap it in an ExceptionGroup,
    because callers catch errors by name.
    """
    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        try:
            yield nursery
        except Exception as exc:
            failure = exc
        finally:
            nursery.cancel_scope.cancel()
    if failure is not None:
        raise failure


@asynccontextmanager
async def background(
    task: Callable[[], Awaitable[None]], close: Callable[[], Awaitable[None]]
) -> AsyncIterator[None]:
    """Run `task` beside the body; when the body ends, `close` (shielded) and cancel the task."""
    async with plain_nursery() as nursery:
        nursery.start_soon(task)
        try:
            yield
        finally:
            with trio.CancelScope(shield=True):
                await close()
