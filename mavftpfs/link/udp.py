"""UDP links. Layer: link.

`udpin` binds a port and answers its senders. `udpout` speaks first, to one host. The socket keeps its source
port: PX4 answers only the first address it heard (servers.md 5). The socket is never connected, so that the
ICMP message "port unreachable" of a vehicle that reboots is not an error.
"""

from __future__ import annotations

import socket
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import Piece, PipeLink, background, look_up, pack
from mavftpfs.link.uri import LinkSpec, cannot_open
from mavftpfs.shared.errors import LinkClosed

MAX_DATAGRAMS = 256
"""Datagrams taken per wake-up: a larger number would delay heartbeats and the kernel's requests."""

_SOCKET_BUFFER = 1 << 20
_OUTBOX_LIMIT = 64 * 1024
_LARGEST = 65535


class UdpLink(PipeLink):
    """A bound UDP socket; implements link.base.Link. Made by `open_udp`.

    Args:
        sock: bound, non-blocking.
        target: the only destination of udpout, which ignores datagrams from other hosts. None: udpin.
    """

    def __init__(self, sock: socket.socket, description: str, target: NetAddress | None = None) -> None:
        super().__init__(description, sock, _OUTBOX_LIMIT)
        self._sock = sock
        self._target = target
        self._heard: NetAddress | None = None
        # Datagrams are copied from one buffer, because a bytes object of the largest size for each would
        # fragment the heap.
        self._buffer = memoryview(bytearray(_LARGEST))

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """Send frames, packed into datagrams below 1400 bytes; drop and count what cannot be sent."""
        to = self._target or to or self._heard
        for datagram in pack(frames):
            if self._outbox or not self._write(datagram, to):
                self._keep(datagram, to)

    def _take(self) -> list[Piece]:
        """Take all datagrams that have arrived. Ignore the socket's errors: ICMP messages of other hosts
        cause them."""
        receive, buffer, target = self._sock.recvfrom_into, self._buffer, self._target
        pieces: list[Piece] = []
        for _ in range(MAX_DATAGRAMS):
            try:
                count, sender = receive(buffer)
            except BlockingIOError:
                break
            except OSError:
                continue
            if count and (target is None or sender[0] == target[0]):
                pieces.append((bytes(buffer[:count]), sender))
        if pieces:
            self._heard = pieces[-1][1]
        return pieces

    def _write(self, data: bytes, to: NetAddress | None) -> int:
        if to is None or self._closed:
            self.stats.dropped_sends += 1
            return len(data)
        try:
            sent = self._sock.sendto(data, to)
        except BlockingIOError:
            return 0
        except OSError:  # no route or no buffer, and waiting would not help
            self.stats.dropped_sends += 1
            return len(data)
        self.stats.sent_bytes += sent
        return sent


@asynccontextmanager
async def open_udp(spec: LinkSpec, source_port: int = 0) -> AsyncIterator[UdpLink]:
    """Open udpin or udpout and run its writer for the length of the `async with`.

    source_port: the preferred local port of udpout.

    Raises:
        LinkClosed: unknown host, or the port is taken.
    """
    family, address = await _resolve(spec)
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        _configure(sock)
        if spec.kind.listens:
            _bind(sock, spec, address)
        else:
            _bind_somewhere(sock, source_port)
    except BaseException:
        sock.close()
        raise
    if spec.kind.listens:
        spec = replace(spec, port=sock.getsockname()[1])
    link = UdpLink(sock, spec.description, None if spec.kind.listens else address)
    async with background(link.run, link.aclose):
        yield link


async def _resolve(spec: LinkSpec) -> tuple[socket.AddressFamily, NetAddress]:
    try:
        found = await look_up(spec.host, spec.port, socket.SOCK_DGRAM)
    except OSError as exc:
        raise LinkClosed(
            f"{spec.description}: host {spec.host!r} is unknown ({exc.strerror or exc})"
        ) from exc
    # IPv4 first: a name like localhost often has both, and vehicles listen on IPv4.
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)
    return found[0][0], found[0][4]


def _configure(sock: socket.socket) -> None:
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, _SOCKET_BUFFER)  # the kernel caps it silently


def _bind(sock: socket.socket, spec: LinkSpec, address: NetAddress) -> None:
    try:
        sock.bind(address)
    except OSError as exc:
        raise cannot_open(spec, exc) from exc


def _bind_somewhere(sock: socket.socket, port: int) -> None:
    """Bind a port if it is free, or otherwise one that the kernel chooses."""
    anywhere = "::" if sock.family == socket.AF_INET6 else "0.0.0.0"
    try:
        sock.bind((anywhere, port))
    except OSError:
        sock.bind((anywhere, 0))
