"""The mount's side of the control socket (`control` has the commands' side). Layer: client.

The mount needs file descriptors for itself. So at most MAX_CLIENTS connections are taken at once, and one
that asks nothing is ended.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from pathlib import Path

import trio

from mavftpfs.client.control import MAX_LINE, Reply
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.control")

Command = Callable[[Reply], Awaitable[Reply]]

ASKING_PATIENCE = 2.0
"""Seconds for a client to send its line: a command of ours asks right after it has connected."""
REPLY_PATIENCE = 10.0
"""Seconds for us to hand it the reply."""
QUEUE = 128
"""Clients that wait in the kernel until they are taken."""
MAX_CLIENTS = 8
"""Connections that are taken at once; others wait in the kernel's queue."""
_NO_DESCRIPTORS = frozenset((errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM))
_PAUSE = 0.1
"""Seconds until a connection is taken after there was no descriptor for it."""


class ControlServer:
    """Answers requests at a socket path: one `command` after its name."""

    def __init__(self, path: Path, commands: Mapping[str, Command]) -> None:
        self._path = path
        self._commands = commands
        self._accepting = trio.CancelScope()
        self._room = trio.Semaphore(MAX_CLIENTS)
        self._is_short = False
        self.closed = trio.Event()

    async def run(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Serve until `close`, then until the clients at work have their replies.

        Raises:
            OSError: the socket cannot be bound.
        """
        listener = _bind(self._path)
        ours = self._path.lstat().st_ino
        try:
            async with trio.open_nursery() as clients:
                task_status.started()
                with self._accepting:
                    async with listener:
                        await self._accept(listener, clients)
        finally:
            with suppress(FileNotFoundError):
                # While we delivered, the next mount may have put its socket there.
                if self._path.lstat().st_ino == ours:
                    self._path.unlink()
            self.closed.set()

    def close(self) -> None:
        """Take no more clients."""
        self._accepting.cancel()

    async def _accept(self, listener: trio.SocketListener, nursery: trio.Nursery) -> None:
        """Take clients until cancelled, as many as there is room for."""
        while True:
            await self._room.acquire()
            nursery.start_soon(self._serve_client, await self._next(listener))

    async def _next(self, listener: trio.SocketListener) -> trio.SocketStream:
        """Return the next connection. The log says once in a mount that there was no descriptor for one."""
        while True:
            try:
                return await listener.accept()
            except OSError as error:
                if error.errno not in _NO_DESCRIPTORS:
                    raise
                if not self._is_short:
                    self._is_short = True
                    log.warning("no descriptor is left for a command (%s)", os.strerror(error.errno))
                await trio.sleep(_PAUSE)

    async def _serve_client(self, stream: trio.SocketStream) -> None:
        try:
            with suppress(trio.BrokenResourceError, trio.ClosedResourceError):  # it may go away at any time
                line = b""
                with trio.move_on_after(ASKING_PATIENCE):
                    line = await _receive_line(stream)
                reply = await self._answer(line)
                with trio.move_on_after(REPLY_PATIENCE):
                    await stream.send_all(json.dumps(reply, default=str).encode() + b"\n")
        finally:
            self._room.release()
            await trio.aclose_forcefully(stream)

    async def _answer(self, line: bytes) -> Reply:
        try:
            request = json.loads(line)
            command = self._commands[request["command"]]
        except (ValueError, KeyError, TypeError, RecursionError):  # the last for a line of many brackets
            return failure("not a command of this mount")
        try:
            return {"ok": True, **await command(request)}
        except MavftpfsError as exc:
            return failure(str(exc))
        except Exception as exc:
            log.exception("bug in a control command")
            return failure(f"internal error: {exc!r}")


def _bind(path: Path) -> trio.SocketListener:
    """Bind and listen; the socket is never visible with wider permissions than 0600."""
    path.unlink(missing_ok=True)  # of a mount that was killed; a living one was refused before
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    mask = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen(QUEUE)
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(mask)
    return trio.SocketListener(trio.socket.from_stdlib_socket(listener))


def failure(reason: str) -> Reply:
    """Return the reply of a command that did not work."""
    return {"ok": False, "error": reason}


async def _receive_line(stream: trio.SocketStream) -> bytes:
    line = b""
    while b"\n" not in line and len(line) < MAX_LINE:
        data = await stream.receive_some(4096)
        if not data:
            break
        line += data
    return line.partition(b"\n")[0]
