"""The mount's side of the control socket (client.control has the commands' side). Layer: mount.

Each client sends one line and receives one line, which ends the connection. After a line that asks for
`files` the messages of client.wire follow, which mount.fileserver answers. The mount needs file descriptors
for itself, so it serves only MAX_CLIENTS clients at once, and disconnects a client that sends nothing.
Clients that use files do not count, so `status` and `umount` always get an answer.
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
from mavftpfs.link.ports import peer_of
from mavftpfs.mount.fileserver import FileServer
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.control")

Command = Callable[[Reply], Awaitable[Reply]]

ASKING_PATIENCE = 2.0
"""Seconds for a client to send its line; a command sends it right after it has connected."""
REPLY_PATIENCE = 10.0
"""Seconds to send the reply."""
QUEUE = 128
"""Clients that may wait in the kernel's queue."""
MAX_CLIENTS = 8
"""Clients that are served at once; others wait in the kernel's queue."""
_NO_DESCRIPTORS = frozenset((errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM))
_PAUSE = 0.1
"""Seconds until the next attempt to accept a connection, after no descriptor was free."""


class ControlServer:
    """Answers requests at a socket path: one `command` after its name, and those for files."""

    def __init__(
        self,
        path: Path,
        commands: Mapping[str, Command],
        *,
        files: FileServer | None = None,
        refusal: Callable[[int], str] = lambda uid: "",
        mode: int = 0o600,
    ) -> None:
        """refusal: returns the reason why a user (by number) is refused, or "". mode: of the socket. A
        command finds the number of the user in its request, as `uid`."""
        self.path = path
        self.files = files
        self._commands = commands
        self._refusal = refusal
        self._mode = mode
        self._accepting = trio.CancelScope()
        self._room = trio.Semaphore(MAX_CLIENTS)
        self._is_short = False
        self.closed = trio.Event()

    async def run(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Serve until `close`, then until the present clients have their replies.

        Raises:
            OSError: the socket cannot be bound.
        """
        listener = _bind(self.path, self._mode)
        ours = self.path.lstat().st_ino
        try:
            async with trio.open_nursery() as clients:
                task_status.started()
                with self._accepting:
                    await self._accept(listener, clients)
                listener.socket.close()
        finally:
            with suppress(OSError):  # the next mount may have bound its socket there meanwhile
                if self.path.lstat().st_ino == ours:
                    self.path.unlink()
            self.closed.set()

    def close(self) -> None:
        """Accept no more clients."""
        self._accepting.cancel()

    async def _accept(self, listener: trio.SocketListener, nursery: trio.Nursery) -> None:
        """Accept clients until cancelled, as many as there is room for."""
        while True:
            await self._room.acquire()
            nursery.start_soon(self._serve_client, await self._next(listener))

    async def _next(self, listener: trio.SocketListener) -> trio.SocketStream:
        """Return the next connection. Log once per mount that no descriptor was free for one."""
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
            with suppress(
                trio.BrokenResourceError, trio.ClosedResourceError
            ):  # the client may leave at any time
                try:
                    wants_files, process = await self._serve_line(stream)
                finally:
                    self._room.release()
                if wants_files and self.files is not None:
                    await self.files.serve(stream, process)
        finally:
            await trio.aclose_forcefully(stream)

    async def _serve_line(self, stream: trio.SocketStream) -> tuple[bool, int]:
        """Answer a client's line. Return whether it gets files, and its process."""
        peer = peer_of(stream.socket)
        line = b""
        with trio.move_on_after(ASKING_PATIENCE):
            line = await _receive_line(stream)
        reply, wants_files = await self._answer(line, peer.uid)
        with trio.move_on_after(REPLY_PATIENCE):
            await stream.send_all(json.dumps(reply, default=str).encode() + b"\n")
        return wants_files, peer.pid

    async def _answer(self, line: bytes, uid: int) -> tuple[Reply, bool]:
        """Return the reply to a line, and whether it asks for files and gets them."""
        try:
            request = json.loads(line)
            name = request["command"]
            command = self._commands[name]
        except (ValueError, KeyError, TypeError, RecursionError):  # the last for a line of many brackets
            return failure("not a command of this mount"), False
        refused = self._refusal(uid)
        if refused:
            return failure(refused), False
        try:
            return {"ok": True, **await command({**request, "uid": uid})}, name == "files"
        except MavftpfsError as exc:
            return failure(str(exc)), False
        except Exception as exc:
            log.exception("bug in a control command")
            return failure(f"internal error: {exc!r}"), False


def _bind(path: Path, mode: int) -> trio.SocketListener:
    """Bind and listen; the socket is never visible with wider permissions than `mode`."""
    path.unlink(missing_ok=True)  # left by a mount that was killed; a living one was refused before
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    mask = os.umask(0o777 & ~mode)
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
    """Return the reply of a failed command."""
    return {"ok": False, "error": reason}


async def _receive_line(stream: trio.SocketStream) -> bytes:
    line = b""
    while b"\n" not in line and len(line) < MAX_LINE:
        data = await stream.receive_some(4096)
        if not data:
            break
        line += data
    return line.partition(b"\n")[0]
