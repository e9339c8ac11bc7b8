"""The fast path for message 110 against pymavlink, on chosen cases (tests/property has the rest)."""

from __future__ import annotations

import pytest
from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.fastframe import FtpFrameCodec
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpRun, Message
from tests.support.frames import feed

US = Address(254, 191)
EXTRA = 84

FULL = bytes(range(1, 252))


def reference(seq: int, target: Address, payload: bytes) -> bytes:
    mav = dialect.MAVLink(None, *US)
    mav.seq = seq
    frame: bytes = mav.file_transfer_protocol_encode(0, *target, list(payload)).pack(mav)
    return frame


def test_a_frame_trimmed_into_its_target_is_left_to_pymavlink() -> None:
    out: list[Message] = []
    for target in (Address(0, 0), Address(1, 0)):
        assert FtpFrameCodec(US, EXTRA).decode_runs(reference(9, target, bytes(251)), 0, out) == 0
    assert out == []


@pytest.mark.parametrize("at", [0, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 100, 263, 264, 265])
def test_a_row_of_frames_ends_at_a_damaged_one(at: int) -> None:
    codec = FtpFrameCodec(US, EXTRA)
    payloads = [bytes([n]) * 251 for n in range(1, 6)]
    frames = codec.encode(254, Address(1, 1), payloads)
    frames[2] = frames[2][:at] + bytes([frames[2][at] ^ 1]) + frames[2][at + 1 :]
    out: list[Message] = []
    assert codec.decode_runs(b"".join(frames), 0, out) == 2 * len(frames[0])
    assert out == [FtpRun(US, Address(1, 1), payloads[:2])]
    found = feed(Framer(US, stream=False), b"".join(frames))
    assert [p for m in found if isinstance(m, FtpRun) for p in m.payloads] == payloads[:2] + payloads[3:]


def test_a_signed_frame_among_others_is_left_to_pymavlink() -> None:
    frame = reference(1, Address(1, 1), FULL)
    body = frame[1:2] + b"\1" + frame[3:-2]  # says that it is signed, and its CRC is right
    signed = b"\xfd" + body + crc16.mcrf4xx(body + bytes((EXTRA,))).to_bytes(2, "little") + bytes(13)
    out: list[Message] = []
    assert FtpFrameCodec(US, EXTRA).decode_runs(frame + signed + frame, 0, out) == len(frame)
