"""The names of ports: who has a port. Layer: link.

A program that opens a port holds the port's *name* as long as the port: an abstract Unix socket. A network
namespace has each name once, and a name ends with its process. Other programs of that user and of root call
there.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import socket
import struct
from pathlib import Path
from typing import NamedTuple

import trio

from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed

_PREFIX = "mavftpfs-port-"
_NAMES = Path("/proc/net/unix")
_QUEUE = 64
_PAUSE = 0.05
_FIRST_SOURCE_PORT, _SOURCE_PORTS = 24_000, 8_000
"""Below the ports that Linux chooses itself."""


class Busy(LinkClosed):
    """Another program has the port. A moment later the port may be free, or shared."""


class Peer(NamedTuple):
    """The process at the other end of a Unix socket, as of the time when it connected or began to listen."""

    pid: int
    uid: int
    gid: int


def port_name(spec: LinkSpec) -> str:
    """Return the name of a port, the same for two SOURCEs that exclude each other.

    `tcp` and `udpout` exclude nobody, but all programs of a user share them, because a server may accept only
    one client.
    """
    if spec.kind is LinkKind.SERIAL:
        text = f"serial {os.path.realpath(spec.device)}"
    elif spec.kind.listens:
        text = f"{spec.kind.value} {spec.port}"
    else:
        text = f"{os.getuid()} {spec.kind.value} {spec.host} {spec.port}"
    return "\0" + _PREFIX + hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def source_port(spec: LinkSpec) -> int:
    """Return the local port from which all mavftpfs programs send to one address, because PX4 answers only
    the first address that it heard (servers.md 5)."""
    return _FIRST_SOURCE_PORT + int(port_name(spec).removeprefix("\0" + _PREFIX), 16) % _SOURCE_PORTS


def take_name(name: str) -> socket.socket | None:
    """Take the name of a port; return the socket that others call, None if another program has the name."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.setblocking(False)
        sock.bind(name)
        sock.listen(_QUEUE)
    except OSError as exc:
        sock.close()
        if exc.errno == errno.EADDRINUSE:
            return None
        raise
    return sock


def connect(name: str) -> socket.socket:
    """Return a connection to the program that has the name of a port.

    Raises:
        BlockingIOError: the queue of waiting programs is full.
        OSError: no program has that name.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.setblocking(False)  # so that a full queue is an error
        sock.connect(name)
    except OSError:
        sock.close()
        raise
    return sock


def call(name: str, spec: LinkSpec) -> socket.socket | None:
    """Return a connection to the program that has a port and its name, None if there is no such program.

    Raises:
        Busy: the queue of waiting programs is full.
        LinkClosed: the program is another user's.
    """
    try:
        sock = connect(name)
    except BlockingIOError as exc:
        raise Busy(f"{spec.description}: too many programs wait for this port; try again later") from exc
    except OSError:
        return None
    if is_ours(sock):
        return sock
    pid = peer_of(sock).pid
    sock.close()
    raise LinkClosed(f"{spec.description} is claimed by process {pid} of another user; end that process")


async def next_caller(sock: socket.socket) -> socket.socket:
    """Return the next connection to a name that this program has."""
    while True:
        await trio.lowlevel.wait_readable(sock)
        try:
            return sock.accept()[0]
        except OSError:  # the caller left, or no descriptors are free
            await trio.sleep(_PAUSE)


def names_in_use() -> list[str]:
    """Return the names of all ports of this network namespace that mavftpfs programs have."""
    return sorted({"\0" + found for found in re.findall(rf"@({_PREFIX}\w+)", _NAMES.read_text())})


def peer_of(sock: socket.socket | trio.socket.SocketType) -> Peer:
    """Return the process at the other end of a Unix socket."""
    layout = struct.Struct("3i")
    return Peer(*layout.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, layout.size)))


def is_ours(sock: socket.socket) -> bool:
    """Return whether this user, or root, runs the other end, and so may share the port."""
    return peer_of(sock).uid in (0, os.getuid())
