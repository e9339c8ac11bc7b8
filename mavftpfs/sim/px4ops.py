"""PX4's directory and path requests. Layer: sim; pure. Source: mavlink_ftp.cpp, servers.md 6, 8-10, 13."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Protocol

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim import profiles
from mavftpfs.sim.firmware import Refusal, Request, c_string, u32
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import StaleErrno, Storage
from mavftpfs.sim.tree import Entry, Kind, OpenFile, fail

_WORK_BUFFER = 256
_RENAME_LIMIT = 255


class Server(Protocol):
    """What these requests need of the server."""

    profile: Profile
    storage: Storage
    scratch: bytes

    def check_writable(self, path: bytes) -> None:
        """Refuse a path outside the whitelist."""
        ...

    def refuse_read(self, request: Request) -> bytes:
        """Say why a ReadFile cannot be served."""
        ...

    def spend(self, seconds: float) -> None:
        """Take time."""
        ...

    def set_errno(self, number: int) -> None:
        """Set the errno that NAKs report."""
        ...


def handlers(server: Server) -> dict[int, Callable[[Request], bytes]]:
    """Return the handlers by opcode."""

    def bind(function: Callable[[Server, Request], bytes]) -> Callable[[Request], bytes]:
        return lambda request: function(server, request)

    bound: dict[int, Callable[[Request], bytes]] = {
        Opcode.READ_FILE: server.refuse_read,
        Opcode.LIST_DIRECTORY: bind(_list),
        Opcode.REMOVE_FILE: bind(_changing(Storage.unlink)),
        Opcode.CREATE_DIRECTORY: bind(_changing(Storage.mkdir)),
        Opcode.REMOVE_DIRECTORY: bind(_changing(Storage.rmdir)),
        Opcode.RENAME: bind(_rename),
        Opcode.TRUNCATE_FILE: bind(_truncate),
        Opcode.CALC_FILE_CRC32: bind(_crc),
    }
    if server.profile.list_with_time:
        bound[Opcode.LIST_DIRECTORY_WITH_TIME] = bind(_list)
    return bound


def nak_data(code: int, number: int) -> bytes:
    """Return a NAK's data; once errno is EEXIST every NAK says so (mavlink_ftp.cpp, _process_request)."""
    if number == errno.EEXIST:
        return bytes([NakCode.FILE_EXISTS])
    if code != NakCode.FAIL_ERRNO:
        return bytes([code])
    if number == errno.ENOENT:
        return bytes([NakCode.FILE_NOT_FOUND])
    return bytes([NakCode.FAIL_ERRNO, number & 0xFF])


def path_of(server: Server, request: Request) -> bytes:
    """Return the request's path, cut silently where the work buffer ends."""
    return c_string(request.data[: min(request.size, MAX_DATA - 1)])[: server.profile.path_limit]


def open_file(
    storage: Storage, path: bytes, *, write: bool, create: bool, truncate: bool
) -> tuple[int, OpenFile]:
    """Open and return the size as it was before a truncation; POSIX opens directories for reading."""
    size = 0
    try:
        stat = storage.stat(path)
        if stat.kind is Kind.DIRECTORY and not write and storage.kind is profiles.Storage.POSIX:
            return stat.size, _OpenDirectory()
        size = stat.size
    except OSError:
        if not create:
            raise
    return size, storage.open(path, write=write, create=create, truncate=truncate)


class _OpenDirectory:
    """A directory opened read-only: open() succeeds, read() does not."""

    def read(self, offset: int, size: int) -> bytes:
        raise fail(errno.EISDIR)

    def write(self, offset: int, data: bytes) -> int:
        raise fail(errno.EISDIR)

    def size(self) -> int:
        return 0

    def close(self) -> None:
        return


def _list(server: Server, request: Request) -> bytes:
    """List from a raw readdir index; whatever fails is FileNotFound."""
    path = path_of(server, request)
    server.scratch = path
    try:
        entries = server.storage.entries(path)
    except OSError as exc:
        server.set_errno(exc.errno or 0)
        raise Refusal(NakCode.FILE_NOT_FOUND) from exc
    with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
    page = bytearray()
    for index, entry in enumerate(entries[request.offset :], request.offset + 1):
        text = _entry_text(server.profile, path, entry, with_time)
        if len(page) + len(text) + 1 > MAX_DATA:
            server.spend(server.profile.readdir_cost * index)
            return bytes(page)
        page += text + b"\0"
    server.spend(server.profile.readdir_cost * len(entries))
    server.set_errno(0)
    if request.offset >= len(entries):
        raise Refusal(NakCode.EOF)
    return bytes(page)


def _entry_text(profile: Profile, directory: bytes, entry: Entry, with_time: bool) -> bytes:
    name, stat = entry
    if stat.kind is Kind.FILE:
        size = stat.size & 0xFFFFFFFF if len(directory) + len(name) + 2 < _WORK_BUFFER else 0
        text = b"F%b\t%d" % (name, size)
        return text + b"\t%d" % stat.mtime if with_time else text
    if stat.kind is Kind.DIRECTORY and name not in (b".", b".."):
        if with_time and not profile.bare_time_directories:
            return b"D%b\t0\t%d" % (name, stat.mtime)
        return b"D" + name
    return b"S"


def _changing(change: Callable[[Storage, bytes], None]) -> Callable[[Server, Request], bytes]:
    """Return the handler that does this to the path in a request."""

    def handle(server: Server, request: Request) -> bytes:
        server.scratch = path = path_of(server, request)
        server.check_writable(path)
        change(server.storage, path)
        return b""

    return handle


def _rename(server: Server, request: Request) -> bytes:
    data = request.data[: min(request.size, MAX_DATA - 1)]
    old, _, rest = data.partition(b"\0")
    if len(rest) < 2:
        raise StaleErrno
    server.scratch = old
    new = c_string(rest)[:_RENAME_LIMIT]
    server.check_writable(new)
    server.storage.rename(old, new)
    return b""


def _crc(server: Server, request: Request) -> bytes:
    """Checksum a file; a failed open leaves errno as it was. Uses the other scratch buffer."""
    path = c_string(request.data[: min(request.size, MAX_DATA - 1)])
    try:
        if server.storage.stat(path).kind is Kind.DIRECTORY:
            raise fail(errno.EISDIR, path)
    except FileNotFoundError as exc:
        raise StaleErrno from exc
    checksum, size = server.storage.crc(path)
    server.spend(size / server.profile.crc_rate)
    return u32(checksum)


def _truncate(server: Server, request: Request) -> bytes:
    """Cut or extend a file; only recordings ask for it."""
    server.scratch = path = path_of(server, request)
    server.check_writable(path)
    try:
        server.storage.truncate(path, request.offset)
    except OSError as exc:
        raise StaleErrno from exc
    return b""
