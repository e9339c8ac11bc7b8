"""ArduPilot's requests on one session. Layer: sim; pure. Source: GCS_FTP.cpp, servers.md 6-10 and 13."""

from __future__ import annotations

import contextlib
import errno
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim import profiles
from mavftpfs.sim.filesystem import Entry, Kind, Stat, fail
from mavftpfs.sim.firmware import Refusal
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import OpenFile, StaleErrno, Storage
from mavftpfs.sim.wire import Reply, Request, c_string, u32

NOBODY = Address(0, 0)
_MAX_OFFSET = 2**31


@dataclass(slots=True)
class Session:
    """A file a client has open, and the id that client chose.

    owner: who claimed the session (generations B and C). last_sent: when something was last sent, 0 = never.
    """

    file: OpenFile | None = None
    path: bytes = b""
    writing: bool = False
    last_sent: float = 0.0
    owner: Address = NOBODY
    number: int = -1

    def close(self) -> None:
        """Close the file. Raises OSError: what was written is not on the card."""
        opened, self.file = self.file, None
        if opened is not None:
            opened.close()


class Operations:
    """The requests but for bursts. Each fills in the reply and returns how long it took; raises a NAK."""

    def __init__(self, storage: Storage, profile: Profile) -> None:
        self._storage = storage
        self._profile = profile

    def execute(self, session: Session, request: Request, reply: Reply, now: float) -> float:
        """Run a request.

        Raises:
            Refusal, OSError: a NAK.
        """
        match request.opcode:
            case Opcode.NONE:
                return 0.0
            case Opcode.TERMINATE_SESSION:
                self._terminate(session)
            case Opcode.OPEN_FILE_RO:
                self._open_read(session, request, reply, now)
            case Opcode.READ_FILE:
                _read_file(session, request, reply)
            case Opcode.CREATE_FILE | Opcode.OPEN_FILE_WO:
                self._open_write(session, request)
            case Opcode.WRITE_FILE:
                _write_file(session, request, reply)
            case _:
                return self._execute_path(request, reply)
        return 0.0

    def _execute_path(self, request: Request, reply: Reply) -> float:
        match request.opcode:
            case Opcode.LIST_DIRECTORY:
                return self._list(request, reply)
            case Opcode.LIST_DIRECTORY_WITH_TIME if self._profile.list_with_time:
                return self._list(request, reply)
            case Opcode.CREATE_DIRECTORY:
                self._storage.mkdir(_path(self._profile, request))
            case Opcode.REMOVE_FILE | Opcode.REMOVE_DIRECTORY:
                self._storage.remove_any(_path(self._profile, request))
            case Opcode.RENAME:
                self._storage.rename(*_rename_paths(self._profile, request))
            case Opcode.CALC_FILE_CRC32:
                return self._crc(request, reply)
            case _:
                raise Refusal(self._profile.unknown_code)
        return 0.0

    # -- the file ----------------------------------------------------------------------------

    def _terminate(self, session: Session) -> None:
        """Close; only generations B and C say so if that failed."""
        try:
            session.close()
        except OSError:
            if self._profile.sessions > 1:
                raise

    def _open_read(self, session: Session, request: Request, reply: Reply, now: float) -> None:
        if session.file is not None:
            if now - session.last_sent <= self._profile.steal_after:
                raise Refusal(NakCode.FAIL)
            with contextlib.suppress(OSError):  # the firmware does not look
                session.close()
        path = _path(self._profile, request)
        stat = self._storage.stat(path)
        if stat.kind is Kind.DIRECTORY:
            if self._storage.kind is profiles.Storage.FATFS:
                raise fail(errno.ENOENT, path)
            raise StaleErrno  # AP_Filesystem_Posix::open gives up without setting errno
        session.file, session.path, session.writing = self._storage.open(path), path, False
        session.number = request.session
        reply.size, reply.data = 4, u32(stat.size)

    def _open_write(self, session: Session, request: Request) -> None:
        if session.file is not None:
            raise Refusal(NakCode.FAIL)
        path = _path(self._profile, request)
        create = request.opcode == Opcode.CREATE_FILE
        session.file = self._storage.open(
            path, write=True, create=create or self._profile.write_only_creates, truncate=create
        )
        session.path, session.writing, session.number = path, True, request.session

    def _crc(self, request: Request, reply: Reply) -> float:
        path = _path(self._profile, request)
        if self._storage.stat(path).kind is Kind.DIRECTORY:
            raise StaleErrno
        checksum, size = self._storage.crc(path)
        reply.size, reply.data = 4, u32(checksum)
        return size / self._profile.crc_rate

    # -- listings ----------------------------------------------------------------------------

    def _list(self, request: Request, reply: Reply) -> float:
        """List from an index among the listable entries."""
        reply.offset = request.offset
        path = _path(self._profile, request)
        path = path[:-1] if len(path) > 1 and path.endswith(b"/") else path
        entries = self._storage.entries(path)
        if path == b"/" and self._storage.virtual is not None:
            virtual = self._storage.virtual.roots()
            entries = entries + [Entry(name, Stat(Kind.DIRECTORY, 0, 0)) for name in virtual]
        with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
        found = (self._entry_text(path, entry, with_time) for entry in entries)
        page = self._page([text for text in found if text is not None], request.offset)
        if not page:
            raise Refusal(NakCode.EOF)
        reply.size, reply.data = len(page), page
        return self._profile.readdir_cost * len(entries)

    def _page(self, texts: list[bytes], offset: int) -> bytes:
        """Skip `offset` entries that fit a page, then fill one page; list_dir in GCS_FTP.cpp."""
        dropping = self._profile.drop_long_names
        largest = MAX_DATA - 1 if dropping else MAX_DATA
        rest = iter(texts)
        while offset > 0:
            text = next(rest, None)
            if text is None:
                return b""
            offset -= len(text) <= largest
        page = bytearray()
        for text in rest:
            if dropping and len(text) > largest:
                continue
            if len(page) + len(text) >= MAX_DATA:
                break
            page += text + b"\0" if self._profile.double_nul else text
        return bytes(page)

    def _entry_text(self, directory: bytes, entry: Entry, with_time: bool) -> bytes | None:
        """Format an entry with its NUL; None if unlistable. A symlink is a file, whatever it leads to."""
        name, stat = entry
        if b"\t" in name and self._profile.drop_long_names:
            return b"S\0"
        if stat.kind is Kind.OTHER:
            return None
        if stat.kind is Kind.DIRECTORY:
            return b"D%b\t0\t%d\0" % (name, stat.mtime) if with_time else b"D%b\0" % name
        if directory == b"/" and self._profile.root_hides_files:
            return None  # the firmware asks for the stat of "//name", which fails
        if stat.kind is Kind.SYMLINK:
            try:
                stat = self._storage.stat(directory + b"/" + name)
            except OSError:
                return None
        size = stat.size & 0xFFFFFFFF
        return b"F%b\t%d\t%d\0" % (name, size, stat.mtime) if with_time else b"F%b\t%d\0" % (name, size)


def _path(profile: Profile, request: Request) -> bytes:
    """Return the path if `size` is exactly its length; bytes behind `size` must be zero (check_name_len)."""
    length = len(c_string(request.data))
    nul_counted = request.size - length == 1 and request.data[-1] == 0 and profile.counted_path_nul
    if request.size == 0 or (length != request.size and not nul_counted):
        raise Refusal(NakCode.INVALID_DATA_SIZE)
    return c_string(request.data[: MAX_DATA - 1])


def _rename_paths(profile: Profile, request: Request) -> tuple[bytes, bytes]:
    old, separator, rest = request.data.partition(b"\0")
    new = c_string(rest)
    extra = request.size - (len(old) + 1 + len(new))
    nul_counted = extra == 1 and request.data[-1] == 0 and profile.counted_path_nul
    if not separator or request.size == 0 or (extra != 0 and not nul_counted):
        raise Refusal(NakCode.INVALID_DATA_SIZE)
    return old, c_string(rest[: MAX_DATA - 2 - len(old)])


def check_readable(session: Session) -> OpenFile:
    """Return the file, if one is open for reading."""
    if session.file is None:
        raise Refusal(NakCode.FILE_NOT_FOUND)
    if session.writing:
        raise Refusal(NakCode.FAIL)
    return session.file


def read(session: Session, offset: int, size: int) -> bytes:
    """Read; offsets are signed 32 bits below the protocol."""
    if offset >= _MAX_OFFSET:
        raise fail(errno.EINVAL)
    return check_readable(session).read(offset, min(size, MAX_DATA))


def _read_file(session: Session, request: Request, reply: Reply) -> None:
    data = read(session, request.offset, request.size)
    if not data:
        raise Refusal(NakCode.EOF)
    reply.offset, reply.size, reply.data = request.offset, len(data), data


def _write_file(session: Session, request: Request, reply: Reply) -> None:
    """Write; a short write is ACKed like a whole one."""
    if session.file is None:
        raise Refusal(NakCode.FILE_NOT_FOUND)
    if not session.writing:
        raise Refusal(NakCode.FAIL)
    if request.offset >= _MAX_OFFSET:
        raise fail(errno.EINVAL)
    session.file.write(request.offset, request.data[: request.size])
    reply.offset = request.offset
