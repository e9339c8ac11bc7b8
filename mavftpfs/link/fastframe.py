"""FILE_TRANSFER_PROTOCOL frames, built and parsed by hand. Layer: link; pure, no pymavlink.

pymavlink needs about 16 µs to build such a frame and 8 µs to parse one, which makes the codec the bottleneck
of a transfer. These functions do the one case that carries all the data: message 110, MAVLink 2, unsigned.
`framing` and pymavlink do all others, and a property test compares the two byte by byte. `framing` passes the
message's extra CRC byte in, which it takes from pymavlink's dialect.

Layout (MAVLink guide, "Packet Serialization"): FD, payload length, incompat flags, compat flags, seq,
system, component, message id u24 LE, payload with trailing zeros cut (never to nothing), CRC-16/MCRF4XX
of all but the first byte and of the extra byte. Payload of 110: target network, target system, target
component, 251 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

from fastcrc import crc16

from mavftpfs.link.messages import Address, FtpRun, Message

FTP_MESSAGE_ID = 110
FTP_PAYLOAD_SIZE = 251

_MAGIC = 0xFD
_OVERHEAD = 12
_LONGEST = 266
_FULL = 254  # payload of 110 before trimming
_SHORTEST = 15  # with the three target bytes
_ZEROS = bytes(224)
_SHORT = FTP_PAYLOAD_SIZE - len(_ZEROS)

# all before the content but the magic byte: payload size, both flags, seq, and the route
_head = struct.Struct("<BHB8s").pack
_route = struct.Struct("<BBIBB").pack
_pack_crc = struct.Struct("<H").pack
# magic, payload size, both flags, and the route: source ids, message id, target network, target ids
_fields = struct.Struct("<BBHx8s").unpack_from
_FTP_ROUTE = FTP_MESSAGE_ID.to_bytes(4, "little")
_crc = crc16.mcrf4xx
_new = tuple.__new__


def _empty_body(seq: int, route: bytes) -> bytes:
    # An all-zero payload: trimming reaches into the target ids, but the first byte always stays.
    ids = route[5:].rstrip(b"\0") or b"\0"
    return bytes((len(ids), 0, 0, seq)) + route[:5] + ids


class FtpFrameCodec:
    """Builds and parses frames of message 110; `source`, this program's address, may be changed."""

    def __init__(self, source: Address, crc_extra: int) -> None:
        self.source = source
        self._extra = bytes((crc_extra,))
        self._alike: tuple[bytes, bytes, int, tuple[Address, Address]] = (b"", b"", 0, (source, source))

    def encode(self, seq: int, target: Address, payloads: Iterable[bytes]) -> list[bytes]:
        """Return the frames; seq: frame sequence number (0..255) of the first; payloads: 251 bytes each."""
        route = _route(*self.source, FTP_MESSAGE_ID, *target)
        extra = self._extra
        frames = []
        for payload in payloads:
            # Most requests end in zeros, and strip is slow over a long tail.
            if payload[-1]:
                content = payload
            else:
                content = (payload[:_SHORT] if payload.endswith(_ZEROS) else payload).rstrip(b"\0")
            body = _head(len(content) + 3, 0, seq, route) + content if content else _empty_body(seq, route)
            frames.append(b"\xfd" + body + _pack_crc(_crc(body + extra)))
            seq = (seq + 1) & 0xFF
        return frames

    def decode_runs(self, data: bytes, start: int, out: list[Message]) -> int:
        """Append the unbroken row of whole, valid frames at `start` to `out`; return where it ends.

        Stop, without judging, at the first byte that does not begin such a frame: another message, a bad CRC,
        a payload shorter than the target ids or longer than 254, the end of the data.
        """
        extra, end, payloads = self._extra, len(data), None
        before_seq, route, length, addresses = self._alike
        # This loop runs once per chunk of every transfer, over frames that mostly differ little.
        while start + _SHORTEST <= end:
            if data[start : start + 4] != before_seq or data[start + 5 : start + 13] != route:
                magic, size, flags, route = _fields(data, start)
                if magic != _MAGIC or flags or not 3 <= size <= _FULL or route[2:6] != _FTP_ROUTE:
                    break
                if route != self._alike[1]:
                    addresses = Address(route[0], route[1]), Address(route[6], route[7])
                before_seq, length, payloads = data[start : start + 4], size + _OVERHEAD, None
                self._alike = (before_seq, route, length, addresses)
            stop = start + length
            if stop > end:
                break
            body = data[start + 1 : stop - 2]
            if _crc(body + extra) != data[stop - 2] | data[stop - 1] << 8:
                break
            payload = body[12:]
            if length != _LONGEST:
                payload = payload.ljust(FTP_PAYLOAD_SIZE, b"\0")
            if payloads is None:
                payloads = [payload]
                out.append(_new(FtpRun, (*addresses, payloads)))
            else:
                payloads.append(payload)
            start = stop
        return start
