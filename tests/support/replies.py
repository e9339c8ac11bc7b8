"""Replies written by hand: what a server might answer to the bytes an engine sent."""

from __future__ import annotations

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload, decode_request, reply_of, split_run


def decode_reply(wire: bytes) -> Payload:
    """Decode a reply's 251 bytes.

    Raises:
        RemoteProtocolError: wrong length, or `size` over 239.
    """
    (fields,) = split_run([wire])
    return reply_of(fields)


def request(
    seq: int, opcode: int, *, session: int = 0, offset: int = 0, data: bytes = b"", size: int | None = None
) -> Payload:
    """Build a request; `size` is len(data) unless given (ReadFile puts the wanted count there)."""
    return Payload(seq, session, opcode, len(data) if size is None else size, 0, 0, offset, data)


def sent(engine: Engine, now: float) -> list[Payload]:
    """Return what the engine sends now, decoded; `data` is cut to `size` where it is data."""
    requests = []
    for wire in engine.outgoing(now):
        request = decode_request(wire)
        carries = request.opcode not in (Opcode.READ_FILE, Opcode.BURST_READ_FILE)
        requests.append(request._replace(data=request.data[: request.size] if carries else b""))
    return requests


def ack(request: Payload, data: bytes = b"", *, offset: int | None = None) -> Payload:
    """Return the ACK to a request; its offset is echoed unless another is given."""
    return Payload(
        (request.seq + 1) & 0xFFFF,
        request.session,
        Opcode.ACK,
        len(data),
        request.opcode,
        0,
        request.offset if offset is None else offset,
        data,
    )


def nak(request: Payload, *codes: int) -> Payload:
    """Return a NAK with these data bytes (the code, perhaps an errno); the offset is 0, as MAVSDK's is."""
    return ack(request, bytes(codes), offset=0)._replace(opcode=int(Opcode.NAK))


def eof(request: Payload) -> Payload:
    """Return NAK EOF."""
    return nak(request, NakCode.EOF)


def chunk(request: Payload, content: bytes) -> Payload:
    """Return the right answer to a ReadFile of a file with this content."""
    data = content[request.offset : request.offset + request.size]
    return ack(request, data) if data else eof(request)


def packet(request: Payload, index: int, data: bytes, *, complete: int = 0) -> Payload:
    """Return packet `index` of the burst that `request` began; full ones have 239 bytes."""
    seq = (request.seq + 1 + index) & 0xFFFF
    offset = request.offset + index * MAX_DATA
    return Payload(seq, 0, Opcode.ACK, len(data), Opcode.BURST_READ_FILE, complete, offset, data)


def burst_nak(request: Payload, index: int, *codes: int) -> Payload:
    """Return a NAK in place of packet `index`."""
    seq = (request.seq + 1 + index) & 0xFFFF
    return Payload(seq, 0, Opcode.NAK, len(codes), Opcode.BURST_READ_FILE, 0, 0, bytes(codes))
