"""The link of a program to the hub that has the port. Layer: link.

A Unix socket of whole messages (SOCK_SEQPACKET). Those that begin with `{` are JSON objects: the request to
join, the hub's reply, and the few that change something later. All others are frames: `F`, the length of a
tag, the tag, and whole MAVLink frames. The tag is the network address that they came from, as JSON, or
nothing where the port has only one.
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
from mavftpfs.link.base import Seat, SocketLink
from mavftpfs.link.messages import Address
from mavftpfs.link.ports import Busy, peer_of
from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed

PROTOCOL = 2
"""Counts up when the messages change: a hub of another version may be running."""
MAX_MESSAGE = 32 * 1024
"""Bytes of frames in a message."""
SOCKET_BUFFER = 1 << 20
WELCOME_PATIENCE = 30.0
"""Seconds for the hub, which may have to be started first, to answer."""

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
    """Return the object of a message; None if it holds frames, or makes no sense."""
    if message[:1] != b"{":
        return None
    try:
        facts = json.loads(message)
    except (ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) else None


def as_address(value: object) -> NetAddress | None:
    """Return the network address that a fact is, None if it is none: host, port, and more for IPv6."""
    match value:
        case [str(), int(port), *rest] if port in range(1 << 16) and all(type(one) is int for one in rest):
            return tuple(value)
    return None


@lru_cache(maxsize=256)  # bounded: frames may come from any number of addresses
def make_tag(address: NetAddress | None) -> bytes:
    """Return the tag of an address."""
    tag = b"" if address is None else json.dumps(address).encode()
    return tag if len(tag) <= _MAX_TAG else b""


@lru_cache(maxsize=256)
def _address_of(tag: bytes) -> NetAddress | None:
    """Return the address of a tag."""
    return tuple(json.loads(tag)) if tag else None


def pack_frames(frames: Iterable[bytes], tag: bytes = b"") -> list[bytes]:
    """Return messages that hold the frames in order."""
    head = _FRAMES + bytes((len(tag),)) + tag
    messages, batch, size = [], [head], 0
    for frame in frames:
        if size + len(frame) > MAX_MESSAGE:
            messages.append(b"".join(batch))
            batch, size = [head], 0
        batch.append(frame)
        size += len(frame)
    if size:
        messages.append(b"".join(batch))
    return messages


def unpack_frames(message: bytes) -> tuple[bytes, bytes]:
    """Return the tag of a message, and the frames."""
    stop = 2 + message[1] if len(message) > 1 else len(message)
    return message[2:stop], message[stop:]


def set_buffers(sock: socket.socket) -> None:
    """Give a socket of the hub room for what comes at once."""
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER)  # the kernel caps it silently


# -- a client -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Wish:
    """What a program wants of a port: the address that it would like, the endpoints for `forward=`, its name
    for people. beats: it wants only heartbeats."""

    own: Address
    forward: tuple[str, ...] = ()
    name: str = ""
    beats: bool = False

    @property
    def needs_hub(self) -> bool:
        """Whether it wants what only a hub does, even if no other program wants the port."""
        return self.beats or bool(self.forward)


class HubLink(SocketLink):
    """Implements link.base.Link by a hub. Made by `join`; run `run_writer` beside it.

    Attributes:
        gone: the hub has ended, or we left it.
    """

    def __init__(self, sock: socket.socket, spec: LinkSpec, welcome: Facts) -> None:
        super().__init__(sock, spec.description, _OUTBOX_LIMIT)
        self.is_serial = spec.kind is LinkKind.SERIAL
        self.seat = Seat(Address(*welcome["own"]), welcome["number"])
        self.gone = trio.Event()
        self._senders: list[NetAddress | None] = []
        self._reopened = False

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """Hand frames to the hub; drop and count what cannot be kept."""
        for message in pack_frames(frames):
            if self._outbox.size or not self._write(message):
                self._keep(message)

    def sender(self, index: int) -> NetAddress | None:
        """Return the network address that a piece of the last batch came from."""
        return self._senders[index]

    def answer(self, address: NetAddress) -> None:
        """From now on the hub sends our frames to this address."""
        self.tell({"answer": address})

    def focus(self, system: int) -> None:
        """Have the hub leave out what concerns only other systems."""
        self.tell({"focus": system})

    def tell(self, facts: Facts) -> None:
        """Send a request that needs no answer."""
        message = pack_facts(facts)
        if self._outbox.size or not self._write(message):
            self._keep(message, force=True)

    def _close(self) -> None:
        super()._close()
        self.gone.set()

    def _drain(self) -> list[bytes] | None:
        if self._reopened:
            self._reopened = False
            return []
        pieces: list[bytes] = []
        senders: list[NetAddress | None] = []
        for _ in range(_MAX_MESSAGES):
            message = self._next()
            if message is None:
                break
            if message[:1] == _FRAMES:
                tag, piece = unpack_frames(message)
                pieces.append(piece)
                senders.append(_address_of(tag))
            elif (unpack_facts(message) or {}).get("reopened"):
                if not pieces:
                    return []
                self._reopened = True  # what came before goes first
                break
        if not pieces:
            return None
        self._senders = senders
        self.stats.received_bytes += sum(map(len, pieces))
        return pieces

    def _next(self) -> bytes | None:
        """Return the next message, if there is one; notice that the hub is gone."""
        if self._closed:
            return None
        try:
            message = self._sock.recv(_RECEIVE_SIZE)
        except BlockingIOError:
            return None
        except OSError:
            message = b""
        if not message:
            self._close()
        return message or None

    def _write(self, item: bytes) -> int:
        if self._closed:
            self.stats.dropped_sends += 1
            return len(item)
        try:
            self._sock.send(item)
        except BlockingIOError:
            return 0
        except OSError:
            self._close()
            return len(item)
        self.stats.writes += 1
        self.stats.sent_bytes += len(item)
        return len(item)


class Refused(LinkClosed):
    """The hub does not take us; the text says why."""


async def join(
    sock: socket.socket, spec: LinkSpec, wish: Wish, seat: Seat | None, *, again: bool = False
) -> HubLink:
    """Ask the program at the other end of a socket to be let in, and return the link once that is a hub.

    seat: what we had until now. again: we had the port before, so the endpoints may take their time.

    Raises:
        Refused: and why.
        Busy: it ended, or is about to start the hub: call again.
        LinkClosed: it does not answer.
    """
    hello = {
        "protocol": PROTOCOL,
        "join": spec.description,
        "own": wish.own if seat is None else seat.own,
        "number": None if seat is None else seat.number,
        "forward": wish.forward,
        "name": wish.name,
        "beats": wish.beats,
        "again": again,
    }
    try:
        set_buffers(sock)
        tell(sock, hello)
        reply = await hear(sock, WELCOME_PATIENCE)
        if reply is None:
            raise LinkClosed(
                f"{spec.description}: process {peer_of(sock).pid} has this port and does not answer"
            )
        if "refused" in reply:
            raise Refused(str(reply["refused"]))
        if "own" not in reply:
            raise Busy(f"{spec.description}: the program that had this port ended")
        return HubLink(sock, spec, reply)
    except BaseException:
        sock.close()
        raise


def tell(sock: socket.socket, facts: Facts) -> None:
    """Send facts, if the other end is still there."""
    with suppress(OSError):
        sock.send(pack_facts(facts))


async def hear(sock: socket.socket, patience: float) -> Facts | None:
    """Return the facts that the other end sends next: none if it ended or sends nonsense, None if it says
    nothing for so many seconds."""
    with trio.move_on_after(patience):
        await trio.lowlevel.wait_readable(sock)
        try:
            return unpack_facts(sock.recv(_RECEIVE_SIZE)) or {}
        except OSError:
            return {}
    return None
