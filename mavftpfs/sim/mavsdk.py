"""MAVSDK's FTP server. Layer: sim; pure. Source: mavlink_ftp_server.cpp, servers.md 1-10, a recording.

All clients share one read stream, one write stream and one file size. The server has a thread for bursts, and
no replay slot. Fields that a handler does not set are 0 in the reply. The server ignores a request that it
does not understand.
"""

from __future__ import annotations

import errno
import random
from collections.abc import Callable
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim.firmware import ACK, HEADER, NAK, REPLY, Firmware, Refusal, Request, parse, u32
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import Storage
from mavftpfs.sim.tree import Kind, OpenFile, Stat, TreeEntry

_READ = int(Opcode.READ_FILE)
_BURST = int(Opcode.BURST_READ_FILE)
_IO_ERROR = 201


class Silence(Exception):
    """The server sends no answer."""


@dataclass(slots=True)
class _ReadStream:
    """A C++ ifstream: one position for all readers; a failed read may spoil it."""

    path: bytes
    file: OpenFile
    position: int = 0
    failed: bool = False

    def seek(self, offset: int) -> None:
        """Go to the offset and clear a failure."""
        self.failed = False
        self.position = offset

    def read(self, size: int) -> bytes | None:
        """Return exactly `size` bytes, or None and fail."""
        if self.failed:
            return None
        data = self.file.read(self.position, size)
        self.position += len(data)
        self.failed = len(data) < size
        return None if self.failed else data


@dataclass(slots=True)
class _WriteStream:
    """A C++ ofstream: the last write stays in its buffer until the next one or close."""

    path: bytes
    file: OpenFile
    tail: tuple[int, bytes] = (0, b"")
    failed: bool = False

    def flush(self) -> None:
        """Write the tail. The server notices a full card only at the next write, or never."""
        offset, data = self.tail
        self.tail = (0, b"")
        try:
            if data and self.file.write(offset, data) < len(data):
                self.failed = True
        except OSError:
            self.failed = True

    def close(self) -> None:
        """Write the tail and close; errors are lost."""
        self.flush()
        self.file.close()


@dataclass(slots=True)
class _Burst:
    """The burst thread."""

    seq: int
    size: int
    offset: int
    due: float
    packets: int = 0


class Mavsdk(Firmware):
    """One server component."""

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        super().__init__(storage, profile, rng)
        self._reader: _ReadStream | None = None
        self._writer: _WriteStream | None = None
        self._file_size = 0
        self._burst: _Burst | None = None
        self._client = Address(0, 0)
        self._busy_until = float("-inf")
        self._handlers: dict[int, Callable[[Request], bytes]] = {
            Opcode.TERMINATE_SESSION: self._reset,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.LIST_DIRECTORY: self._list,
            Opcode.OPEN_FILE_RO: self._open_read,
            Opcode.READ_FILE: self._read,
            Opcode.CREATE_FILE: self._create,
            Opcode.OPEN_FILE_WO: self._open_write,
            Opcode.WRITE_FILE: self._write,
            Opcode.REMOVE_FILE: self._remove,
            Opcode.REMOVE_DIRECTORY: self._remove,
            Opcode.CREATE_DIRECTORY: self._mkdir,
            Opcode.RENAME: self._rename,
            Opcode.CALC_FILE_CRC32: self._crc,
            Opcode.BURST_READ_FILE: self._start_burst,
        }
        if profile.list_with_time:
            self._handlers[Opcode.LIST_DIRECTORY_WITH_TIME] = self._list

    # -- timeline ----------------------------------------------------------------------------

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """See Firmware. A checksum blocks the handler thread; other requests wait without limit."""
        self.advance(now)
        start = max(now, self._busy_until)
        seq, _, opcode, size, _, _, _ = HEADER.unpack_from(wire)
        if size > MAX_DATA:
            self._send(NAK, opcode, seq + 1, 0, bytes([NakCode.INVALID_DATA_SIZE]), start)
            return
        self._client = source
        handler = self._handlers.get(opcode)
        if handler is None:
            return
        self._answer(handler, parse(wire, source), start)

    def _answer(self, handler: Callable[[Request], bytes], request: Request, start: float) -> None:
        opcode, data = ACK, b""
        try:
            data = handler(request)
        except Refusal as nak:
            opcode, data = NAK, nak.data
        except OSError:
            opcode, data = NAK, bytes([NakCode.FAIL])
        except Silence:
            return
        offset = request.offset if opcode == ACK and request.opcode == _READ else 0
        due = max(start, self._busy_until)
        self._send(opcode, request.opcode, request.seq + 1, offset, data, due)

    def _send(self, opcode: int, req_opcode: int, seq: int, offset: int, data: bytes, due: float) -> None:
        wire = REPLY.pack(seq & 0xFFFF, 0, opcode, len(data), req_opcode, 0, offset, data)
        self.emit(self._client, wire, due, self.now)

    def advance(self, now: float) -> None:
        """See Firmware."""
        self.now = now
        while self._burst is not None and self._burst.due <= now:
            self._send_packet(self._burst)

    def next_wake(self) -> float | None:
        """See Firmware."""
        return None if self._burst is None else self._burst.due

    def open_paths(self) -> list[bytes]:
        """See Firmware."""
        return [stream.path for stream in (self._reader, self._writer) if stream is not None]

    def reboot(self, now: float) -> None:
        """See Firmware."""
        self._die()
        self.forget_outbox()
        self._file_size = 0
        self._busy_until = float("-inf")

    def _die(self) -> None:
        """Lose the streams and their buffered bytes."""
        if self._writer is not None:
            self._writer.tail = (0, b"")
        self._close()

    def _close(self) -> None:
        self._burst = None
        reader, self._reader = self._reader, None
        writer, self._writer = self._writer, None
        if reader is not None:
            reader.file.close()
        if writer is not None:
            writer.close()

    # -- paths -------------------------------------------------------------------------------

    @staticmethod
    def _path(request: Request, entry: int = 0) -> bytes:
        """Return a path below the root, normalised by its text; `..` out of the root is refused."""
        fields = request.data[: request.size].split(b"\0")
        field = fields[entry] if entry < len(fields) else b""
        names: list[bytes] = []
        for name in field.split(b"/"):
            if name == b"..":
                if not names:
                    raise Refusal(NakCode.FAIL)
                names.pop()
            elif name not in (b"", b"."):
                names.append(name)
        return b"/" + b"/".join(names)

    def _existing(self, path: bytes) -> Stat:
        try:
            return self.storage.stat(path)
        except OSError as exc:
            raise Refusal(NakCode.FILE_NOT_FOUND) from exc

    # -- directories -------------------------------------------------------------------------

    def _list(self, request: Request) -> bytes:
        """List from a raw index. For a regular file the server raises an exception and does not catch it, so
        the process ends."""
        path = self._path(request)
        if self._existing(path).kind is not Kind.DIRECTORY:
            self.crashed = True
            self._die()
            raise Silence
        with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
        entries = [entry for entry in self.storage.entries(path) if entry.name not in (b".", b"..")]
        page = bytearray()
        for entry in entries[request.offset :]:
            text = self._entry_text(path, entry, with_time)
            if len(page) + len(text) > MAX_DATA:
                break
            page += text
        if not page:
            raise Refusal(NakCode.EOF)
        return bytes(page)

    def _entry_text(self, directory: bytes, entry: TreeEntry, with_time: bool) -> bytes:
        """Format an entry, symlinks followed. Anything but a file or directory is left out, but counted."""
        try:
            stat = self.storage.stat(directory + b"/" + entry.name)
        except OSError:
            return b""
        if stat.kind is Kind.FILE:
            text = b"F%b\t%d" % (entry.name, stat.size)
        elif stat.kind is Kind.DIRECTORY:
            text = b"D%b\t0" % entry.name if with_time else b"D" + entry.name
        else:
            return b""
        return text + (b"\t%d\0" % max(stat.mtime, 0) if with_time else b"\0")

    def _remove(self, request: Request) -> bytes:
        """Remove a file or an empty directory, for either of the two requests."""
        path = self._path(request)
        self._existing(path)
        try:
            self.storage.rmdir(path)
        except NotADirectoryError:
            self.storage.unlink(path)
        return b""

    def _mkdir(self, request: Request) -> bytes:
        path = self._path(request)
        try:
            self.storage.mkdir(path)
        except FileExistsError as exc:
            raise Refusal(NakCode.FILE_EXISTS) from exc
        except OSError as exc:
            raise Refusal(NakCode.FAIL_ERRNO, (exc.errno or errno.EIO) & 0xFF) from exc
        return b""

    def _rename(self, request: Request) -> bytes:
        old, new = self._path(request), self._path(request, 1)
        self._existing(old)
        self.storage.rename(old, new)
        return b""

    def _crc(self, request: Request) -> bytes:
        path = self._path(request)
        if self._existing(path).kind is not Kind.FILE:
            raise Refusal(_IO_ERROR)
        checksum, size = self.storage.crc(path)
        self._busy_until = max(self._busy_until, self.now) + size / self.profile.crc_rate
        return u32(checksum)

    # -- the two streams ---------------------------------------------------------------------

    def _reset(self, request: Request) -> bytes:
        self._close()
        return b""

    def _open_read(self, request: Request) -> bytes:
        if self._reader is not None:
            self._close()
        path = self._path(request)
        stat = self._existing(path)
        if stat.kind is not Kind.FILE:
            raise Silence
        self._reader = _ReadStream(path, self.storage.open(path))
        self._file_size = stat.size & 0xFFFFFFFF
        return u32(self._file_size)

    def _open_write(self, request: Request) -> bytes:
        """Open for writing: the file must exist and is emptied; the ACK reports its old size."""
        if self._writer is not None:
            self._close()
        path = self._path(request)
        stat = self._existing(path)
        if stat.kind is not Kind.FILE:
            raise Silence
        opened = self.storage.open(path, write=True, truncate=self.profile.write_only_truncates)
        self._writer = _WriteStream(path, opened)
        self._file_size = stat.size & 0xFFFFFFFF
        return u32(self._file_size)

    def _create(self, request: Request) -> bytes:
        if self._writer is not None:
            self._close()
        path = self._path(request)
        opened = self.storage.open(path, write=True, create=True, truncate=True)
        self._writer = _WriteStream(path, opened)
        self._file_size = 0
        return b""

    def _seek(self, request: Request) -> _ReadStream:
        """Set the one read position; a wrong session closes everything first."""
        if request.session != 0 or self._reader is None:
            self._close()
        if request.offset >= self._file_size:
            raise Refusal(NakCode.EOF)
        if self._reader is None:
            raise Refusal(NakCode.FAIL)
        self._reader.seek(request.offset)
        return self._reader

    def _read(self, request: Request) -> bytes:
        """Read exactly `size` bytes; a read that crosses the end fails."""
        data = self._seek(request).read(request.size)
        if data is None:
            raise Refusal(NakCode.FAIL)
        return data

    def _write(self, request: Request) -> bytes:
        if request.session != 0 and self._writer is None:
            self._close()
        writer = self._writer
        if writer is None:
            raise Refusal(NakCode.FAIL)
        writer.flush()
        if writer.failed:
            raise Refusal(NakCode.FAIL)
        writer.tail = (request.offset, request.data[: request.size])
        return b""

    # -- bursts ------------------------------------------------------------------------------

    def _start_burst(self, request: Request) -> bytes:
        self._seek(request)
        due = self.now + self.profile.burst_interval
        self._burst = _Burst(request.seq + 1, request.size, request.offset, due)
        raise Silence

    def _send_packet(self, burst: _Burst) -> None:
        """Send the next packet from the stream's present position, which other requests may have moved."""
        due = burst.due
        burst.due += self.profile.burst_interval
        burst.packets += 1
        opcode, data, complete = ACK, self._burst_data(burst), 0
        offset = burst.offset
        full = burst.packets >= self.profile.burst_packets
        if data is None:
            opcode, data, offset = NAK, bytes([NakCode.FAIL]), 0
        else:
            burst.offset += len(data)
            complete = int(burst.offset == self._file_size or full)
        wire = REPLY.pack(burst.seq & 0xFFFF, 0, opcode, len(data), _BURST, complete, offset, data)
        burst.seq += 1
        if complete or full:
            self._burst = None
        self.emit(self._client, wire, max(due, self._busy_until), self.now)

    def _burst_data(self, burst: _Burst) -> bytes | None:
        if self._reader is None:
            return None
        wanted = min(burst.size, max(0, self._file_size - burst.offset))
        try:
            return self._reader.read(wanted)
        except OSError:
            return None
