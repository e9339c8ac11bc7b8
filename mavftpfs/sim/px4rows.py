"""Rows of requests that came together, as PX4 answers them one by one. Layer: sim; pure.

A transfer is hundreds of thousands of ReadFile or WriteFile requests a second on a fast link. What a row of
them needs is looked at once; the first that is not like the others ends it, and goes the usual way.
"""

from __future__ import annotations

from collections.abc import Sequence

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim.storage import OpenFile
from mavftpfs.sim.wire import ACK, HEADER, HEADER_SIZE, REPLY

_READ = int(Opcode.READ_FILE)
_WRITE = int(Opcode.WRITE_FILE)
_COUNT_SIZE = 4
NOT_KEPT = int(NakCode.NO_SESSIONS_AVAILABLE)
"""First byte of short answers that PX4 does not keep for a repeated request, a NAK's or not."""

Replies = list[tuple[Address, bytes]]


def read_row(
    wires: Sequence[bytes], opened: OpenFile, size: int, least: int, source: Address, replies: Replies
) -> int:
    """Answer ReadFile requests of session 0; return how many.

    size: of the file, as it was opened. least: bytes that each answer has.
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
    """Answer WriteFile requests of session 0; return how many. None of them repeats the one before it."""
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
        if written == NOT_KEPT:
            answered = -1
    return len(wires)
