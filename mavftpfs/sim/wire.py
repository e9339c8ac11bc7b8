"""Requests and replies as the simulated servers handle them. Layer: sim; pure.

Not protocol.payload: servers echo fields, leave stray bytes behind `size` and must be fast.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

from mavftpfs.link.messages import Address

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
    req_opcode: int
    burst_complete: int
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
    seq, session, opcode, size, req_opcode, complete, offset = HEADER.unpack_from(wire)
    return Request(seq, session, opcode, size, req_opcode, complete, offset, wire[12:], source)


def c_string(data: bytes) -> bytes:
    """Return what stands before the first NUL."""
    return data.partition(b"\0")[0]


def frame_size(wire: bytes) -> int:
    """Return how long a MAVLink 2 frame of this payload is: trailing zeros are not sent."""
    return FRAME_OVERHEAD + 3 + len(wire.rstrip(b"\0"))


def u32(value: int) -> bytes:
    """Return four bytes, little-endian, modulo 2^32 as the servers do."""
    return (value & 0xFFFFFFFF).to_bytes(4, "little")
