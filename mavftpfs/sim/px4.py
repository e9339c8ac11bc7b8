"""PX4's FTP server. Layer: sim; pure. Source: mavlink_ftp.cpp, servers.md 1-13 and 15.

All clients on the link share one session. Requests run in the receiver thread, which also sends bursts every
10 ms. Directory and path requests are in px4ops.
"""

from __future__ import annotations

import contextlib
import errno
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim import px4ops
from mavftpfs.sim.firmware import (
    ACK,
    FULL_FRAME,
    HEADER,
    HEADER_SIZE,
    NAK,
    REPLY,
    Refusal,
    Request,
    frame_size,
    parse,
)
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import NoErrno, Storage
from mavftpfs.sim.tree import OpenFile

_Fields = tuple[int, int, int, int, int, int, int]
_BUFFER_LIFE = 2.0
_TICK = 0.010
"""Period of the loop that sends bursts, in seconds."""
_BURST_BYTES = 35_000
"""A burst ends with the first tick that ends beyond this."""
_GARBAGE_COMPLETE = 0.1
"""Chance of a spurious burst_complete on a packet that is alone in its tick."""
_CACHED_DATA = 4
_READ = int(Opcode.READ_FILE)
_WRITE = int(Opcode.WRITE_FILE)
_BURST = int(Opcode.BURST_READ_FILE)
_EOF = int(NakCode.EOF)
_FAIL_ERRNO = int(NakCode.FAIL_ERRNO)
_COUNT_SIZE = 4
_NOT_KEPT = int(NakCode.NO_SESSIONS_AVAILABLE)
"""PX4 does not keep short answers with this first byte for a repeated request, NAK or not."""

Replies = list[tuple[Address, bytes]]


@dataclass(slots=True)
class Stream:
    """A running burst. most: bytes of a packet. sent: bytes."""

    target: Address
    offset: int
    seq: int
    most: int
    sent: int = 0

    def read(self, opened: OpenFile, *, last: bool, alone: bool, rng: random.Random) -> bytes:
        """Return the next packet; `complete` tells whether it ends the burst.

        last, alone: the packet is the tick's last one, its only one.

        Raises:
            OSError: reading failed.
        """
        data = opened.read(self.offset, self.most)
        self.sent += len(data)
        over = self.is_over(last)
        # The server does not write the field on a tick's last packet; only then is it the stack's garbage.
        garbage = last and alone and not over and rng.random() < _GARBAGE_COMPLETE
        packed = self._pack(ACK, int(over or garbage), data)
        self.offset += len(data)
        return packed

    def is_over(self, last: bool) -> bool:
        """Return whether the packet before was the last one."""
        return last and self.sent > _BURST_BYTES

    def end(self, code: int, number: int) -> bytes:
        """Return the NAK that ends the burst; number: errno."""
        return self._pack(NAK, 0, bytes([code, number & 0xFF] if code == NakCode.FAIL_ERRNO else [code]))

    def _pack(self, opcode: int, complete: int, data: bytes) -> bytes:
        seq = self.seq & 0xFFFF
        self.seq += 1
        return REPLY.pack(seq, 0, opcode, len(data), Opcode.BURST_READ_FILE, complete, self.offset, data)


# A fast link carries hundreds of thousands of ReadFile or WriteFile requests a second. So the server checks a
# row of like requests once. The first different request ends the row, and is handled as usual.


def read_row(
    wires: Sequence[bytes], opened: OpenFile, size: int, least: int, source: Address, replies: Replies
) -> int:
    """Answer ReadFile requests of session 0; return their number.

    size: of the file at its opening. least: bytes of each answer.
    """
    unpack, pack, read, append = HEADER.unpack_from, REPLY.pack, opened.read, replies.append
    for count, wire in enumerate(wires):
        seq, session, opcode, wanted, _, complete, offset = unpack(wire)
        if opcode != _READ or session or wanted > MAX_DATA or offset >= size:
            return count
        try:
            data = read(offset, wanted)
        except OSError:
            return count
        if len(data) < least:
            return count
        append((source, pack(seq + 1 & 0xFFFF, 0, ACK, len(data), _READ, complete, offset, data)))
    return len(wires)


def write_row(wires: Sequence[bytes], opened: OpenFile, source: Address, replies: Replies) -> int:
    """Answer WriteFile requests of session 0; return their number. None of them may repeat the one before
    it."""
    unpack, pack, write, append = HEADER.unpack_from, REPLY.pack, opened.write, replies.append
    answered = -1
    for count, wire in enumerate(wires):
        seq, session, opcode, size, _, complete, offset = unpack(wire)
        if opcode != _WRITE or session or not 0 < size <= MAX_DATA or seq + 1 == answered:
            return count
        try:
            written = write(offset, wire[HEADER_SIZE : HEADER_SIZE + size])
        except OSError:
            return count
        answered = seq + 1 & 0xFFFF
        number = written.to_bytes(_COUNT_SIZE, "little")
        append((source, pack(answered, 0, ACK, _COUNT_SIZE, _WRITE, complete, offset, number)))
        if written == _NOT_KEPT:
            answered = -1
    return len(wires)


class Px4(px4ops.PathRequests):
    """One instance, as each MAVLink link of a vehicle has one."""

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        super().__init__(storage, profile, rng)
        self._file: OpenFile | None = None
        self._path = b""
        self._file_size = 0
        self._writing = False
        self._stream: Stream | None = None
        self._cached: bytes | None = None
        self._cached_seq = -1
        self._cached_target = Address(0, 0)
        self._last_request = 0.0
        self._started: float | None = None
        self._tick = 0
        self._busy_until = float("-inf")
        self._pending: deque[tuple[bytes, Address]] = deque()
        self._pending_bytes = 0
        self._has_cost = bool(profile.request_cost or profile.stall_chance)
        self._idle_close = float("inf") if profile.idle_close is None else profile.idle_close
        self._handlers |= {
            Opcode.NONE: lambda request: request.data[: request.size],
            Opcode.TERMINATE_SESSION: self._terminate,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.OPEN_FILE_RO: self._open_read,
            Opcode.CREATE_FILE: self._create,
            Opcode.OPEN_FILE_WO: self._open_write,
            Opcode.BURST_READ_FILE: self._burst,
            Opcode.READ_FILE: self._refuse_read,
        }

    # -- timeline ----------------------------------------------------------------------------

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """See Firmware."""
        if self._started is None:
            self._started = now
        if self._stream is None and not self._pending and now < self._last_request + self._idle_close:
            self.now = now  # and nothing is due
        else:
            self.advance(now)
        if self._busy_until > now:
            self._wait(wire, source)
        else:
            self._execute(wire, source, now)

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """See Firmware."""
        served, least = 0, _CACHED_DATA + 1
        if wires and self._file is not None and self._is_plain(wires[0], now):
            if self._writing:
                served = write_row(wires, self._file, source, self._ready)
            else:
                served = read_row(wires, self._file, self._file_size, least, source, self._ready)
        if served:
            self.now = self._last_request = now
            self._cached = None
            self._keep(source, self._ready[-1][1])
        super().handle_run(wires[served:], source, now)

    def _is_plain(self, wire: bytes, now: float) -> bool:
        """Return whether the server answers a row that begins with this request at once, with nothing else
        due."""
        idle = self._stream is None and not self._pending and not self._later and self.tx_room is None
        lately = now - self._last_request <= _BUFFER_LIFE and now < self._last_request + self._idle_close
        quick = not self._has_cost and not self._extra_cost and self._busy_until <= now
        if not (idle and lately and quick and self._started is not None):
            return False
        repeated = self._cached is not None and HEADER.unpack_from(wire)[0] + 1 == self._cached_seq
        named = self._path if self.profile.of_2026 else self.scratch
        return not repeated and not (self._writing and self.is_protected(named))

    def _wait(self, wire: bytes, source: Address) -> None:
        size = frame_size(wire)
        if self._pending_bytes + size > self.profile.rx_buffer:
            self.dropped_requests += 1
            return
        self._pending.append((wire, source))
        self._pending_bytes += size

    def advance(self, now: float) -> None:
        """See Firmware."""
        self.now = now
        while (wake := self.next_wake()) is not None and wake <= now:
            if self._pending and self._busy_until <= wake:
                wire, source = self._pending.popleft()
                self._pending_bytes -= frame_size(wire)
                self._execute(wire, source, wake)
            elif self._idle_deadline() <= wake:
                self._close_idle()
            else:
                self._send(wake)

    def next_wake(self) -> float | None:
        """See Firmware."""
        if self._pending:
            return self._busy_until
        if self._stream is not None:
            return min(self._next_tick(), self._idle_deadline())
        return self._idle_deadline() if self._file is not None else None

    def _idle_deadline(self) -> float:
        return float("inf") if self._file is None else self._last_request + self._idle_close

    def _next_tick(self) -> float:
        start = self._started or 0.0
        return max(start + self._tick * _TICK, self._busy_until)

    def _tick_after(self, now: float) -> int:
        start = self._started or 0.0
        tick = int((now - start) / _TICK) + 1
        return tick + 1 if start + tick * _TICK <= now else tick  # rounding

    def _execute(self, wire: bytes, source: Address, now: float) -> None:
        seq, session, opcode, size, _, _, offset = fields = HEADER.unpack_from(wire)
        if now - self._last_request > _BUFFER_LIFE and not self.profile.of_2026:
            self.scratch = b""  # freed, and allocated again without initialisation
        self._last_request = now
        if size > MAX_DATA:
            self._reply(source, wire, self._refuse(NakCode.INVALID_DATA_SIZE), now)
        elif self._is_cached(seq, source):
            self._replay(now)
        elif opcode == _READ and self._readable(session, offset):
            self._read(wire, fields, source, now)
        elif opcode == _WRITE:
            self._write(wire, fields, source, now)
        else:
            self._dispatch(parse(wire, source), wire, now)

    def _is_cached(self, seq: int, source: Address) -> bool:
        """Return whether the last answer was to a request with this number."""
        if self._cached is None or seq + 1 != self._cached_seq:
            return False
        return source == self._cached_target or not self.profile.of_2026

    def _dispatch(self, request: Request, wire: bytes, now: float) -> None:
        try:
            handler = self._handlers.get(request.opcode)
            if handler is None:
                raise Refusal(NakCode.UNKNOWN_COMMAND)
            data = handler(request)
        except Refusal as refusal:
            self._reply(request.source, wire, self._refuse(refusal.code), now)
            return
        except OSError as exc:
            self._reply(request.source, wire, self._failed(exc), now)
            return
        self._cached = None
        if request.opcode != _BURST:
            self._reply(request.source, wire, data, now, ack=True)

    # -- replies -----------------------------------------------------------------------------

    def _refuse(self, code: int) -> bytes:
        return px4ops.nak_data(code, self._errno)

    def _failed(self, exc: OSError) -> bytes:
        if not isinstance(exc, NoErrno) and exc.errno is not None:
            self._errno = exc.errno
        return self._refuse(_FAIL_ERRNO)

    def _reply(self, target: Address, wire: bytes, data: bytes, now: float, ack: bool = False) -> None:
        """Answer a request. PX4 writes into the request's buffer, so it echoes the other fields."""
        seq, session, opcode, _, _, complete, offset = HEADER.unpack_from(wire)
        if ack and opcode in (Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE):
            session = 0
        self._cached = None
        header = (seq + 1 & 0xFFFF, session, ACK if ack else NAK, len(data), opcode, complete, offset)
        self._deliver(target, REPLY.pack(*header, data), now)

    def _deliver(self, target: Address, wire: bytes, now: float) -> None:
        self._keep(target, wire)
        self._transmit(target, wire, now)

    def _keep(self, target: Address, wire: bytes) -> None:
        size = wire[4]
        if size <= _CACHED_DATA and not (size and wire[12] == _NOT_KEPT):
            self._cached = wire[: 12 + _CACHED_DATA]
            self._cached_seq = wire[0] | wire[1] << 8
            self._cached_target = target

    def _transmit(self, target: Address, wire: bytes, now: float) -> None:
        due = now
        if self._has_cost or self._extra_cost:
            due = self._busy_until = now + self.cost(wire[5])
        if self.tx_room is not None and self.room() < frame_size(wire):
            self.dropped_replies += 1
        else:
            self.emit(target, wire, due, self.now)

    def _replay(self, now: float) -> None:
        """Send the last answer again. PX4 before September 2026 sends 254 bytes from a cache of 19, so stray
        memory follows the data."""
        assert self._cached is not None
        self.replays += 1
        missing = MAX_DATA - _CACHED_DATA
        behind = bytes(missing) if self.profile.of_2026 else self.rng.randbytes(missing)
        self._transmit(self._cached_target, self._cached + behind, now)

    def cost(self, opcode: int) -> float:
        """Return the seconds that the present request takes."""
        cost = self.profile.request_cost + self._extra_cost
        self._extra_cost = 0.0
        if opcode in (_READ, _WRITE):
            hit = self.rng.random() < self.profile.stall_chance
            self.pauses.append(self.rng.uniform(*self.profile.stall) if hit else 0.0)
            cost += self.pauses[-1]
        return cost

    # -- the session -------------------------------------------------------------------------

    def open_paths(self) -> list[bytes]:
        """See Firmware."""
        return [] if self._file is None else [self._path]

    def reboot(self, now: float) -> None:
        """See Firmware."""
        self._close()
        self.forget_outbox()
        self._pending.clear()
        self._pending_bytes = 0
        self._cached = None
        self._errno = 0
        self._file_size = 0
        self._busy_until = float("-inf")
        self._started = now
        self._tick = 0

    def _close(self) -> None:
        opened, self._file = self._file, None
        self._stream = None
        if opened is not None:
            with contextlib.suppress(OSError):  # PX4 ignores this error
                opened.close()

    def _close_idle(self) -> None:
        self._close()
        self._cached = None

    def _terminate(self, request: Request) -> bytes:
        if request.session != 0 or self._file is None:
            raise Refusal(NakCode.INVALID_SESSION)
        self._close()
        return b""

    def _reset(self, request: Request) -> bytes:
        self._close()
        return b""

    def _open_read(self, request: Request) -> bytes:
        return self._open(self.path_of(request), write=False, create=False, truncate=False)

    def _create(self, request: Request) -> bytes:
        return self._open(self.path_of(request), write=True, create=True, truncate=True)

    def _open_write(self, request: Request) -> bytes:
        return self._open(self.path_of(request), write=True, create=True, truncate=False)

    def _open(self, path: bytes, *, write: bool, create: bool, truncate: bool) -> bytes:
        """Open a file. The ACK reports the size before a truncation, and later reads end at that size."""
        if self._file is not None:
            if not self.profile.of_2026:
                raise Refusal(NakCode.NO_SESSIONS_AVAILABLE)
            self._close()
        self.scratch = path
        size, opened = px4ops.open_file(self.storage, path, write=write, create=create, truncate=truncate)
        self._file, self._path, self._file_size, self._writing = opened, path, size, write
        self._stream = None
        return (size & 0xFFFFFFFF).to_bytes(4, "little")

    # -- reading and writing -----------------------------------------------------------------

    def _readable(self, session: int, offset: int) -> bool:
        return session == 0 and self._file is not None and not self._writing and offset < self._file_size

    def _read(self, wire: bytes, fields: _Fields, source: Address, now: float) -> None:
        assert self._file is not None
        seq, session, opcode, size, _, complete, offset = fields
        try:
            data = self._file.read(offset, size)
            if not data and self.profile.of_2026:
                raise Refusal(_EOF)
        except Refusal as refusal:
            self._reply(source, wire, self._refuse(refusal.code), now)
            return
        except OSError as exc:
            self._reply(source, wire, self._failed(exc), now)
            return
        self._cached = None
        packed = REPLY.pack(seq + 1 & 0xFFFF, session, ACK, len(data), opcode, complete, offset, data)
        self._deliver(source, packed, now)

    def _refuse_read(self, request: Request) -> bytes:
        """Return the NAK of a ReadFile that cannot be served, or raise it."""
        if request.session != 0 or self._file is None:
            raise Refusal(NakCode.INVALID_SESSION)
        if request.offset >= self._file_size:
            raise Refusal(_EOF)
        nuttx = bool(self.profile.writable_root)
        raise OSError(errno.EACCES if nuttx else errno.EBADF, "opened for writing")

    def _check_session(self, session: int) -> None:
        if self._file is None and (session != 0 or self.profile.of_2026):
            raise Refusal(NakCode.INVALID_SESSION)

    def _write(self, wire: bytes, fields: _Fields, source: Address, now: float) -> None:
        seq, session, opcode, size, _, complete, offset = fields
        try:
            self._check_write(session)
            assert self._file is not None
            written = self._file.write(offset, wire[12 : 12 + size]) if size else 0
        except Refusal as refusal:
            self._reply(source, wire, self._refuse(refusal.code), now)
            return
        except OSError as exc:
            self._reply(source, wire, self._failed(exc), now)
            return
        count = written.to_bytes(4, "little")
        self._cached = None
        packed = REPLY.pack(seq + 1 & 0xFFFF, session, ACK, 4, opcode, complete, offset, count)
        self._deliver(source, packed, now)

    def _check_write(self, session: int) -> None:
        self._check_session(session)
        self.check_writable(self._path if self.profile.of_2026 else self.scratch)
        if self._file is None or not self._writing:
            raise OSError(errno.EBADF, "not open for writing")

    # -- bursts ------------------------------------------------------------------------------

    def _burst(self, request: Request) -> bytes:
        """Start a burst. Some versions accept session 0 with no file open. The request's size is ignored."""
        self._check_session(request.session)
        self._stream = Stream(request.source, request.offset, request.seq + 1, self.profile.longest_reply)
        self._tick = max(self._tick, self._tick_after(self._last_request))
        return b""

    def _send(self, now: float) -> None:
        """Send as many burst packets as the transmit buffer takes in this tick."""
        self._tick = self._tick_after(now)
        room = min(self.room(), self.profile.tx_buffer)
        alone = room < 2 * FULL_FRAME
        while room >= FULL_FRAME and self._stream is not None:
            last = room < 2 * FULL_FRAME
            self._send_packet(self._stream, now, last, alone)
            if last:
                return
            room -= FULL_FRAME

    def _send_packet(self, stream: Stream, now: float, last: bool, alone: bool) -> None:
        try:
            if stream.offset >= self._file_size:
                raise Refusal(_EOF)
            if self._file is None:
                raise Refusal(_FAIL_ERRNO)
            packed = stream.read(self._file, last=last, alone=alone, rng=self.rng)
            if stream.is_over(last):
                self._stream = None
        except (Refusal, OSError) as exc:
            code = exc.code if isinstance(exc, Refusal) else _FAIL_ERRNO
            number = exc.errno if isinstance(exc, OSError) and exc.errno else self._errno
            packed, self._stream = stream.end(code, number), None
        self._deliver(stream.target, packed, now)
