"""Traces: what is written, and that a full disk breaks nothing."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import pytest
from pymavlink import mavutil

from mavftpfs.client.connect import open_sinks
from mavftpfs.client.trace import REPLY, TlogWriter, text_line
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.options import Options
from tests.support.replies import request

READ = request(7, Opcode.READ_FILE, session=3, offset=478, size=100).encode()
OPEN = request(8, Opcode.OPEN_FILE_RO, data=b"/fs/microsd/a.bin").encode()
DATA = Payload(8, 3, Opcode.ACK, 4, Opcode.BURST_READ_FILE, 1, 478, b"abcd").encode()
NAK = Payload(9, 0, Opcode.NAK, 2, Opcode.OPEN_FILE_RO, 0, 0, bytes([NakCode.FAIL_ERRNO, 28])).encode()


@pytest.mark.parametrize(
    ("direction", "wire", "line"),
    [
        ("request", READ, "-> READ_FILE seq 7 session 3 offset 478 size 100"),
        ("request", OPEN, "-> OPEN_FILE_RO seq 8 session 0 offset 0 size 17 b'/fs/microsd/a.bi'..."),
        (REPLY, DATA, "<- BURST_READ_FILE ACK seq 8 session 3 offset 478 size 4 complete b'abcd'"),
        (REPLY, NAK, "<- OPEN_FILE_RO NAK FAIL_ERRNO seq 9 session 0 offset 0 size 2 b'\\x1c'"),
        (REPLY, b"", "reply of 0 bytes, malformed"),
    ],
)
def test_text(direction: str, wire: bytes, line: str) -> None:
    assert text_line(direction, wire) == line


def test_tlog_is_readable_by_pymavlink(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    framer = Framer(Address(254, 191), stream=True)
    times = iter([1000.5, 1001.5])
    with TlogWriter(path, wall_clock=lambda: next(times)) as log:
        framer.on_frame = log.frame
        frames = [framer.encode_ftp(Address(1, 1), READ), framer.encode_heartbeat(18)]
    assert path.read_bytes() == b"".join(
        struct.pack(">Q", int(t * 1e6)) + f for t, f in zip([1000.5, 1001.5], frames, strict=True)
    )
    reader = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    try:
        found = [reader.recv_msg() for _ in range(3)]
    finally:
        reader.close()
    assert [m and m.get_type() for m in found] == ["FILE_TRANSFER_PROTOCOL", "HEARTBEAT", None]
    assert bytes(found[0].payload) == READ


def test_a_file_that_cannot_be_made_is_the_users_error(tmp_path: Path) -> None:
    options = Options(tlog=str(tmp_path / "nowhere" / "tlog"))
    with (
        pytest.raises(UsageError, match="No such file or directory"),
        open_sinks(options, debug=False, tell=print),
    ):
        pass


def test_a_full_disk_is_said_once_and_breaks_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), TlogWriter("/dev/full") as log:
        for _ in range(3000):
            log.frame(DATA)
    assert caplog.messages == ["no further frames in /dev/full: No space left on device"]
