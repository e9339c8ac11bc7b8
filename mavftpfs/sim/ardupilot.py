"""ArduPilot's FTP server: queue, worker thread and sessions. Layer: sim; pure.

Source: GCS_FTP.cpp of generation A (one session for the vehicle) and of generations B and C (five),
servers.md 1-13 and 15, a recording. The worker is a generator, which yields the time at which it is to be
resumed, or None while it is idle.
"""

from __future__ import annotations

import contextlib
import errno
import random
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim import profiles
from mavftpfs.sim.firmware import (
    ACK,
    NAK,
    Firmware,
    Refusal,
    Reply,
    Request,
    c_string,
    frame_size,
    parse,
    u32,
)
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import NoErrno, Storage
from mavftpfs.sim.tree import Kind, OpenFile, Stat, TreeEntry, fail

NOBODY = Address(0, 0)
_MAX_OFFSET = 2**31
_QUEUE = 5
"""Requests that may wait; the server drops more silently."""
LATENCY = 0.010
"""Seconds from an idle queue to the first answer."""
_STEAL_AFTER = 3.0
"""Seconds without a request after which another client may take a session."""


@dataclass(slots=True)
class Session:
    """A file that a client has open, and the id that the client chose.

    owner: the client that claimed the session (generations B and C). last_sent: time of the last reply, 0 =
    never. 0 = never.
    """

    file: OpenFile | None = None
    path: bytes = b""
    writing: bool = False
    last_sent: float = 0.0
    owner: Address = NOBODY
    number: int = -1

    def close(self) -> None:
        """Close the file. Raises OSError: the card does not have the written bytes."""
        opened, self.file = self.file, None
        if opened is not None:
            opened.close()


class Operations:
    """All requests except bursts. Each method fills in the reply and returns the seconds that it took, or
    raises a NAK."""

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
        """Close the file; only generations B and C report a failure."""
        try:
            session.close()
        except OSError:
            if self._profile.sessions > 1:
                raise

    def _open_read(self, session: Session, request: Request, reply: Reply, now: float) -> None:
        if session.file is not None:
            if now - session.last_sent <= _STEAL_AFTER:
                raise Refusal(NakCode.FAIL)
            with contextlib.suppress(OSError):  # the firmware ignores this error
                session.close()
        path = _path(self._profile, request)
        stat = self._storage.stat(path)
        if stat.kind is Kind.DIRECTORY:
            if self._storage.kind is profiles.Storage.FATFS:
                raise fail(errno.ENOENT, path)
            raise NoErrno  # AP_Filesystem_Posix::open gives up without setting errno
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
            raise NoErrno
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
        if path == b"/":
            virtual = self._storage.virtual.roots()
            entries = entries + [TreeEntry(name, Stat(Kind.DIRECTORY, 0, 0)) for name in virtual]
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

    def _entry_text(self, directory: bytes, entry: TreeEntry, with_time: bool) -> bytes | None:
        """Format an entry with its NUL; None if unlistable. A symlink is a file, whatever its target."""
        name, stat = entry
        if b"\t" in name and self._profile.drop_long_names:
            return b"S\0"
        if stat.kind is Kind.OTHER:
            return None
        if stat.kind is Kind.DIRECTORY:
            return b"D%b\t0\t%d\0" % (name, stat.mtime) if with_time else b"D%b\0" % name
        if directory == b"/" and self._profile.root_omits_files:
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
    """Read; the firmware treats offsets as signed 32-bit numbers."""
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


_ROOM_POLL = 0.002
_NEWLIB = {errno.ENOTEMPTY: 90, errno.ENAMETOOLONG: 91, errno.ENOSYS: 88, errno.ELOOP: 92}


class ArduPilot(Firmware):
    """One vehicle."""

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        super().__init__(storage, profile, rng)
        self._ops = Operations(storage, profile)
        self._errno = 0
        self._queue: deque[Request] = deque()
        self._reply = Reply(NOBODY, 0, 255, 0, 0, 0, 0, 0, b"")
        self._horizon = float("-inf")
        self._slots = [Session() for _ in range(profile.sessions)]
        self._worker = self._run()
        self._wake: float | None = next(self._worker)

    # -- timeline ----------------------------------------------------------------------------

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Queue a request, or drop it if five others wait."""
        self.advance(now)
        if len(self._queue) >= _QUEUE:
            self.dropped_requests += 1
            return
        self._queue.append(parse(wire, source))
        if self._wake is None:
            self._wake = now + LATENCY

    def advance(self, now: float) -> None:
        """See Firmware."""
        self._horizon = now
        while self._wake is not None and self._wake <= now:
            self.now = self._wake
            self._wake = next(self._worker)
        self.now = now
        self._kill_idle(now)

    def next_wake(self) -> float | None:
        """See Firmware."""
        limit = self.profile.idle_close
        if self._wake is not None or limit is None:
            return self._wake
        sent = [slot.last_sent for slot in self._slots if slot.file is not None]
        return min(sent) + limit if sent else None

    def open_paths(self) -> list[bytes]:
        """See Firmware."""
        return [slot.path for slot in self._slots if slot.file is not None]

    def reboot(self, now: float) -> None:
        """See Firmware."""
        for slot in self._slots:
            self._close_quietly(slot)
        self._slots = [Session() for _ in range(self.profile.sessions)]
        self._queue.clear()
        self._reply = Reply(NOBODY, 0, 255, 0, 0, 0, 0, 0, b"")
        self._errno = 0
        self.forget_outbox()
        self.now = now
        self._worker = self._run()
        self._wake = next(self._worker)

    def _kill_idle(self, now: float) -> None:
        limit = self.profile.idle_close
        if limit is None or self._wake is not None:
            return
        for slot in self._slots:
            if slot.last_sent and now >= slot.last_sent + limit:
                self._close_quietly(slot)

    def _close_quietly(self, slot: Session) -> None:
        """Close and ignore the result, as the firmware does; generations B and C then free the slot."""
        with contextlib.suppress(OSError):
            slot.close()
        if self.profile.sessions > 1:
            slot.last_sent = 0.0

    # -- the worker --------------------------------------------------------------------------

    def _run(self) -> Iterator[float | None]:
        while True:
            while not self._queue:
                yield None
            request = self._queue.popleft()
            if self.profile.sessions == 1:
                yield from self._run_single(request)
            else:
                yield from self._run_shared(request)

    def _run_single(self, request: Request) -> Iterator[float | None]:
        """Generation A: `number` is the id of the one session, for all clients."""
        slot = self._slots[0]
        if self._is_repeat(request):
            self.replays += 1
            yield from self._push(slot)
            return
        self._prepare(request)
        idle = self.now - slot.last_sent
        ending = request.opcode in (Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS)
        stranger = slot.file is not None and request.session != slot.number
        if request.size > MAX_DATA:
            self._nak(NakCode.INVALID_DATA_SIZE)
        elif ending and request.session != slot.number:
            self._reply.opcode = ACK  # the server confirms the end of another session, which does not exist
        elif stranger and idle < _STEAL_AFTER:
            self._nak(NakCode.INVALID_SESSION)
        else:
            if stranger:
                self._close_quietly(slot)
            if ending:
                self._close_quietly(slot)
                self._reply.opcode = ACK
            else:
                yield from self._execute(slot, request)
                return
        yield from self._push(slot)

    def _run_shared(self, request: Request) -> Iterator[float | None]:
        """Generations B and C: find the sender's session, or claim an idle one."""
        if request.opcode == Opcode.RESET_SESSIONS:
            for slot in self._slots:
                if slot.owner == request.source:
                    self._close_quietly(slot)
            self._prepare(request)
            self._reply.opcode = ACK
            self._send_once()
            return
        found = self._find_slot(request)
        if found is None:
            self._prepare(request)
            self._nak(NakCode.NO_SESSIONS_AVAILABLE)
            self._send_once()
            return
        if self._is_repeat(request) and self._reply.data[:1] != bytes([NakCode.NO_SESSIONS_AVAILABLE]):
            self.replays += 1
            yield from self._push(found)
            return
        self._prepare(request)
        if request.size > MAX_DATA:
            self._nak(NakCode.INVALID_DATA_SIZE)
            yield from self._push(found)
        else:
            yield from self._execute(found, request)

    def _find_slot(self, request: Request) -> Session | None:
        for slot in self._slots:
            if slot.owner == request.source and slot.number == request.session:
                return slot
        oldest = min(self._slots, key=lambda slot: slot.last_sent)
        if oldest.last_sent and self.now - oldest.last_sent < _STEAL_AFTER:
            return None
        self._close_quietly(oldest)
        oldest.owner, oldest.number = request.source, request.session
        return oldest

    def _is_repeat(self, request: Request) -> bool:
        """Return whether the request seems to repeat the last one that the server answered in any session."""
        reply = self._reply
        return (
            request.source == reply.target
            and request.session == reply.session
            and request.seq + 1 == reply.seq & 0xFFFF
        )

    def _execute(self, slot: Session, request: Request) -> Iterator[float | None]:
        """Run a request that has a session. A burst occupies the worker until it ends."""
        if request.opcode in (ACK, NAK):
            return
        if request.opcode == Opcode.BURST_READ_FILE:
            yield from self._burst(slot, request)
            return
        try:
            cost = self._ops.execute(slot, request, self._reply, self.now)
        except Refusal as refusal:
            self._nak(refusal.code)
        except OSError as exc:
            self._fail(exc)
        else:
            if cost:
                yield self.now + cost
        yield from self._push(slot)
        if request.opcode == Opcode.TERMINATE_SESSION:
            slot.last_sent = 0.0

    # -- replies -----------------------------------------------------------------------------

    def _prepare(self, request: Request) -> None:
        self._reply = Reply(
            request.source, request.seq + 1, request.session, ACK, 0, request.opcode, 0, 0, b""
        )

    def _nak(self, code: int) -> None:
        self._reply.opcode, self._reply.size, self._reply.data = NAK, 1, bytes([code])

    def _fail(self, exc: OSError) -> None:
        """Refuse with errno, or with the errno left over from an earlier failure."""
        if not isinstance(exc, NoErrno) and exc.errno is not None:
            self._errno = exc.errno
        if self._errno == errno.EEXIST:
            self._nak(NakCode.FILE_EXISTS)
        elif self._errno == errno.ENOENT:
            self._nak(NakCode.FILE_NOT_FOUND)
        else:
            number = self._errno
            if self.profile.newlib_errnos:
                number = _NEWLIB.get(number, number)
            self._nak(NakCode.FAIL_ERRNO)
            self._reply.size, self._reply.data = 2, bytes([NakCode.FAIL_ERRNO, number & 0xFF])

    def _push(self, slot: Session) -> Iterator[float | None]:
        """Send the reply as soon as the link has room; the server does nothing else until then."""
        while not self._has_room():
            yield self._horizon + _ROOM_POLL  # the room changes only between two calls of advance
        slot.last_sent = self.now
        self._emit()

    def _send_once(self) -> None:
        if self._has_room():
            self._emit()
        else:
            self.dropped_replies += 1

    def _emit(self) -> None:
        self.emit(self._reply.target, self._reply.encode(), self.now, self.now)

    def _has_room(self) -> bool:
        return self.tx_room is None or self.room() >= frame_size(self._reply.encode())

    # -- bursts ------------------------------------------------------------------------------

    def _burst(self, slot: Session, request: Request) -> Iterator[float | None]:
        """Send up to burst_packets packets; a burst cannot be stopped."""
        size = request.size or MAX_DATA
        reply = self._reply
        reply.offset = request.offset if self.profile.exact_eof_offset else 0
        try:
            check_readable(slot)
            for index in range(self.profile.burst_packets):
                data = read(slot, request.offset + index * size, size)
                if not data:
                    raise Refusal(NakCode.EOF)
                self._fill(reply, request.offset + index * size, data, size, index)
                yield from self._push(slot)
                if self.profile.exact_eof_offset or len(data) < size:
                    reply.offset += len(data)
                reply.seq += 1
                yield self.now + self.profile.burst_interval
        except Refusal as refusal:
            self._nak(refusal.code)
        except OSError as exc:
            self._fail(exc)
        else:
            return
        if not self.profile.short_packet_completes:
            reply.burst_complete = 1
        yield from self._push(slot)

    def _fill(self, reply: Reply, offset: int, data: bytes, size: int, index: int) -> None:
        reply.opcode, reply.size, reply.data, reply.offset = ACK, len(data), data, offset
        last = index == self.profile.burst_packets - 1
        short = self.profile.short_packet_completes and len(data) < size
        reply.burst_complete = int(last or short)
