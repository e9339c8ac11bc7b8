"""What the simulated firmwares have in common, and a firmware without oddities. Layer: sim; pure.

Requests and replies are not those of protocol.payload. Servers echo fields and leave stray bytes behind
`size`, and this code must be fast.

Time: `handle` and `outgoing` first let everything happen that was due by `now`, in order, at its own instant.
Replies are emitted in the order of their due times: the outbox is a list of those that are due and a queue
of the others.
"""

from __future__ import annotations

import errno
import random
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import Storage
from mavftpfs.sim.tree import Entry, Kind, OpenFile

HEADER = struct.Struct("<HBBBBBxI")
HEADER_SIZE = HEADER.size
REPLY = struct.Struct("<HBBBBBxI239s")
FRAME_OVERHEAD = 12
"""Bytes that MAVLink 2 puts around a payload, unsigned."""
FULL_FRAME = 266
"""An FTP frame with 239 bytes of data."""
ACK = 128
NAK = 129


class Request(NamedTuple):
    """A request; `data` is the whole 239-byte field."""

    seq: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes
    source: Address


@dataclass(slots=True)
class Reply:
    """A reply under construction. `data` may be longer than `size`: the rest is stray memory."""

    target: Address
    seq: int
    session: int
    opcode: int
    size: int
    req_opcode: int
    burst_complete: int
    offset: int
    data: bytes

    def encode(self) -> bytes:
        """Return the 251 wire bytes."""
        return REPLY.pack(
            self.seq & 0xFFFF,
            self.session,
            self.opcode,
            self.size,
            self.req_opcode,
            self.burst_complete,
            self.offset & 0xFFFFFFFF,
            self.data,
        )


def parse(wire: bytes, source: Address) -> Request:
    """Split 251 wire bytes."""
    seq, session, opcode, size, _, _, offset = HEADER.unpack_from(wire)
    return Request(seq, session, opcode, size, offset, wire[HEADER_SIZE:], source)


def c_string(data: bytes) -> bytes:
    """Return what stands before the first NUL."""
    return data.partition(b"\0")[0]


def frame_size(wire: bytes) -> int:
    """Return how long a MAVLink 2 frame of this payload is: trailing zeros are not sent."""
    return FRAME_OVERHEAD + 3 + len(wire.rstrip(b"\0"))


def u32(value: int) -> bytes:
    """Return four bytes, little-endian, modulo 2^32 as the servers do."""
    return (value & 0xFFFFFFFF).to_bytes(4, "little")


Room = Callable[[], int]


_PAUSES_KEPT = 1 << 18


class Refusal(Exception):
    """A NAK with data that the server chooses: a code, perhaps more. For an OSError they come from its
    errno."""

    def __init__(self, code: int, *more: int) -> None:
        super().__init__(code, *more)
        self.code = code
        self.data = bytes([code, *more])


class Firmware(ABC):
    """One server's code. Subclasses decide; this class keeps time and the outbox.

    Attributes:
        tx_room: tells how many bytes the link's transmit buffer still takes (PX4 and ArduPilot pace by it);
            None = as much as the profile's own buffer.
        crashed: the process died (MAVSDK) and is silent until `reboot`.
        dropped_requests: lost to a full queue or receive buffer. dropped_replies: to a full transmit buffer.
        replays: requests answered from the replay slot.
        pauses: seconds for which a slow card made each of the last reads and writes wait, 0 included.
    """

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        self.storage = storage
        self.profile = profile
        self.rng = rng
        self.tx_room: Room | None = None
        self.crashed = False
        self.dropped_requests = 0
        self.dropped_replies = 0
        self.replays = 0
        self.pauses: deque[float] = deque(maxlen=_PAUSES_KEPT)
        self.now = float("-inf")
        storage.virtual.clock = lambda: self.now
        self._ready: list[tuple[Address, bytes]] = []
        self._ready_bytes = 0
        self._later: deque[tuple[float, Address, bytes]] = deque()

    @abstractmethod
    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Take a request of 251 bytes."""

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Take requests of 251 bytes that came together: the same as one by one."""
        for wire in wires:
            if self.crashed:
                return
            self.handle(wire, source, now)

    @abstractmethod
    def advance(self, now: float) -> None:
        """Let everything happen that is due by `now`."""

    @abstractmethod
    def next_wake(self) -> float | None:
        """When `advance` has something to do next."""

    @abstractmethod
    def open_paths(self) -> list[bytes]:
        """Paths of the files that are open, as the client named them."""

    @abstractmethod
    def reboot(self, now: float) -> None:
        """Close everything and start afresh at `now`."""

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Return the replies due by `now`."""
        self.advance(now)
        if self._later:
            self._promote(now)
        ready, self._ready = self._ready, []
        self._ready_bytes = 0
        return ready

    @property
    def ready(self) -> int:
        """How many replies wait for the next `outgoing`; those that are due only later do not count."""
        return len(self._ready)

    def next_deadline(self) -> float | None:
        """When `outgoing` may have something, or a timer runs; None if only a request can change anything."""
        if self._ready:
            return self.now
        wake = self.next_wake()
        if self._later:
            due = self._later[0][0]
            return due if wake is None else min(due, wake)
        return wake

    def forget_outbox(self) -> None:
        """Drop what was not sent yet."""
        self._ready = []
        self._ready_bytes = 0
        self._later.clear()

    def _promote(self, now: float) -> None:
        while self._later and self._later[0][0] <= now:
            _, target, wire = self._later.popleft()
            self._ready.append((target, wire))

    def emit(self, target: Address, wire: bytes, due: float, now: float) -> None:
        """Put a reply into the outbox, to leave at `due` (not before earlier ones)."""
        if due > now or self._later:
            self._later.append((due, target, wire))
        else:
            self._ready.append((target, wire))
        if self.tx_room is not None:
            self._ready_bytes += frame_size(wire)

    def room(self) -> int:
        """Bytes free in the link's transmit buffer, less what waits in the outbox. Plenty if `tx_room` is
        None."""
        if self.tx_room is None:
            return 10 * FULL_FRAME + self.profile.tx_buffer
        return self.tx_room() - self._ready_bytes


# -- a server that does what the MAVLink FTP guide says ------------------------------------------------

_BURST_PACKETS = 100
_TICK = 0.010
"""Seconds between two packets of a burst."""
_CODES = {errno.ENOENT: NakCode.FILE_NOT_FOUND, errno.EEXIST: NakCode.FILE_EXISTS}


@dataclass(slots=True)
class _Session:
    """An open file."""

    path: bytes
    file: OpenFile
    writing: bool


@dataclass(slots=True)
class _Stream:
    """A running burst."""

    request: Request
    size: int
    offset: int
    seq: int
    packets: int = 0


class Spec(Firmware):
    """A server that does what the MAVLink FTP guide says and nothing odd.

    Several sessions with ids of its choice (1 and up), exact replays and errnos, bursts of 100 packets.
    """

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        super().__init__(storage, profile, rng)
        self._sessions: dict[int, _Session] = {}
        self._streams: dict[int, _Stream] = {}
        self._tick_at = 0.0
        self._last: dict[Address, tuple[tuple[int, int, int], bytes]] = {}
        self._handlers: dict[int, Callable[[Request], bytes | None]] = {
            Opcode.NONE: lambda request: b"",
            Opcode.TERMINATE_SESSION: self._terminate,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.LIST_DIRECTORY: self._list,
            Opcode.LIST_DIRECTORY_WITH_TIME: self._list,
            Opcode.READ_FILE: self._read,
            Opcode.WRITE_FILE: self._write,
            Opcode.BURST_READ_FILE: self._burst,
            Opcode.REMOVE_FILE: _on_path(storage.unlink),
            Opcode.CREATE_DIRECTORY: _on_path(storage.mkdir),
            Opcode.REMOVE_DIRECTORY: _on_path(storage.rmdir),
            Opcode.RENAME: self._rename,
            Opcode.CALC_FILE_CRC32: lambda request: u32(storage.crc(_path(request))[0]),
        }

    # -- timeline ----------------------------------------------------------------------------

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """See Firmware."""
        self.advance(now)
        request = parse(wire, source)
        key = (request.seq, request.opcode, request.session)
        last = self._last.get(source)
        if last is not None and last[0] == key:
            self.replays += 1
            self.emit(source, last[1], now, now)
            return
        reply = self._answer(request)
        if reply is not None:
            packed = reply.encode()
            self._last[source] = (key, packed)
            self.emit(source, packed, now, now)

    def advance(self, now: float) -> None:
        """See Firmware."""
        self.now = now
        while self._streams and self._tick_at <= now:
            self._tick_at += _TICK
            for session, stream in list(self._streams.items()):
                self._send(session, stream)

    def next_wake(self) -> float | None:
        """See Firmware."""
        return self._tick_at if self._streams else None

    def open_paths(self) -> list[bytes]:
        """See Firmware."""
        return [session.path for session in self._sessions.values()]

    def reboot(self, now: float) -> None:
        """See Firmware."""
        self._close_all()
        self._last.clear()
        self.forget_outbox()

    # -- replies -----------------------------------------------------------------------------

    def _answer(self, request: Request) -> Reply | None:
        reply = Reply(
            request.source, request.seq + 1, request.session, ACK, 0, request.opcode, 0, request.offset, b""
        )
        try:
            data = self._execute(request, reply)
        except Refusal as nak:
            data = nak.data
        except OSError as exc:
            data = _errno_data(exc)
        else:
            if data is None:
                return None
            reply.size, reply.data = len(data), data
            return reply
        reply.opcode, reply.size, reply.data = NAK, len(data), data
        return reply

    def _execute(self, request: Request, reply: Reply) -> bytes | None:
        if request.size > MAX_DATA:
            raise Refusal(NakCode.INVALID_DATA_SIZE)
        if request.opcode in (Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE):
            return self._open(request, reply)
        handler = self._handlers.get(request.opcode)
        if handler is None:
            raise Refusal(NakCode.UNKNOWN_COMMAND)
        return handler(request)

    # -- requests ----------------------------------------------------------------------------

    def _session(self, request: Request) -> _Session:
        session = self._sessions.get(request.session)
        if session is None:
            raise Refusal(NakCode.INVALID_SESSION)
        return session

    def _open(self, request: Request, reply: Reply) -> bytes:
        free = [i for i in range(1, self.profile.sessions + 1) if i not in self._sessions]
        if not free:
            raise Refusal(NakCode.NO_SESSIONS_AVAILABLE)
        path, write = _path(request), request.opcode != Opcode.OPEN_FILE_RO
        create = request.opcode == Opcode.CREATE_FILE
        opened = self.storage.open(path, write=write, create=write, truncate=create)
        self._sessions[free[0]] = _Session(path, opened, write)
        reply.session = free[0]
        return u32(opened.size())

    def _terminate(self, request: Request) -> bytes:
        session = self._session(request)
        del self._sessions[request.session]
        self._streams.pop(request.session, None)
        session.file.close()
        return b""

    def _reset(self, request: Request) -> bytes:
        self._close_all()
        return b""

    def _close_all(self) -> None:
        self._streams.clear()
        for number in list(self._sessions):
            self._sessions.pop(number).file.close()

    def _list(self, request: Request) -> bytes:
        with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
        entries = [entry for entry in self.storage.entries(_path(request)) if _shown(entry)]
        page = bytearray()
        for entry in entries[request.offset :]:
            text = _entry_text(entry, with_time)
            if len(page) + len(text) > MAX_DATA:
                break
            page += text
        if not page:
            raise Refusal(NakCode.EOF)
        return bytes(page)

    def _read(self, request: Request) -> bytes:
        data = self._session(request).file.read(request.offset, request.size)
        if not data and request.size:
            raise Refusal(NakCode.EOF)
        return data

    def _write(self, request: Request) -> bytes:
        session = self._session(request)
        if not session.writing:
            raise Refusal(NakCode.FAIL)
        return u32(session.file.write(request.offset, request.data[: request.size]))

    def _rename(self, request: Request) -> bytes:
        old, _, new = request.data[: request.size].partition(b"\0")
        self.storage.rename(old, c_string(new))
        return b""

    # -- bursts ------------------------------------------------------------------------------

    def _burst(self, request: Request) -> None:
        self._session(request)
        if not self._streams:
            self._tick_at = self.now
        size = request.size or MAX_DATA
        self._streams[request.session] = _Stream(request, size, request.offset, request.seq + 1)

    def _send(self, session: int, stream: _Stream) -> None:
        room = min(self.room(), self.profile.tx_buffer)
        while room >= FULL_FRAME and self._streams.get(session) is stream:
            room -= FULL_FRAME
            self._send_packet(session, stream)

    def _send_packet(self, session: int, stream: _Stream) -> None:
        stream.packets += 1
        reply = Reply(
            stream.request.source, stream.seq, session, ACK, 0, Opcode.BURST_READ_FILE, 0, stream.offset, b""
        )
        try:
            data = self._sessions[session].file.read(stream.offset, stream.size)
            if not data:
                reply.opcode, data = NAK, bytes([NakCode.EOF])
        except OSError as exc:
            reply.opcode, data = NAK, _errno_data(exc)
        reply.burst_complete = int(reply.opcode == NAK or stream.packets == _BURST_PACKETS)
        reply.size, reply.data = len(data), data
        stream.seq += 1
        stream.offset += len(data)
        if reply.burst_complete:
            del self._streams[session]
        self.emit(reply.target, reply.encode(), self.now, self.now)


def _on_path(action: Callable[[bytes], None]) -> Callable[[Request], bytes]:
    def run(request: Request) -> bytes:
        action(_path(request))
        return b""

    return run


def _path(request: Request) -> bytes:
    return c_string(request.data[: request.size])


def _errno_data(exc: OSError) -> bytes:
    if exc.errno in _CODES:
        return bytes([_CODES[exc.errno]])
    return bytes([NakCode.FAIL_ERRNO, (exc.errno or errno.EIO) & 0xFF])


def _shown(entry: Entry) -> bool:
    return entry.stat.kind in (Kind.FILE, Kind.DIRECTORY) and entry.name not in (b".", b"..")


def _entry_text(entry: Entry, with_time: bool) -> bytes:
    name, stat = entry
    if stat.kind is Kind.DIRECTORY:
        return b"D%b\t0\t%d\0" % (name, stat.mtime) if with_time else b"D%b\0" % name
    return b"F%b\t%d\t%d\0" % (name, stat.size, stat.mtime) if with_time else b"F%b\t%d\0" % (name, stat.size)
