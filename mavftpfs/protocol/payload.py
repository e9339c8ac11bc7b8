"""The 251-byte body of FILE_TRANSFER_PROTOCOL (message 110), and the CRC of files. Layer: protocol; pure.

Layout (MAVLink FTP guide, "Payload Format"): seq u16 LE, session, opcode, size, req_opcode,
burst_complete, padding, offset u32 LE, then up to 239 bytes of data. Own enums, because pymavlink's
dialects lack opcode 16.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from mavftpfs.shared.errors import RemoteProtocolError

PAYLOAD_SIZE = 251
HEADER_SIZE = 12
MAX_DATA = 239

_HEADER = struct.Struct("<HBBBBBxI")
_WHOLE = struct.Struct(f"<HBBBBBxI{MAX_DATA}s")
_ZEROS = bytes(PAYLOAD_SIZE)
_new = tuple.__new__  # once per chunk: a NamedTuple's own costs twice as much


class Opcode(IntEnum):
    """Request opcodes 0..16 and the two reply opcodes."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    LIST_DIRECTORY_WITH_TIME = 16
    ACK = 128
    NAK = 129


class NakCode(IntEnum):
    """First data byte of a NAK."""

    NONE = 0
    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    EOF = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class Payload(NamedTuple):
    """A decoded payload.

    `size` is the header field. In a reply `data` is exactly `size` bytes: what servers leave behind
    it is stray memory (servers.md 2). In a decoded request `data` is the whole 239-byte field,
    because old ArduPilot servers look past `size` (servers.md 13).
    """

    seq: int
    session: int
    opcode: int
    size: int
    req_opcode: int = 0
    burst_complete: int = 0
    offset: int = 0
    data: bytes = b""

    def encode(self) -> bytes:
        """Return the 251 wire bytes, zero-filled behind the data."""
        return _HEADER.pack(*self[:7]) + self.data + _ZEROS[HEADER_SIZE + len(self.data) :]


Fields: TypeAlias = tuple[int, int, int, int, int, int, int, bytes]
"""The fields of a Payload as a plain tuple; `data` is the whole field of 239 bytes, `size` is not checked."""


def split_run(wires: Sequence[bytes]) -> list[Fields]:
    """Return the fields of several payloads of 251 bytes, at a third of what decoding them one by one costs.

    Raises:
        RemoteProtocolError: they are not of that length.
    """
    joined = b"".join(wires)
    if len(joined) != PAYLOAD_SIZE * len(wires):
        raise RemoteProtocolError(f"payloads that are not of {PAYLOAD_SIZE} bytes")
    return list(_WHOLE.iter_unpack(joined))


def reply_of(fields: Fields) -> Payload:
    """Return a reply from its fields.

    Raises:
        RemoteProtocolError: `size` over 239.
    """
    size = fields[3]
    if size > MAX_DATA:
        raise RemoteProtocolError(f"reply says it holds {size} bytes of data, more than {MAX_DATA}")
    return _new(Payload, (*fields[:7], fields[7][:size]))


def decode_request(wire: bytes) -> Payload:
    """Decode a request's 251 bytes, as a server does; `data` is all 239 bytes.

    Raises:
        RemoteProtocolError: wrong length. An oversize `size` is left for the server to refuse.
    """
    if len(wire) != PAYLOAD_SIZE:
        raise RemoteProtocolError(f"payload of {len(wire)} bytes, {PAYLOAD_SIZE} expected")
    fields: tuple[int, int, int, int, int, int, int] = _HEADER.unpack_from(wire)
    return Payload(*fields, wire[HEADER_SIZE:])


def crc32(data: bytes | bytearray | memoryview, previous: int = 0) -> int:
    """Return the CRC32 of `data` as CalcFileCRC32 defines it, continued from `previous` (0 at the start).

    Reflected polynomial 0xEDB88320, start value 0, no final xor, on every server (servers.md 10), so
    leading zero bytes do not change it: always compare sizes too.
    """
    return zlib.crc32(data, previous ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
