"""How programs of one user find each other by the port they want. Layer: link.

A program that has a port open also has its *door* open: a Unix socket in the user's private directory, named
after the port. A second program that wants the port knocks there. A door is only a listening socket, so a hub
that takes over inherits it with all programs that wait there.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

import trio

from mavftpfs.shared.private import own_directories, private_directory

HUB = ".hub"
ALONE = ".port"
"""The end of a door's name tells what is behind it: a hub, or a program that has the port alone."""

_QUEUE = 64
_LOCK_PATIENCE = 30.0
_LOCK_PAUSE = 0.05


def knock(name: str) -> socket.socket | None:
    """Return a connection to the program that has a port, None if none of ours has."""
    for path in [directory / (name + end) for directory in own_directories() for end in (HUB, ALONE)]:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.setblocking(False)  # the queue of a program that was stopped may be full
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
