"""Whole frames and their headers, for programs that pass them on. Layer: link; pure.

The hub passes a frame on as it arrived, byte for byte, and reads only its bounds, its sender, its target and
its kind. The CRC of another dialect's frame cannot be checked, or looks wrong. Such frames pass, but nobody
learns anything from them, because rubbish looks the same.
"""

from __future__ import annotations

from typing import NamedTuple

from mavftpfs.link.framing import TARGETS, FrameBuffer, Verdict, frame_at, is_known
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_MODE_FLAG_SAFETY_ARMED, Address

HEARTBEAT_ID = 0
_ANY_ID = 0xFFFFFF
_AUTOPILOT_AT, _MODE_AT, _HEARTBEAT_SIZE = 5, 6, 9
EVERYBODY = Address(0, 0)


class Frame(NamedTuple):
    """One frame.

    target: EVERYBODY if the frame names none. crc_fits: its CRC is known, and is right.
    """

    data: bytes
    source: Address
    target: Address
    id: int
    crc_fits: bool


class Splitter(FrameBuffer[Frame]):
    """Finds the frames in one sender's datagrams, or in a stream."""

    def _take(self, data: bytes, out: list[Frame], *, stream: bool) -> int:
        position, end = 0, len(data)
        while position < end:
            verdict, stop, message_id = frame_at(data, position, stream=stream, highest_id=_ANY_ID)
            if verdict is Verdict.PARTIAL:
                break
            if verdict is not Verdict.GARBAGE:
                crc_fits = verdict is Verdict.WHOLE and is_known(message_id)
                out.append(_frame(data[position:stop], message_id, crc_fits=crc_fits))
            position = stop
        return position


def _frame(data: bytes, message_id: int, *, crc_fits: bool) -> Frame:
    header = 10 if data[0] == 0xFD else 6
    at = 5 if header == 10 else 3
    source = Address(data[at], data[at + 1])
    places = TARGETS.get(message_id)
    if places is None:
        return Frame(data, source, EVERYBODY, message_id, crc_fits)
    # MAVLink 2 cuts zeros at the end: missing bytes are 0.
    system, component = (
        data[header + place] if place is not None and place < data[1] else 0 for place in places
    )
    return Frame(data, source, Address(system, component), message_id, crc_fits)


def armed_by(frame: Frame) -> bool | None:
    """Return whether a heartbeat says that its vehicle is armed; None if it is no autopilot's heartbeat."""
    if frame.id != HEARTBEAT_ID:
        return None
    header = 10 if frame.data[0] == 0xFD else 6
    payload = frame.data[header : header + frame.data[1]].ljust(_HEARTBEAT_SIZE, b"\0")
    if payload[_AUTOPILOT_AT] == MAV_AUTOPILOT_INVALID:
        return None
    return bool(payload[_MODE_AT] & MAV_MODE_FLAG_SAFETY_ARMED)
