"""Serves a mount's files to commands and programs by connections of its control socket. Layer: mount.

client.wire has the protocol. A connection has at most one open file and one request at a time, so a client
that stops reading costs at most a block of memory, and disturbs no other.

The requests change the mount's tree without the kernel. So the mount notifies the kernel: of names at once,
because the kernel believes for a while that a name is absent; of pages and attributes, because the kernel
keeps those of the old content. The mount notifies after the change, when no lock is held, and an answer waits
for that TELLING_TIME at most, because the kernel itself waits for look-ups and reads in progress. Programs
that watch by inotify receive nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.client import wire
from mavftpfs.client.files import WITHDRAWAL_TIME
from mavftpfs.client.wire import Message
from mavftpfs.mount.invalidator import Invalidator
from mavftpfs.mount.operations import Operations
from mavftpfs.shared.errors import LocalProtocolError, MavftpfsError, NotSupported, RemoteProtocolError
from mavftpfs.shared.model import normalise
from mavftpfs.shared.readable import name_text

log = logging.getLogger("mavftpfs.control")

MAX_CONNECTIONS = 128
"""The most connections at once; each open file of a program is one."""
TELLING_TIME = 1.0
"""Seconds for the kernel to drop its caches, before the answer to a change."""
_CANCELLED = wire.told_error(MavftpfsError("cancelled by the next request"))
_PIECE = 256 * 1024
"""Bytes to receive at once."""

Call = Callable[[Message], Awaitable[Message]]


class Served(NamedTuple):
    """The parts of a mount that the requests use. status: returns the facts of `status --json`."""

    tree: Tree
    operations: Operations
    kernel: Invalidator
    status: Callable[[], Mapping[str, Any]]


class FileServer:
    """Answers the requests of all connections."""

    def __init__(self, mount: Served) -> None:
        self._mount = mount
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
        connection = _Connection(stream, process, self._mount)
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

    def __init__(self, stream: trio.SocketStream, process: int, mount: Served) -> None:
        self.process = process
        self.file: OpenFile | None = None
        self.ending = trio.CancelScope(shield=True)
        self._path = b""
        self._writes = False
        self._stream = stream
        self._mount = mount
        self._tree, self._kernel = mount.tree, mount.kernel
        self._requests = wire.requests()
        self._calls: dict[str, Call] = {
            **{"stat": self._stat, "list": self._list, "crc32": self._crc32, "status": self._tell_status},
            **{"mkdir": self._mkdir, "rmdir": self._remove, "unlink": self._remove, "rename": self._rename},
            **{"refresh": self._refresh, "open": self._open, "create": self._create, "read": self._read},
            **{"write": self._write, "resize": self._resize, "fsync": self._fsync},
            **{"release": self._release, "take back": self._take_back},
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
                    await self._tell_file(file)
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
        return Message({"stat": wire.told_stat(await self._tree.stat(_path(request)))})

    async def _list(self, request: Message) -> Message:
        return Message({}, wire.told_entries(await self._tree.list(_path(request))))

    async def _crc32(self, request: Message) -> Message:
        return Message({"crc32": await self._tree.crc32(_path(request))})

    async def _tell_status(self, _: Message) -> Message:
        return Message({"status": dict(self._mount.status())})

    async def _mkdir(self, request: Message) -> Message:
        path = _path(request)
        self._require_on_card(path)
        await self._tree.mkdir(path, on_card=True)
        await _told(self._kernel.forget_name, path)
        return Message({})

    async def _remove(self, request: Message) -> Message:
        path = _path(request)
        remove = self._tree.rmdir if request.facts["call"] == "rmdir" else self._tree.unlink
        await remove(path)
        self._mount.operations.note_gone(path)
        await _told(self._kernel.forget_name, path)
        return Message({})

    async def _rename(self, request: Message) -> Message:
        old, new = _path(request), _path(request, "new")
        self._require_on_card(new)
        await self._tree.rename(old, new, on_card=True)
        self._mount.operations.note_renamed(old, new)
        await _told(self._kernel.forget_name, old, new)
        return Message({})

    async def _refresh(self, _: Message) -> Message:
        """Drop the tree's caches; the kernel asks again within two seconds."""
        await self._tree.refresh()
        return Message({})

    # -- calls of the open file

    async def _open(self, request: Message) -> Message:
        """The kernel drops its pages first, because the tree treats every opener as a reader."""
        path = self._begin(request)
        write, truncate, append = (bool(request.facts.get(name)) for name in ("write", "truncate", "append"))
        self._writes = write or truncate
        if self._writes:
            self._require_on_card(path)
        await _told(self._kernel.forget_pages, path)
        self.file = await self._tree.open(path, write=write, truncate=truncate, append=append)
        if truncate:
            self._kernel.on_changed(path)
        return Message({})

    async def _create(self, request: Message) -> Message:
        path = self._begin(request)
        self._writes = True
        self._require_on_card(path)
        self.file = await self._tree.create(
            path, exclusive=bool(request.facts.get("exclusive")), on_card=True
        )
        await _told(self._kernel.forget_name, path)
        return Message({})

    def _begin(self, request: Message) -> bytes:
        if self.file is not None:
            raise LocalProtocolError("a connection has only one open file")
        self._path = _path(request)
        return self._path

    async def _read(self, request: Message) -> Message:
        offset, size = _number(request, "at"), _number(request, "size")
        # A copy, because the client may take its time, and the bytes may be dropped here meanwhile.
        return Message({}, bytes(await self._open_file().read(offset, min(size, wire.BLOCK))))

    async def _write(self, request: Message) -> Message:
        file = self._open_file()
        with self._changing(file):
            await file.write(_number(request, "at"), request.data)
        return Message({})

    async def _resize(self, request: Message) -> Message:
        file = self._open_file()
        with self._changing(file):
            await file.truncate(_number(request, "size"))
        return Message({})

    async def _fsync(self, _: Message) -> Message:
        file = self._open_file()
        with self._changing(file):
            await file.fsync()
        await self._tell_file(file)
        return Message({"verified": file.verified})

    async def _release(self, _: Message) -> Message:
        file, self.file = self._open_file(), None
        with self._changing(file):
            await file.release()
        await self._tell_file(file)
        return Message({"verified": file.verified})

    async def _take_back(self, _: Message) -> Message:
        file, there = self._open_file(), None
        with trio.move_on_after(WITHDRAWAL_TIME, shield=True):  # else it would be delivered after all
            there = await file.take_back()
            await self._tell_file(file)
        self.file = None
        return Message({"there": there})

    def _require_on_card(self, path: bytes) -> None:
        """Check that a program on the mount has no file in memory under that name.

        Raises:
            NotSupported.
        """
        if self._tree.is_local(path):
            raise NotSupported(
                f"{name_text(path)} is in the mount's memory, as editors' swap files are, and never reaches "
                "the card; choose another name, or unmount first"
            )

    def _open_file(self) -> OpenFile:
        if self.file is None:
            raise LocalProtocolError("no file is open in this connection")
        return self.file

    @contextmanager
    def _changing(self, file: OpenFile) -> Iterator[None]:
        """Have the kernel drop its pages of a file that the body changes."""
        try:
            yield
        finally:
            if file.writable:
                self._kernel.on_changed(self._path)

    async def _tell_file(self, file: OpenFile) -> None:
        """Return when programs that open a changed file, or look at it, see its present state."""
        if file.writable:
            await _told(self._kernel.forget_file, self._path)


async def _told(tell: Callable[..., Awaitable[None]], *paths: bytes) -> None:
    with trio.move_on_after(TELLING_TIME, shield=True):  # what was opened meanwhile is not lost by a cancel
        await tell(*paths)


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
