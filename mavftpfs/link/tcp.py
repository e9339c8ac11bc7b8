"""TCP links: `tcp` connects (again and again), `tcpin` accepts one peer at a time. Layer: link.

A peer of `tcpin` stays until its connection ends; the next peer waits. Both ends use keep-alives and a user
timeout, so that they notice within about 10 s that a vehicle lost power. TCP alone would wait for minutes.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace

import trio

from mavftpfs.link.base import background, look_up
from mavftpfs.link.stream import Opened, StreamLink
from mavftpfs.link.uri import LinkSpec, cannot_open

CONNECT_TIMEOUT = 5.0
"""Seconds for each attempt."""

_OUTBOX_LIMIT = 64 * 1024
_MAX_ADDRESSES = 4


@asynccontextmanager
async def open_tcp(spec: LinkSpec, *, patient: bool = False) -> AsyncIterator[StreamLink]:
    """Connect to a listening vehicle or bridge, and again whenever the connection is lost.

    patient: return at once, and connect as soon as a peer listens.

    Raises:
        LinkClosed: the first attempt failed.
    """

    async def connect() -> Opened:
        return await _connect(spec), None

    try:
        pipe = None if patient else await _connect(spec)
    except OSError as exc:
        raise cannot_open(spec, exc) from exc
    link = StreamLink(spec.description, connect, pipe, is_serial=False, outbox_limit=_OUTBOX_LIMIT)
    async with background(link.run, link.aclose):
        yield link


@asynccontextmanager
async def open_tcp_server(spec: LinkSpec) -> AsyncIterator[StreamLink]:
    """Listen. The link is usable at once; before a peer connects, it drops what is sent.

    Raises:
        LinkClosed: the port is taken, or this computer does not have the address.
    """
    try:
        listener = await _listen(spec)
    except OSError as exc:
        raise cannot_open(spec, exc) from exc
    with listener:
        bound = replace(spec, port=listener.getsockname()[1])

        async def accept() -> Opened:
            await trio.lowlevel.wait_readable(listener)
            peer, address = listener.accept()
            # Each connection has a port of its own, but a returning peer has the same host.
            return _configure(peer), address[:1]

        link = StreamLink(bound.description, accept, None, is_serial=False, outbox_limit=_OUTBOX_LIMIT)
        async with background(link.run, link.aclose):
            yield link


async def _connect(spec: LinkSpec) -> socket.socket:
    """Try the host's addresses one after the other.

    Raises:
        OSError: that of the last address.
    """
    found = await look_up(spec.host, spec.port, socket.SOCK_STREAM)
    problem: OSError = OSError(errno.EHOSTUNREACH, "no address")
    for family, kind, protocol, _, address in found[:_MAX_ADDRESSES]:
        with trio.socket.socket(family, kind, protocol) as sock:
            try:
                with trio.fail_after(CONNECT_TIMEOUT):
                    await sock.connect(address)
            except OSError as exc:
                problem = exc
            except trio.TooSlowError:
                problem = OSError(errno.ETIMEDOUT, "no answer")
            else:
                return _configure(socket.socket(fileno=sock.detach()))
    raise problem


async def _listen(spec: LinkSpec) -> socket.socket:
    found = await look_up(spec.host, spec.port, socket.SOCK_STREAM, socket.AI_PASSIVE)
    family, kind, protocol, _, address = found[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setblocking(False)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # past connections in TIME_WAIT
        listener.bind(address)
        listener.listen(4)
    except BaseException:
        listener.close()
        raise
    return listener


def _configure(sock: socket.socket) -> socket.socket:
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", 4),
        ("TCP_KEEPINTVL", 2),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", 10_000),
    ):
        with suppress(OSError, AttributeError):  # missing on some systems, and not essential
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    return sock
