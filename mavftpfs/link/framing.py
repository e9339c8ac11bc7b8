"""Bytes to MAVLink messages and back; the only importer of pymavlink. Layer: link; pure.

This module finds frame boundaries and checks CRCs; pymavlink decodes the fields of the few messages that
matter, and message 110 takes the short way through `fastframe`. pymavlink's own stream parser is not used,
because after a bad byte it may swallow the good frame behind it.

Finding frames in a stream. A frame is believed if its CRC fits; the message's extra byte makes that a check
of the message's layout, too. If the CRC does not fit, or cannot be known because the dialect lacks the
message, the byte behind the claimed end decides. If a frame begins there, the claimed frame is skipped whole
(it was corrupted, or foreign). Otherwise its first byte was garbage, and the search continues one byte
further. Skipping whole matters, because the payload may be a piece of a recorded flight, whose old heartbeats
must not be taken for live ones. The verdict depends on the bytes alone, never on how they were split. At most
one frame waits for its rest.

A damaged length makes the search wait for up to 280 bytes, which takes many seconds on a link with nothing
but heartbeats. So the reader of a stream reports silence (`on_silence`), because a frame arrives in one
piece.

A datagram ends its last frame. A frame cut there is kept, because a serial bridge may have split it, and
dropped if the next datagram begins with a frame of its own.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, TypeVar

from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.fastframe import FTP_MESSAGE_ID, FTP_PAYLOAD_SIZE, FtpFrameCodec
from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_MODE_FLAG_SAFETY_ARMED,
    Address,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    FtpRun,
    Heartbeat,
    Message,
    Other,
    StatusText,
    StorageInformation,
    SystemTime,
)
from mavftpfs.link.signing import SIGNATURE_BLOCK, SignatureCheck
from mavftpfs.shared.errors import LocalProtocolError

MAV_CMD_REQUEST_MESSAGE = 512
MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES = 520
SYSTEM_TIME_ID = 2
AUTOPILOT_VERSION_ID = 148
STORAGE_INFORMATION_ID = 261

_V2 = 0xFD
_V1 = 0xFE
_SIGNED = 1
HIGHEST_ID = 0xFFFF
"""The longest frame of any public dialect; a longer claim would make garbage hold 280 bytes back."""
_UNSIGNED_ALLOWED = (109, 166)  # the radios' own reports: a radio has no key
_PREFIX = re.compile("^MAV_(TYPE|COMP_ID)_")
_MAGIC = re.compile(b"[\xfd\xfe]")
_READABLE = frozenset((0, 2, 76, 77, 110, 148, 253, 261))  # the ids of messages whose fields matter
_CRC_EXTRA: dict[int, int] = {number: kind.crc_extra for number, kind in dialect.mavlink_map.items()}


def _target_offsets() -> dict[int, tuple[int, int | None]]:
    """Return message id -> the offsets of target system and component in the payload."""
    found = {}
    for number, kind in dialect.mavlink_map.items():
        places, offset = {}, 0
        fields = re.findall(r"\d*[a-zA-Z]", kind.unpacker.format)
        for name, form in zip(kind.ordered_fieldnames, fields, strict=True):
            places[name] = offset
            offset += struct.calcsize(f"<{form}")
        if "target_system" in places:
            found[number] = (places["target_system"], places.get("target_component"))
    return found


TARGETS = _target_offsets()
"""For each message that names a target: the offsets of the target's system and component in its payload."""


def word_of(enumeration: str, number: int) -> str | None:
    """Return the word for a value in MAVLink's definitions, such as `ground rover`; None if there is none."""
    entry = dialect.enums[enumeration].get(number)
    return None if entry is None else _PREFIX.sub("", entry.name).replace("_", " ").lower()


def is_known(message_id: int) -> bool:
    """Return whether the CRC of a message's frames can be checked, because the dialect has the message."""
    return message_id in _CRC_EXTRA


class Verdict(Enum):
    """Verdict on the bytes at one place."""

    WHOLE = "whole"  # a frame whose CRC fits, or whose CRC cannot be known
    DAMAGED = "damaged"  # a frame's bounds, with a wrong CRC
    GARBAGE = "garbage"
    PARTIAL = "partial"


def frame_at(
    data: bytes, position: int, *, stream: bool, highest_id: int = HIGHEST_ID
) -> tuple[Verdict, int, int]:
    """Return the verdict on the bytes at `position`, their end, and a frame's message id.

    stream: more bytes may follow `data`, so a frame without a proving CRC waits for the byte behind it.
    """
    magic = data[position]
    if magic not in (_V1, _V2):
        found = _MAGIC.search(data, position)
        return Verdict.GARBAGE, found.start() if found else len(data), -1
    header = 10 if magic == _V2 else 6
    if len(data) - position < header:
        return Verdict.PARTIAL, position, -1
    signature = 0
    if magic == _V2:
        flags = data[position + 2]
        message_id = int.from_bytes(data[position + 7 : position + 10], "little")
        if flags & ~_SIGNED or message_id > highest_id:
            return Verdict.GARBAGE, position + 1, -1
        signature = SIGNATURE_BLOCK if flags else 0
    else:
        message_id = data[position + 5]
    stop = position + header + data[position + 1] + 2 + signature
    if stop > len(data):
        return Verdict.PARTIAL, position, -1
    crc_at = stop - signature - 2
    extra = _CRC_EXTRA.get(message_id)
    if extra is None or crc16.mcrf4xx(data[position + 1 : crc_at] + bytes((extra,))) != (
        data[crc_at] | data[crc_at + 1] << 8
    ):
        if stop == len(data) and stream:
            return Verdict.PARTIAL, position, -1  # the byte behind decides
        if stop < len(data) and data[stop] not in (_V1, _V2):
            return Verdict.GARBAGE, position + 1, -1
        if extra is not None:
            return Verdict.DAMAGED, stop, message_id
    return Verdict.WHOLE, stop, message_id


FoundT = TypeVar("FoundT")


class FrameBuffer(Generic[FoundT]):
    """Keeps an incomplete frame until its rest arrives, in a stream or in a sender's datagrams.

    Attributes:
        stream: whether `feed` takes pieces of a stream instead of datagrams.
    """

    def __init__(self, *, stream: bool) -> None:
        self.stream = stream
        self._tail = b""

    @property
    def waiting(self) -> bool:
        """Whether a stream ended in a possible beginning of a frame."""
        return self.stream and bool(self._tail)

    def feed(self, data: bytes) -> list[FoundT]:
        """Take a piece of the stream, or a datagram, and return what is complete now."""
        if self._tail:
            if not self.stream and data[:1] in (b"\xfd", b"\xfe"):
                self.reset()  # a datagram begins with a frame of its own: the cut one is lost
            data = self._tail + data
        out: list[FoundT] = []
        self._tail = data[self._take(data, out, stream=self.stream) :]
        return out

    def reset(self) -> None:
        """Drop a half-received frame, because the stream was reopened."""
        self._tail = b""

    def on_silence(self) -> list[FoundT]:
        """Note that the stream fell silent within a frame: the bytes were no frame, unless a frame only
        lacked the byte behind it. Return what is found in the rest."""
        out: list[FoundT] = []
        while self._tail:  # as at the end of a datagram, where no more bytes can decide
            self._tail = self._tail[self._take(self._tail, out, stream=False) :][1:]
        return out

    def _take(self, data: bytes, out: list[FoundT], *, stream: bool) -> int:
        """Append the content of whole frames; return the position of the first incomplete frame. stream: more
        bytes may follow."""
        raise NotImplementedError


@dataclass(slots=True)
class FramerStats:
    """Plain sums. bad_signature also counts unsigned frames that were refused. bad_time: frames among these
    that the right key signed, but too long ago."""

    bad_crc: int = 0
    bad_signature: int = 0
    bad_time: int = 0


class Framer(FrameBuffer[Message]):
    """Both directions of one connection.

    Args:
        source: the address of this program in the frames that it sends.
        stream: whether `feed` takes pieces of a stream instead of datagrams.
        signing_key: 32 bytes; all sent frames are signed, and unsigned or wrongly signed frames are refused.
        signing_clock: now, in units of 10 µs since 2015-01-01; must not go back from one run to the next,
            because the vehicle would refuse the frames.
        on_frame: called with the bytes of each accepted or built frame (for a .tlog), unless None.
    """

    def __init__(
        self,
        source: Address,
        *,
        stream: bool,
        signing_key: bytes | None = None,
        signing_clock: Callable[[], int] | None = None,
        on_frame: Callable[[bytes], None] | None = None,
    ) -> None:
        super().__init__(stream=stream)
        self.stats = FramerStats()
        self.on_frame = on_frame
        self._codec = FtpFrameCodec(source, _CRC_EXTRA[FTP_MESSAGE_ID])
        self._decoder = dialect.MAVLink(None)
        self._sender = dialect.MAVLink(None, source.system, source.component)
        self._check: SignatureCheck | None = None
        if signing_key is not None:
            self._check = SignatureCheck(signing_key, signing_clock)
            self._sender.signing.secret_key = signing_key
            self._sender.signing.sign_outgoing = True

    @property
    def source(self) -> Address:
        """This program's address in the frames that it sends; may be changed."""
        return Address(self._sender.srcSystem, self._sender.srcComponent)

    @source.setter
    def source(self, source: Address) -> None:
        self._sender.srcSystem, self._sender.srcComponent = source
        self._codec.source = source

    @property
    def link_id(self) -> int:
        """The link id in the signatures of sent frames, 0 to 255; may be changed."""
        return int(self._sender.signing.link_id)

    @link_id.setter
    def link_id(self, number: int) -> None:
        self._sender.signing.link_id = number

    # ------------------------------------------------------------------ receiving

    def _take(self, data: bytes, out: list[Message], *, stream: bool) -> int:
        position = after = 0
        while True:
            if self._check is None:
                position = self._codec.decode_runs(data, after, out)
                if self.on_frame is not None:
                    self._report_run(data, after, position)
            if position >= len(data):
                break
            after = self._step(data, position, out, stream=stream)
            if after == position:
                break
            position = after
        return position

    def _report_run(self, data: bytes, start: int, stop: int) -> None:
        while start < stop and self.on_frame is not None:
            end = start + data[start + 1] + 12
            self.on_frame(data[start:end])
            start = end

    def _step(self, data: bytes, position: int, out: list[Message], *, stream: bool) -> int:
        """Handle the bytes at `position`; return where to continue, the same position if more bytes are
        needed."""
        verdict, stop, message_id = frame_at(data, position, stream=stream)
        if verdict is Verdict.DAMAGED:
            self.stats.bad_crc += 1
        elif verdict is Verdict.WHOLE:
            frame = data[position:stop]
            signed = frame[0] == _V2 and frame[2] == _SIGNED
            self._accept(frame, message_id, signed, out)
        return stop

    def _accept(self, frame: bytes, message_id: int, signed: bool, out: list[Message]) -> None:
        """Append the message of a whole frame, if its signature is as required and its fields make sense."""
        at = 5 if frame[0] == _V2 else 3
        source = Address(frame[at], frame[at + 1])
        if self._check is not None and message_id not in _UNSIGNED_ALLOWED:
            accepted = signed and self._check.accept(frame, source)
            self.stats.bad_time = self._check.bad_times
            if not accepted:
                self.stats.bad_signature += 1
                return
        try:
            m: Any = self._decoder.decode(bytearray(frame)) if message_id in _READABLE else None
            message: Message = Other(source, message_id)
            match message_id:
                case 0:
                    armed = bool(m.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)
                    message = Heartbeat(source, m.type, m.autopilot, armed)
                case 2:
                    message = SystemTime(source, m.time_boot_ms)
                case 76:
                    params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
                    target = Address(m.target_system, m.target_component)
                    message = CommandLong(source, target, m.command, params)
                case 77:
                    message = CommandAck(source, m.command, m.result)
                case 110:
                    target = Address(m.target_system, m.target_component)
                    message = FtpRun(source, target, [bytes(m.payload)])
                case 148:
                    version = (m.capabilities, m.flight_sw_version, m.uid, bytes(m.uid2))
                    message = AutopilotVersion(source, *version)
                case 253:
                    message = StatusText(source, str(m.text).partition("\0")[0])
                case 261:
                    size = (m.total_capacity, m.available_capacity)
                    message = StorageInformation(source, m.storage_id, *size)
        except (dialect.MAVError, AttributeError, TypeError, ValueError):
            return  # whole and valid, but its fields make no sense
        out.append(message)
        if self.on_frame is not None:
            self.on_frame(frame)

    # ------------------------------------------------------------------ sending

    def encode_ftp(self, target: Address, payload: bytes) -> bytes:
        """Return a FILE_TRANSFER_PROTOCOL frame.

        Raises:
            LocalProtocolError: the payload is not 251 bytes.
        """
        return self.encode_ftp_run(target, [payload])[0]

    def encode_ftp_run(self, target: Address, payloads: Sequence[bytes]) -> list[bytes]:
        """Return the frames of several payloads, in order; otherwise as encode_ftp."""
        if wrong := set(map(len, payloads)) - {FTP_PAYLOAD_SIZE}:
            raise LocalProtocolError(f"FTP payload of {wrong.pop()} bytes instead of {FTP_PAYLOAD_SIZE}")
        if self._check is not None:
            name = "file_transfer_protocol"
            return [self.encode(name, 0, *target, list(payload)) for payload in payloads]
        sender = self._sender
        frames = self._codec.encode(sender.seq, target, payloads)
        sender.seq = (sender.seq + len(frames)) & 0xFF
        if self.on_frame is not None:
            for frame in frames:
                self.on_frame(frame)
        return frames

    def encode(self, name: str, *fields: Any) -> bytes:
        """Return the frame of any message: encode("system_time", 0, 7). fields: in pymavlink's order."""
        sender = self._sender
        if self._check is not None:
            sender.signing.timestamp = max(sender.signing.timestamp, self._check.now)
        frame: bytes = getattr(dialect, f"MAVLink_{name}_message")(*fields).pack(sender)
        sender.seq = (sender.seq + 1) & 0xFF
        if self.on_frame is not None:
            self.on_frame(frame)
        return frame

    def encode_heartbeat(
        self,
        vehicle_type: int,
        autopilot: int = MAV_AUTOPILOT_INVALID,
        base_mode: int = 0,
        system_status: int = 4,
    ) -> bytes:
        """Return a HEARTBEAT frame (system_status 4: active)."""
        return self.encode("heartbeat", vehicle_type, autopilot, base_mode, 0, system_status, 3)

    def encode_request_message(self, target: Address, message_id: int) -> bytes:
        """Return MAV_CMD_REQUEST_MESSAGE for `message_id`."""
        return self._encode_command(target, MAV_CMD_REQUEST_MESSAGE, message_id)

    def encode_request_capabilities(self, target: Address) -> bytes:
        """Return the older request for AUTOPILOT_VERSION (ArduPilot before 4.1, PX4 before 1.13)."""
        return self._encode_command(target, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1)

    def _encode_command(self, target: Address, command: int, value: int) -> bytes:
        return self.encode("command_long", *target, command, 0, value, 0, 0, 0, 0, 0, 0)
