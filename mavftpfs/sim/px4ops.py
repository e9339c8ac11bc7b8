"""PX4's directory and path requests. Layer: sim; pure. Source: mavlink_ftp.cpp, servers.md 6, 8-10, 13."""

from __future__ import annotations

import errno
import random
from collections.abc import Callable

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim import profiles
from mavftpfs.sim.firmware import Firmware, Refusal, Request, c_string, u32
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import NoErrno, Storage
from mavftpfs.sim.tree import Kind, OpenFile, TreeEntry, fail

_WORK_BUFFER = 256
_RENAME_LIMIT = 255
_LOGS = b"@MAV_LOG"


class PathRequests(Firmware):
    """Listings, and requests that name a path.

    scratch: a buffer; most requests leave their path in it.
    """

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        super().__init__(storage, profile, rng)
        self.scratch = b""
        self._errno = 0
        self._extra_cost = 0.0  # seconds that the present request takes longer
        self._handlers: dict[int, Callable[[Request], bytes]] = {
            Opcode.LIST_DIRECTORY: self._list,
            Opcode.REMOVE_FILE: self._changing(storage.unlink),
            Opcode.CREATE_DIRECTORY: self._changing(storage.mkdir),
            Opcode.REMOVE_DIRECTORY: self._changing(storage.rmdir),
            Opcode.RENAME: self._rename,
            Opcode.TRUNCATE_FILE: self._truncate,
            Opcode.CALC_FILE_CRC32: self._crc,
        }
        if profile.list_with_time:
            self._handlers[Opcode.LIST_DIRECTORY_WITH_TIME] = self._list

    def path_of(self, request: Request) -> bytes:
        """Return the request's path, cut silently where the work buffer ends."""
        path = c_string(request.data[: min(request.size, MAX_DATA - 1)])[: self.profile.path_limit]
        return self.resolve(path)

    def resolve(self, path: bytes) -> bytes:
        """Return the server's path for a client's path."""
        if self.profile.of_2026 and b".." in path.split(b"/"):
            raise Refusal(NakCode.FILE_PROTECTED)
        if self.profile.logs and path.startswith(_LOGS):
            return self.profile.logs + path[len(_LOGS) :]
        return path

    def check_writable(self, path: bytes) -> None:
        """Refuse paths outside the whitelist. For WriteFile the path is the content of the scratch buffer."""
        if self.is_protected(path):
            raise Refusal(NakCode.FILE_PROTECTED)

    def is_protected(self, path: bytes) -> bool:
        """Return whether a path is outside the whitelist."""
        root = self.profile.writable_root
        return bool(root) and (not path.startswith(root) or b"/../" in path)

    def _list(self, request: Request) -> bytes:
        """List from a raw readdir index. Every failure is FileNotFound."""
        self.scratch = path = self.path_of(request)
        try:
            entries = self.storage.entries(path)
        except OSError as exc:
            self._errno = exc.errno or 0
            raise Refusal(NakCode.FILE_NOT_FOUND) from exc
        with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
        page = bytearray()
        for index, entry in enumerate(entries[request.offset :], request.offset + 1):
            text = _entry_text(self.profile, path, entry, with_time)
            if len(page) + len(text) + 1 > MAX_DATA:
                self._extra_cost += self.profile.readdir_cost * index
                return bytes(page)
            page += text + b"\0"
        self._extra_cost += self.profile.readdir_cost * len(entries)
        self._errno = 0
        if request.offset >= len(entries):
            raise Refusal(NakCode.EOF)
        return bytes(page)

    def _changing(self, change: Callable[[bytes], None]) -> Callable[[Request], bytes]:
        """Return the handler that applies `change` to the path in a request."""

        def handle(request: Request) -> bytes:
            self.scratch = path = self.path_of(request)
            self.check_writable(path)
            change(path)
            return b""

        return handle

    def _rename(self, request: Request) -> bytes:
        data = request.data[: min(request.size, MAX_DATA - 1)]
        old, _, rest = data.partition(b"\0")
        if len(rest) < 2:
            raise NoErrno
        self.scratch = old = self.resolve(old)
        new = self.resolve(c_string(rest)[:_RENAME_LIMIT])
        self.check_writable(new)
        self.storage.rename(old, new)
        return b""

    def _crc(self, request: Request) -> bytes:
        """Compute a file's checksum; a failed open leaves errno as it was. Uses the other scratch buffer."""
        path = self.resolve(c_string(request.data[: min(request.size, MAX_DATA - 1)]))
        try:
            if self.storage.stat(path).kind is Kind.DIRECTORY:
                raise fail(errno.EISDIR, path)
        except FileNotFoundError as exc:
            raise NoErrno from exc
        checksum, size = self.storage.crc(path)
        self._extra_cost += size / self.profile.crc_rate
        return u32(checksum)

    def _truncate(self, request: Request) -> bytes:
        """Cut or extend a file; only recordings use this request."""
        self.scratch = path = self.path_of(request)
        self.check_writable(path)
        try:
            self.storage.truncate(path, request.offset)
        except OSError as exc:
            raise NoErrno from exc
        return b""


def nak_data(code: int, number: int) -> bytes:
    """Return a NAK's data. While errno is EEXIST, every NAK is "file exists" (mavlink_ftp.cpp,
    _process_request)."""
    if number == errno.EEXIST:
        return bytes([NakCode.FILE_EXISTS])
    if code != NakCode.FAIL_ERRNO:
        return bytes([code])
    if number == errno.ENOENT:
        return bytes([NakCode.FILE_NOT_FOUND])
    return bytes([NakCode.FAIL_ERRNO, number & 0xFF])


def open_file(
    storage: Storage, path: bytes, *, write: bool, create: bool, truncate: bool
) -> tuple[int, OpenFile]:
    """Open a file; return its size before a truncation. POSIX opens directories for reading, too."""
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


def _entry_text(profile: Profile, directory: bytes, entry: TreeEntry, with_time: bool) -> bytes:
    name, stat = entry
    if stat.kind is Kind.FILE:
        size = stat.size & 0xFFFFFFFF if len(directory) + len(name) + 2 < _WORK_BUFFER else 0
        text = b"F%b\t%d" % (name, size)
        return text + b"\t%d" % stat.mtime if with_time else text
    if stat.kind is Kind.DIRECTORY and name not in (b".", b".."):
        if with_time and not profile.of_2026:
            return b"D%b\t0\t%d" % (name, stat.mtime)
        return b"D" + name
    return b"S"
