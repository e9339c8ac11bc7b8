"""The link of a program to the hub that has the port. Layer: link.

The link is a Unix socket of whole messages (SOCK_SEQPACKET). First each side sends a JSON object: the request
to join, and the hub's reply. All others are frames: `F`, the length of a tag, the tag, and whole MAVLink
frames. The tag is the network address of their origin or destination, as JSON; the tag is empty if the port
has only one, or if the hub is to choose. From the hub, a message without frames means that the port was
reopened.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import Piece, PipeLink, Seat
from mavftpfs.link.messages import Address
from mavftpfs.link.ports import Busy, peer_of
from mavftpfs.link.uri import LinkSpec
from mavftpfs.shared.errors import LinkClosed

PROTOCOL = 3
"""Counts up when the messages change, because a hub of another version may be running."""
MAX_MESSAGE = 32 * 1024
"""Bytes of frames in a message."""
SOCKET_BUFFER = 1 << 20
WELCOME_PATIENCE = 30.0
"""Seconds for the hub to answer; the other program may have to start it first."""

_MAX_MESSAGES = 64
_RECEIVE_SIZE = 64 * 1024
_OUTBOX_LIMIT = 256 * 1024
_FRAMES = b"F"
_MAX_TAG = 255

Facts = dict[str, Any]


# -- messages -------------------------------------------------------------------------------------


def pack_facts(facts: Facts) -> bytes:
    """Return the message of a JSON object."""
    return json.dumps(facts).encode()


def unpack_facts(message: bytes) -> Facts | None:
    """Return the object of a message; None if the message holds frames, or makes no sense."""
    if message[:1] != b"{":
        return None
    try:
        facts = json.loads(message)
    except (ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) else None


@lru_cache(maxsize=256)  # bounded, because frames may arrive from any number of addresses
def _tag_of(address: NetAddress | None) -> bytes:
    tag = b"" if address is None else json.dumps(address).encode()
    return tag if len(tag) <= _MAX_TAG else b""


@lru_cache(maxsize=256)
def _address_of(tag: bytes) -> NetAddress | None:
    """Return the address of a tag, None without an address."""
    with suppress(ValueError, RecursionError):
        address = json.loads(tag)
        if isinstance(address, list) and all(isinstance(part, str | int) for part in address):
            return tuple(address)
    return None


def pack_frames(frames: Iterable[bytes], address: NetAddress | None = None) -> list[bytes]:
    """Return messages that hold frames in order, with their origin or destination."""
    tag = _tag_of(address)
    head = _FRAMES + bytes((len(tag),)) + tag
    messages, batch, size = [], [head], 0
    for frame in frames:
        if size + len(frame) > MAX_MESSAGE:
            messages.append(b"".join(batch))
            batch, size = [head], 0
        batch.append(frame)
        size += len(frame)
    messages.append(b"".join(batch))
    return messages


def unpack_frames(message: bytes) -> Piece:
    """Return the frames of a message, and its address; no frames if the message makes no sense."""
    if message[:1] != _FRAMES or len(message) < 2:
        return b"", None
    stop = 2 + message[1]
    return message[stop:], _address_of(message[2:stop])


def set_buffers(sock: socket.socket) -> None:
    """Enlarge the buffers of a hub's socket, because frames arrive in bursts."""
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER)  # the kernel caps it silently


# -- a client -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PortRequest:
    """A program's request for a port: the address that it prefers, the endpoints for `forward=`, its name for
    people. shared: use a hub, even if no other program uses the port."""

    own: Address
    forward: tuple[str, ...] = ()
    name: str = ""
    shared: bool = False

    @property
    def needs_hub(self) -> bool:
        """Whether only a hub can do that."""
        return self.shared or bool(self.forward)


class HubLink(PipeLink):
    """Implements link.base.Link between a program and the hub, at either end, until the other end closes. Run
    `run` beside the link, unless the link keeps nothing. Programs get one from `join`."""

    def __init__(self, sock: socket.socket, description: str, outbox_limit: int = 0) -> None:
        super().__init__(description, sock, outbox_limit)
        self._sock = sock

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """Hand frames to the other end; drop and count what cannot be kept. From the hub, `to` is the frames'
        origin, and an empty `frames` means that the port was reopened."""
        for message in pack_frames(frames, to):
            if self._outbox or not self._write(message, None):
                self._keep(message)

    def _take(self) -> list[Piece]:
        pieces: list[Piece] = []
        for _ in range(_MAX_MESSAGES):
            try:
                message = self._sock.recv(_RECEIVE_SIZE)
            except BlockingIOError:
                break
            except OSError:
                message = b""
            if not message:
                self._closed = True
                self._drop_pipe()
                break
            pieces.append(unpack_frames(message))
        return pieces

    def _write(self, data: bytes, to: NetAddress | None) -> int:
        try:
            self._sock.send(data)
        except BlockingIOError:
            return 0
        except OSError:  # the other end is gone; the receiver notices
            self.stats.dropped_sends += 1
            return len(data)
        self.stats.sent_bytes += len(data)
        return len(data)


async def join(sock: socket.socket, spec: LinkSpec, wanted: PortRequest, seat: Seat | None) -> HubLink:
    """Ask the program at the other end of a socket for a share of the port; return the link once the hub
    grants it.

    seat: the seat until now.

    Raises:
        Busy: the other program ended, or is about to start the hub: call again.
        LinkClosed: the hub refuses, and the text gives the reason; or the other program does not answer.
    """
    hello = {
        "protocol": PROTOCOL,
        "join": spec.description,
        "own": wanted.own if seat is None else seat.own,
        "number": None if seat is None else seat.number,
        "forward": wanted.forward,
        "name": wanted.name,
    }
    try:
        set_buffers(sock)
        tell(sock, hello)
        reply = await hear(sock, WELCOME_PATIENCE)
        if reply is None:
            raise LinkClosed(
                f"{spec.description}: process {peer_of(sock).pid} has this port and does not answer; end it"
            )
        if "refused" in reply:
            raise LinkClosed(str(reply["refused"]))
        if "own" not in reply:
            raise Busy(f"{spec.description}: the program that had this port ended")
        link = HubLink(sock, spec.description, _OUTBOX_LIMIT)
        link.seat = Seat(Address(*reply["own"]), reply["number"])
        return link
    except BaseException:
        sock.close()
        raise


def tell(sock: socket.socket, facts: Facts) -> None:
    """Send facts, if the other end is still there."""
    with suppress(OSError):
        sock.send(pack_facts(facts))


async def hear(sock: socket.socket, patience: float) -> Facts | None:
    """Return the next facts of the other end: none if it ended or sends nonsense, None if it sends nothing
    for so many seconds."""
    with trio.move_on_after(patience):
        await trio.lowlevel.wait_readable(sock)
        try:
            return unpack_facts(sock.recv(_RECEIVE_SIZE)) or {}
        except OSError:
            return {}
    return None
