"""How programs of one user find each other by the port they want. Layer: link.

A program that has a port open also has its *door* open: a Unix socket in the user's private directory, named
after the port. A second program that wants the port knocks there. A door is only a listening socket, so a hub
that takes over inherits it with all programs that wait there.
"""

from __future__ import annotations

import errno
import hashlib
import ipaddress
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

import trio

from mavftpfs.link.uri import LOOPBACK, LinkKind, LinkSpec
from mavftpfs.shared.private import own_directories, private_directory

HUB = ".hub"
ALONE = ".port"
"""The end of a door's name tells what is behind it: a hub, or a program that has the port alone."""

_ANYWHERE = {"0.0.0.0", "::"}
_LISTENING = {LinkKind.UDP_OUT: LinkKind.UDP_IN, LinkKind.TCP_OUT: LinkKind.TCP_IN}
_QUEUE = 64
_NETWORK = "/proc/self/ns/net"
_LOCK_PATIENCE = 30.0
_LOCK_PAUSE = 0.05


def port_name(spec: LinkSpec) -> str:
    """Return the name of a port's door, without its end; the same for two SOURCEs that exclude each other."""
    if spec.kind is LinkKind.SERIAL:
        text = f"serial {os.path.realpath(spec.device)}"
    else:
        listens = spec.kind in (LinkKind.UDP_IN, LinkKind.TCP_IN)
        text = f"{os.stat(_NETWORK).st_ino} {spec.kind.value} {'' if listens else spec.host} {spec.port}"
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def same_link(one: LinkSpec, other: LinkSpec) -> bool:
    """Return whether two SOURCEs cannot be open at once, because they are the same link."""
    if one.kind is not other.kind:
        return False
    if one.kind is LinkKind.SERIAL:
        return os.path.realpath(one.device) == os.path.realpath(other.device)
    if one.port != other.port:
        return False
    listens = one.kind in (LinkKind.UDP_IN, LinkKind.TCP_IN)
    return one.host == other.host or (listens and bool({one.host, other.host} & _ANYWHERE))


def leads_back(endpoint: LinkSpec, source: LinkSpec) -> bool:
    """Return whether frames for an endpoint would be SOURCE's own: it is the same link, or one of them sends
    to where the other listens."""
    return same_link(endpoint, source) or _reaches(endpoint, source) or _reaches(source, endpoint)


def _reaches(one: LinkSpec, other: LinkSpec) -> bool:
    """Return whether one link sends to where the other listens."""
    if _LISTENING.get(one.kind) is not other.kind or one.port != other.port:
        return False
    host = LOOPBACK if one.host == "localhost" else one.host
    return host == other.host or (other.host in _ANYWHERE and _is_here(host))


def _is_here(host: str) -> bool:
    """Return whether a numeric address is one of this computer's."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.bind((str(ipaddress.ip_address(host)), 0))
        except (OSError, ValueError):
            return False
        return True


def knock(name: str) -> socket.socket | None:
    """Return a connection to the program that has a port, None if none of ours has."""
    for path in [directory / (name + end) for directory in own_directories() for end in (HUB, ALONE)]:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            sock.connect(str(path))
        except OSError:
            sock.close()
        else:
            if peer_uid(sock) == os.getuid():
                return sock
            sock.close()
    return None


def hubs() -> list[Path]:
    """Return the doors of all hubs of this user, the dead ones too."""
    found: list[Path] = []
    for directory in own_directories():
        with suppress(OSError):
            found += [directory / name for name in sorted(os.listdir(directory)) if name.endswith(HUB)]
    return found


def peer_uid(sock: socket.socket) -> int:
    """Return the user id of the process at the other end of a Unix socket."""
    layout = struct.Struct("3i")
    _, uid, _ = layout.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, layout.size))
    return int(uid)


class Door:
    """A listening socket at its place in the file system.

    Attributes:
        sock: the socket, non-blocking.
    """

    def __init__(self, sock: socket.socket, path: Path) -> None:
        self.sock = sock
        self._path = path
        self._ours = path.lstat().st_ino

    async def knocked(self) -> None:
        """Wait until another program connects."""
        await trio.lowlevel.wait_readable(self.sock)

    def accept(self) -> socket.socket | None:
        """Return a connection of this user's; None if there is none (any more)."""
        try:
            sock, _ = self.sock.accept()
        except OSError:
            return None
        if peer_uid(sock) != os.getuid():
            sock.close()
            return None
        return sock

    def turn_away(self) -> None:
        """Close the connections of all programs that wait."""
        while (sock := self.accept()) is not None:
            sock.close()

    def is_hubs(self) -> None:
        """Make its name say that a hub is behind it."""
        path = self._path.with_suffix(HUB)
        self._path.rename(path)
        self._path = path

    def leave(self) -> None:
        """Another process has it now: close it here, and leave it at its place."""
        self._ours = -1
        self.sock.close()

    def remove(self) -> None:
        """Take it out of the file system, and close it."""
        with suppress(OSError):
            if self._path.lstat().st_ino == self._ours:  # else it is another program's by now
                self._path.unlink()
        self.sock.close()


def open_door(name: str) -> Door | None:
    """Make the door of a port that we have opened; None where there is no place for it."""
    directory = private_directory(own_directories(), longest_name=len(name) + len(ALONE))
    if directory is None:
        return None
    path = directory / (name + ALONE)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    mask = os.umask(0o177)
    try:
        for left in (path, path.with_suffix(HUB)):
            left.unlink(missing_ok=True)  # of a program that was killed
        sock.setblocking(False)
        sock.bind(str(path))
        sock.listen(_QUEUE)
        return Door(sock, path)
    except OSError:
        sock.close()
        return None
    finally:
        os.umask(mask)


async def only_one(name: str) -> socket.socket:
    """Wait until no other program is about to open a port; return what keeps others out until it is closed.

    It is a name in the abstract namespace, so it goes away with its process. After a long wait we go on:
    then the port itself decides.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    deadline = trio.current_time() + _LOCK_PATIENCE
    while True:
        try:
            sock.bind(f"\0mavftpfs {os.getuid()} {name}")
            return sock
        except OSError as exc:
            if exc.errno != errno.EADDRINUSE or trio.current_time() > deadline:
                return sock
        await trio.sleep(_LOCK_PAUSE)
