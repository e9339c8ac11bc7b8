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
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import trio

from mavftpfs.shared.errors import LinkClosed
from mavftpfs.shared.private import MODE, own_directories, private_directory

HUB = ".hub"
ALONE = ".port"
"""The end of a door's name tells what is behind it: a hub, or a program that has the port alone."""

SILENT = "the program that has the port does not answer; see: mavftpfs hub"

_QUEUE = 64
_LARGEST = 65536
_LOCK_PATIENCE = 30.0
_PAUSE = 0.05


class Busy(LinkClosed):
    """The port is taken. In a moment it may be free, or shared."""


def knock(name: str) -> socket.socket | None:
    """Return a connection to the program that has a port, None if none of ours has.

    Raises:
        Busy: it has the port, and does not answer.
    """
    for path in [directory / (name + end) for directory in own_directories() for end in (HUB, ALONE)]:
        sock = knock_at(path)
        if sock is not None:
            return sock
    return None


def knock_at(door: Path) -> socket.socket | None:
    """Return a connection to the program of this user behind a door, None if there is none.

    Raises:
        Busy: as many programs wait there as can.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sock.setblocking(False)  # so that a full queue is an error
    try:
        sock.connect(os.fspath(door))
        if peer_uid(sock) == os.getuid():
            return sock
    except BlockingIOError as exc:
        sock.close()
        raise Busy(SILENT) from exc
    except OSError:
        pass  # of a program that was killed
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
        self._inode: int | None = path.lstat().st_ino

    async def knocked(self) -> None:
        """Wait until another program connects."""
        await trio.lowlevel.wait_readable(self.sock)

    async def accept(self) -> socket.socket:
        """Return the next connection of this user's."""
        while True:
            await self.knocked()
            sock = self._next()
            if sock is not None:
                return sock
            await trio.sleep(_PAUSE)  # it was another user, or no descriptors are left

    def turn_away(self, words: bytes) -> None:
        """Tell all programs that wait why they cannot come in."""
        while (sock := self._next()) is not None:
            with sock, suppress(OSError):
                sock.setblocking(False)
                sock.recv(_LARGEST)  # closed with something unread, the kernel would drop our words
                sock.send(words)

    def is_hubs(self) -> None:
        """Make its name say that a hub is behind it."""
        path = self._path.with_suffix(HUB)
        self._path.rename(path)
        self._path = path

    def leave(self) -> None:
        """Close it here, and leave it at its place: another process has it now."""
        self._inode = None
        self.sock.close()

    def remove(self) -> None:
        """Take it out of the file system, unless another program's is there by now, and close it."""
        with suppress(OSError):
            if self._path.lstat().st_ino == self._inode:
                self._path.unlink()
        self.sock.close()

    def _next(self) -> socket.socket | None:
        try:
            sock, _ = self.sock.accept()
        except OSError:
            return None
        if peer_uid(sock) == os.getuid():
            return sock
        sock.close()
        return None


def open_door(name: str) -> Door:
    """Make the door of a port that we have opened.

    Raises:
        LinkClosed: there is no place for it.
    """
    problem = "no directory is yours alone"
    for directory in own_directories():
        if private_directory([directory], longest_name=len(name) + len(ALONE)) is not None:
            try:
                return _made_in(directory, name)
            except OSError as exc:
                problem = f"{directory}: {exc.strerror}"
    remedy = "set XDG_RUNTIME_DIR to a directory that only you can read"
    raise LinkClosed(f"no place for the hub's socket ({problem}); {remedy}")


def _made_in(directory: Path, name: str) -> Door:
    path = directory / (name + ALONE)
    for left in (path, path.with_suffix(HUB)):
        left.unlink(missing_ok=True)  # of a program that was killed
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.setblocking(False)
        sock.bind(os.fspath(path))
        path.chmod(MODE)  # before it listens; the umask would be that of all threads
        sock.listen(_QUEUE)
        return Door(sock, path)
    except BaseException:
        sock.close()
        raise


@asynccontextmanager
async def only_one(name: str) -> AsyncIterator[None]:
    """Keep other programs from opening a port for the length of the body; waits until no other one does so.

    It is a name in the abstract namespace, so it goes away with its process. After a long wait we go on:
    then the port itself decides.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        deadline = trio.current_time() + _LOCK_PATIENCE
        while not _takes_name(sock, f"\0mavftpfs {os.getuid()} {name}"):
            if trio.current_time() > deadline:
                break
            await trio.sleep(_PAUSE)
        yield


def _takes_name(sock: socket.socket, name: str) -> bool:
    try:
        sock.bind(name)
    except OSError as exc:
        return exc.errno != errno.EADDRINUSE
    return True
