"""Serves a mount's files to commands and programs by connections of its control socket. Layer: mount.

client.wire has the protocol. A connection has at most one open file and one request at a time, so a client
that stops reading costs at most a block of memory, and disturbs no other.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import trio

from mavftpfs.client import wire
from mavftpfs.client.files import WITHDRAWAL_TIME, File, Files
from mavftpfs.client.wire import Message
from mavftpfs.shared.errors import LocalProtocolError, MavftpfsError, RemoteProtocolError
from mavftpfs.shared.model import normalise

log = logging.getLogger("mavftpfs.control")

MAX_CONNECTIONS = 128
"""The most connections at once; each open file of a program is one."""
_CANCELLED = wire.told_error(MavftpfsError("cancelled by the next request"))
_PIECE = 256 * 1024
"""Bytes to receive at once."""

Call = Callable[[Message], Awaitable[Message]]


class FileServer:
    """Answers the requests of all connections. status: returns the facts of `status --json`."""

    def __init__(self, files: Files, status: Callable[[], Mapping[str, Any]]) -> None:
        self._files = files
        self._status = status
        self._serving: dict[trio.CancelScope, _Connection] = {}
        self._ended = trio.Event()
        self._closed = False

    @property
    def users(self) -> list[int]:
        """The processes that have a file open."""
        return sorted({one.process for one in self._serving.values() if one.file is not None})

    def refusal(self) -> str:
        """Return the reason why new connections are refused, or ""."""
        if self._closed:
            return "the vehicle is being unmounted"
        if len(self._serving) >= MAX_CONNECTIONS:
            return f"{MAX_CONNECTIONS} files of this mount are open in programs already"
        return ""

    async def serve(self, stream: trio.SocketStream, process: int) -> None:
        """Answer a client until it leaves. process: its number."""
        if self._closed:  # since it was granted
            return
        connection = _Connection(stream, process, self._files, self._status)
        with trio.CancelScope() as scope:
            self._serving[scope] = connection
            try:
                await connection.run()
            finally:
                await connection.end()
                del self._serving[scope]
                self._ended.set()

    async def close(self) -> None:
        """End all connections, and wait until their unreleased changes are discarded."""
        self._closed = True
        for scope in self._serving:
            scope.cancel()
        while self._serving:
            self._ended = trio.Event()
            await self._ended.wait()

    def hurry(self) -> None:
        """Stop waiting: changes that are not discarded yet are saved like all undelivered ones."""
        for connection in self._serving.values():
            connection.ending.cancel()


class _Connection:
    """One client. file: its open file. process: its number. ending: bounds the time of `end`."""

    def __init__(
        self,
        stream: trio.SocketStream,
        process: int,
        files: Files,
        status: Callable[[], Mapping[str, Any]],
    ) -> None:
        self.process = process
        self.file: File | None = None
        self.ending = trio.CancelScope(shield=True)
        self._writes = False
        self._stream = stream
        self._files = files
        self._status = status
        self._requests = wire.requests()
        self._calls: dict[str, Call] = {
            **{"stat": self._stat, "list": self._list, "crc32": self._crc32, "status": self._tell_status},
            **{name: _of_path(getattr(files, name)) for name in ("mkdir", "rmdir", "unlink")},
            **{"rename": self._rename, "refresh": self._refresh},
            **{"open": self._open, "create": self._create, "read": self._read, "write": self._write},
            **{"resize": self._resize, "fsync": self._fsync, "release": self._release},
            **{"take back": self._take_back},
        }

    async def run(self) -> None:
        """Answer until the client leaves, or sends an invalid message."""
        request = await self._next()
        while request is not None:
            request = await self._answered(request)

    async def end(self) -> None:
        """Close the file, and discard its unreleased changes."""
        file, self.file = self.file, None
        with self.ending:
            self.ending.deadline = trio.current_time() + WITHDRAWAL_TIME
            try:
                if file is not None:
                    await (file.take_back() if self._writes else file.release())
            except MavftpfsError as error:
                log.info("a file of process %d, which is gone: %s", self.process, error)
            except Exception:
                log.exception("bug in closing a file of process %d", self.process)

    async def _answered(self, request: Message) -> Message | None:
        """Answer a request; return the next one, None after the last. The next one cancels this one."""
        following: Message | None = None
        async with trio.open_nursery() as nursery:
            with trio.CancelScope() as scope:

                async def listen() -> None:
                    nonlocal following
                    following = await self._next()
                    scope.cancel()

                nursery.start_soon(listen)
                reply = _CANCELLED
                reply = await self._reply(request)
            if not await self._send(reply):
                nursery.cancel_scope.cancel()
        return following

    async def _next(self) -> Message | None:
        """Return the next request, None after the last."""
        try:
            while True:
                request = self._requests.next()
                if request is not None:
                    return request
                data = await self._stream.receive_some(_PIECE)
                if not data:
                    return None
                self._requests.feed(data)
        except RemoteProtocolError as error:
            log.debug("process %d sent an invalid request: %s", self.process, error)
        except (trio.BrokenResourceError, trio.ClosedResourceError):
            pass
        return None

    async def _send(self, reply: Message) -> bool:
        """Send a reply; return whether the client is still there."""
        try:
            await self._stream.send_all(wire.encoded(*reply))
        except (trio.BrokenResourceError, trio.ClosedResourceError):
            return False
        return True

    async def _reply(self, request: Message) -> Message:
        try:
            call = self._calls.get(str(request.facts.get("call")))
            if call is None:
                raise LocalProtocolError("this mount does not know that call")
            facts, data = await call(request)
            return Message(facts if self.file is None else {**facts, "size": self.file.size}, data)
        except MavftpfsError as error:
            return wire.told_error(error)
        except Exception as error:
            log.exception("bug in a request of process %d", self.process)
            return wire.told_error(MavftpfsError(f"internal error: {error!r}"))

    # -- calls by path

    async def _stat(self, request: Message) -> Message:
        return Message({"stat": wire.told_stat(await self._files.stat(_path(request)))})

    async def _list(self, request: Message) -> Message:
        return Message({}, wire.told_entries(await self._files.list(_path(request))))

    async def _crc32(self, request: Message) -> Message:
        return Message({"crc32": await self._files.crc32(_path(request))})

    async def _tell_status(self, _: Message) -> Message:
        return Message({"status": dict(self._status())})

    async def _rename(self, request: Message) -> Message:
        await self._files.rename(_path(request), _path(request, "new"))
        return Message({})

    async def _refresh(self, _: Message) -> Message:
        await self._files.refresh()
        return Message({})

    # -- calls of the open file

    async def _open(self, request: Message) -> Message:
        how = {name: bool(request.facts.get(name)) for name in ("write", "truncate", "append")}
        self._require_none_open()
        self._writes = how["write"] or how["truncate"]
        self.file = await self._files.open(_path(request), **how)
        return Message({})

    async def _create(self, request: Message) -> Message:
        self._require_none_open()
        self._writes = True
        self.file = await self._files.create(_path(request), exclusive=bool(request.facts.get("exclusive")))
        return Message({})

    async def _read(self, request: Message) -> Message:
        offset, size = _number(request, "at"), _number(request, "size")
        # A copy, because the client may take its time, and the bytes may be dropped here meanwhile.
        return Message({}, bytes(await self._open_file().read(offset, min(size, wire.BLOCK))))

    async def _write(self, request: Message) -> Message:
        await self._open_file().write(_number(request, "at"), request.data)
        return Message({})

    async def _resize(self, request: Message) -> Message:
        await self._open_file().truncate(_number(request, "size"))
        return Message({})

    async def _fsync(self, _: Message) -> Message:
        file = self._open_file()
        await file.fsync()
        return Message({"verified": file.verified})

    async def _release(self, _: Message) -> Message:
        file, self.file = self._open_file(), None
        await file.release()
        return Message({"verified": file.verified})

    async def _take_back(self, _: Message) -> Message:
        file, there = self._open_file(), None
        with trio.move_on_after(WITHDRAWAL_TIME, shield=True):  # else it would be delivered after all
            there = await file.take_back()
        self.file = None
        return Message({"there": there})

    def _require_none_open(self) -> None:
        if self.file is not None:
            raise LocalProtocolError("a connection has only one open file")

    def _open_file(self) -> File:
        if self.file is None:
            raise LocalProtocolError("no file is open in this connection")
        return self.file


def _of_path(call: Callable[[bytes], Awaitable[None]]) -> Call:
    """Return a handler that calls a function with the request's path and returns nothing."""

    async def answer(request: Message) -> Message:
        await call(_path(request))
        return Message({})

    return answer


def _path(request: Message, name: str = "path") -> bytes:
    return normalise(wire.path(request.facts.get(name)))


def _number(request: Message, name: str) -> int:
    """Return an offset or a size.

    Raises:
        LocalProtocolError: it is none.
    """
    number = request.facts.get(name)
    if not isinstance(number, int) or number < 0:
        raise LocalProtocolError(f"{name} is not a number of bytes")
    return number
