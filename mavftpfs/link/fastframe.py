"""FILE_TRANSFER_PROTOCOL frames, built and parsed by hand. Layer: link; pure, no pymavlink.

pymavlink needs about 16 µs to build such a frame and 8 µs to parse one, which makes the codec the
bottleneck of a transfer. These functions do the one case that carries all the data: message 110,
MAVLink 2, unsigned. Whatever is not exactly that is left to `framing` and pymavlink, and a property
test holds both byte-identical. The message's extra CRC byte is passed in by `framing`, which takes it
from pymavlink's dialect.

Layout (MAVLink guide, "Packet Serialization"): FD, payload length, incompat flags, compat flags, seq,
system, component, message id u24 LE, payload with trailing zeros cut (never to nothing), CRC-16/MCRF4XX
of all but the first byte and of the extra byte. Payload of 110: target network, target system, target
component, 251 bytes.
"""

from __future__ import annotations

import struct

from fastcrc import crc16

from mavftpfs.link.messages import Address, FtpFrame, Message

FTP_MESSAGE_ID = 110
FTP_PAYLOAD_SIZE = 251

_MAGIC = 0xFD
_OVERHEAD = 12  # header and CRC
_FULL = 254  # payload of 110 before trimming
_SHORTEST = 15  # with the three target bytes
_ZEROS = bytes(224)
_MAX_ADDRESSES = 1024

_head = struct.Struct("<BBHBBBIBB").pack
_pack_crc = struct.Struct("<H").pack
# magic, payload size, both flags, source ids, message id and target network in one, target ids
_fields = struct.Struct("<BBHx2sI2s").unpack_from
_crc = crc16.mcrf4xx
_new = tuple.__new__


def frame_crc(body: bytes, extra: int) -> int:
    """Return the CRC of a frame: `body` is the frame without magic byte, CRC and signature."""
    return _crc(body + bytes((extra,)))


def _trimmed_head(head: bytes) -> bytes:
    # An all-zero payload: trimming reaches into the target ids, but the first byte always stays.
    ids = head[10:].rstrip(b"\0") or b"\0"
    return bytes((_MAGIC, len(ids))) + head[2:10] + ids


class FtpFrameCodec:
    """Builds and parses frames of message 110; `source` is who we are and may be changed."""

    def __init__(self, source: Address, crc_extra: int) -> None:
        self.source = source
        self._extra = bytes((crc_extra,))
        self._addresses: dict[bytes, Address] = {}

    def encode(self, seq: int, target: Address, payload: bytes) -> bytes:
        """Return the frame with the frame sequence number `seq` (0..255); payload: 251 bytes."""
        if payload.endswith(_ZEROS):  # most requests; strip is slow over a long tail
            payload = payload[: -len(_ZEROS)]
        content = payload.rstrip(b"\0")
        system, component = self.source
        size = len(content) + 3
        head = _head(_MAGIC, size, 0, seq, system, component, FTP_MESSAGE_ID, target[0], target[1])
        body = head + content if content else _trimmed_head(head)
        return body + _pack_crc(_crc(body[1:] + self._extra))

    def decode_run(self, data: bytes, start: int, out: list[Message]) -> int:
        """Append the unbroken run of whole, valid frames at `start` to `out`; return where it ends.

        Stops, without judging, at the first byte that does not begin such a frame: another message,
        a bad CRC, a payload shorter than the target ids or longer than 254, the end of the data.
        """
        extra = self._extra
        addresses = self._addresses
        last = len(data) - _SHORTEST
        # Indices rather than a parser object: this loop runs once per chunk of every transfer.
        while start <= last:
            magic, size, flags, source, message_id, target = _fields(data, start)
            stop = start + size + _OVERHEAD
            if message_id != FTP_MESSAGE_ID or magic != _MAGIC or flags or not 3 <= size <= _FULL:
                break
            crc = data[stop - 2 : stop]  # short, hence unequal, where the frame is not whole
            if _pack_crc(_crc(data[start + 1 : stop - 2] + extra)) != crc:
                break
            payload = data[start + 13 : stop - 2]
            if size != _FULL:
                payload = payload.ljust(FTP_PAYLOAD_SIZE, b"\0")
            sender = addresses.get(source) or self._learn(source)
            receiver = addresses.get(target) or self._learn(target)
            out.append(_new(FtpFrame, (sender, receiver, payload)))
            start = stop
        return start

    def _learn(self, pair: bytes) -> Address:
        if len(self._addresses) >= _MAX_ADDRESSES:
            self._addresses.clear()  # a flood of invented senders must not grow the cache
        self._addresses[pair] = Address(*pair)
        return self._addresses[pair]
