"""The files of a mount that is up, by connections to its process (client.wire). Layer: client."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.client import wire
from mavftpfs.client.control import MAX_LINE, Refused, granted
from mavftpfs.client.mounts import Status
from mavftpfs.client.wire import Facts, Message
from mavftpfs.shared.errors import LinkClosed, NotFound, RemoteProtocolError
from mavftpfs.shared.model import ROOT, normalise
from mavftpfs.shared.readable import name_text

SENDING_TIME = 10.0
"""Seconds for the mount's process to take a request; it always reads."""
_PIECE = 256 * 1024
"""Bytes to receive at once."""

Dial = Callable[[], Awaitable["Connection"]]


class Connection:
    """One connection to a mount's process. mountpoint: for people."""

    def __init__(self, stream: trio.SocketStream, mountpoint: str) -> None:
        self._stream = stream
        self._mountpoint = mountpoint
        self._replies = wire.replies()
        self._unanswered = 0
        self._asking = trio.Lock()
        self.broken = False

    async def ask(self, call: str, facts: Facts, data: bytes | memoryview = b"") -> Message:
        """Return the reply to a request. If the task is cancelled, the next request cancels this one.

        Raises:
            LinkClosed: the mount is gone. Otherwise as the call of Files or File.
        """
        async with self._asking:
            with self._gone():
                # Always whole, because a part of a request would make the next one unreadable.
                with trio.move_on_after(SENDING_TIME, shield=True) as patience:
                    await self._stream.send_all(wire.encoded({"call": call, **facts}, data))
                if patience.cancelled_caught:
                    raise LinkClosed(f"the process of the mount on {self._mountpoint} does not answer")
                self._unanswered += 1
                while self._unanswered:
                    reply = await self._next()
                    self._unanswered -= 1
        if "error" in reply.facts:
            raise wire.error_from(reply)
        return reply

    async def _next(self) -> Message:
        while True:
            reply = self._replies.next()
            if reply is not None:
                return reply
            data = await self._stream.receive_some(_PIECE)
            if not data:
                raise trio.BrokenResourceError
            self._replies.feed(data)

    @contextmanager
    def _gone(self) -> Iterator[None]:
        try:
            yield
        except (trio.BrokenResourceError, trio.ClosedResourceError, RemoteProtocolError) as exc:
            self.close()
            raise LinkClosed(f"the mount on {self._mountpoint} is gone") from exc
        except LinkClosed:
            self.close()
            raise

    @property
    def idle(self) -> bool:
        """Whether the connection can take another request."""
        return not self.broken and not self._unanswered

    def close(self) -> None:
        """End the connection. The mount's process discards the changes that were written over it and not
        released."""
        self.broken = True
        self._stream.socket.close()


async def connect(status: Status, mountpoint: str) -> Connection:
    """Connect to a mount's process. mountpoint: for people.

    Raises:
        LinkClosed: the mount is gone, was replaced by another one, or refuses.
    """
    gone = f"the mount on {mountpoint} is gone"
    try:
        stream = await trio.open_unix_socket(status["socket"])
    except OSError:
        raise LinkClosed(gone) from None  # the errno is the socket's, and would pass for a file's
    try:
        request = {"command": "files", "version": wire.VERSION}
        await stream.send_all(json.dumps(request).encode() + b"\n")
        line = b""
        while not line.endswith(b"\n") and len(line) < MAX_LINE:
            data = await stream.receive_some(4096)
            if not data:
                raise trio.BrokenResourceError
            line += data
        reply = granted(json.loads(line))
    except BaseException as exc:
        stream.socket.close()
        if isinstance(exc, Refused):
            raise LinkClosed(f"the mount on {mountpoint}: {exc}") from exc
        if isinstance(exc, trio.BrokenResourceError | ValueError):
            raise LinkClosed(gone) from exc
        raise
    if reply["id"] != status["id"]:
        stream.socket.close()
        raise LinkClosed(f"{gone}, and there is another one now")
    return Connection(stream, mountpoint)


class MountFiles:
    """Implements client.files.Files. Paths are below `root`, a directory of the vehicle; `mounted` is the
    directory at the mount's root."""

    def __init__(self, dial: Dial, mountpoint: str, mounted: bytes, root: bytes) -> None:
        self._dial = dial
        self._mountpoint = mountpoint
        self._mounted = mounted.rstrip(b"/")
        self._root = root.rstrip(b"/")
        self._idle: list[Connection] = []
        self._of_files: set[Connection] = set()

    def close(self) -> None:
        """End all connections."""
        for connection in (*self._idle, *self._of_files):
            connection.close()

    async def status(self) -> dict[str, Any]:
        """Return the facts of `status --json`. Raises: LinkClosed."""
        status: dict[str, Any] = (await self._ask("status")).facts["status"]
        return status

    async def stat(self, path: bytes) -> Stat:
        """See Files."""
        return wire.stat_from((await self._ask("stat", path)).facts["stat"])

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """See Files."""
        return wire.entries_from((await self._ask("list", path)).data)

    async def crc32(self, path: bytes) -> int:
        """See Files."""
        return int((await self._ask("crc32", path)).facts["crc32"])

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, append: bool = False
    ) -> MountFile:
        """See Files."""
        return await self._open("open", path, {"write": write, "truncate": truncate, "append": append})

    async def create(self, path: bytes, *, exclusive: bool) -> MountFile:
        """See Files."""
        return await self._open("create", path, {"exclusive": exclusive})

    async def mkdir(self, path: bytes) -> None:
        """See Files."""
        await self._ask("mkdir", path)

    async def rmdir(self, path: bytes) -> None:
        """See Files."""
        await self._ask("rmdir", path)

    async def unlink(self, path: bytes) -> None:
        """See Files."""
        await self._ask("unlink", path)

    async def rename(self, old: bytes, new: bytes) -> None:
        """See Files."""
        await self._ask("rename", old, {"new": wire.text(self._place(new))})

    async def refresh(self) -> None:
        """See Files."""
        await self._ask("refresh")

    async def _ask(self, call: str, path: bytes = ROOT, facts: Facts | None = None) -> Message:
        """Send a request over a connection without an open file."""
        place = wire.text(self._place(path)) if call not in ("refresh", "status") else "/"
        connection = self._idle.pop() if self._idle else await self._dial()
        try:
            return await connection.ask(call, {"path": place, **(facts or {})})
        finally:
            if connection.idle:
                self._idle.append(connection)
            else:
                connection.close()

    async def _open(self, call: str, path: bytes, facts: Facts) -> MountFile:
        place = wire.text(self._place(path))
        connection = await self._dial()
        try:
            reply = await connection.ask(call, {"path": place, **facts})
        except BaseException:
            connection.close()
            raise
        self._of_files.add(connection)
        return MountFile(connection, reply.facts["size"], self._of_files.discard)

    def _place(self, path: bytes) -> bytes:
        """Return the mount's path for a path."""
        remote = normalise(self._root + b"/" + path)
        if remote != (self._mounted or ROOT) and not remote.startswith(self._mounted + b"/"):
            raise NotFound(
                f"{name_text(remote)} lies outside of {name_text(self._mounted)}, which is mounted on "
                f"{self._mountpoint}"
            )
        return remote[len(self._mounted) :] or ROOT


class MountFile:
    """Implements client.files.File: an open file and its connection. forget: called when the file is closed.

    Attributes:
        size, verified: see File.
    """

    def __init__(self, connection: Connection, size: int, forget: Callable[[Connection], None]) -> None:
        self.size = size
        self.verified = ""
        self._connection = connection
        self._forget = forget
        self._released = False

    async def read(self, offset: int, size: int) -> bytes:
        """See File."""
        parts: list[bytes] = []
        while size > 0:
            wanted = min(size, wire.BLOCK)
            data = (await self._ask("read", {"at": offset, "size": wanted})).data
            parts.append(data)
            offset, size = offset + len(data), size - len(data)
            if len(data) < wanted:
                break
        return parts[0] if len(parts) == 1 else b"".join(parts)

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """See File."""
        view = memoryview(data)
        for start in range(0, len(view), wire.BLOCK):
            await self._ask("write", {"at": offset + start}, view[start : start + wire.BLOCK])
        return len(view)

    async def truncate(self, size: int) -> None:
        """See File."""
        await self._ask("resize", {"size": size})

    async def fsync(self) -> None:
        """See File."""
        self.verified = (await self._ask("fsync")).facts["verified"]

    async def release(self) -> None:
        """See File."""
        if self._released:
            return
        try:
            self.verified = (await self._ask("release")).facts["verified"] or self.verified
        finally:
            self._close()

    async def take_back(self) -> bool | None:
        """See File. If the mount is gone, it has discarded or delivered the changes, which is unknown."""
        there: bool | None = None
        try:
            with suppress(LinkClosed):
                there = (await self._ask("take back")).facts["there"]
        finally:
            self._close()
        return there

    async def _ask(self, call: str, facts: Facts | None = None, data: bytes | memoryview = b"") -> Message:
        reply = await self._connection.ask(call, facts or {}, data)
        self.size = reply.facts.get("size", self.size)
        return reply

    def _close(self) -> None:
        self._released = True
        self._forget(self._connection)
        self._connection.close()
