"""Records of the traffic on the link: FTP payloads as text, frames as .tlog. Layer: client.

Only `-d` calls `text_line`, for each of the 251-byte payloads. If the disk is full, the log reports it once,
and the .tlog ends there: a record must never break the transfer that it records.

The .tlog format is pymavlink's: 8 bytes big-endian microseconds since 1970, then the frame.
"""

from __future__ import annotations

import logging
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from mavftpfs.protocol.payload import HEADER_SIZE, PAYLOAD_SIZE, NakCode, Opcode, Payload, decode_request
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.private import open_private

REPLY = "reply"

_TEXT_DATA = 16
_OPCODES = {opcode.value: opcode.name for opcode in Opcode}
_NAK_CODES = {code.value: code.name for code in NakCode}
_timestamp = struct.Struct(">Q").pack
_log = logging.getLogger(__name__)


class TlogWriter:
    """Writes frames in pymavlink's .tlog format, without a buffer, until the file fails. wall_clock: seconds
    since 1970.

    Raises:
        UsageError: the file cannot be created.
    """

    def __init__(self, path: str | Path, *, wall_clock: Callable[[], float] = time.time) -> None:
        self._path = path
        self._wall_clock = wall_clock
        self._failed = False
        try:
            self._file = os.fdopen(open_private(path, os.O_WRONLY | os.O_TRUNC), "wb", buffering=0)
        except OSError as exc:
            raise UsageError(f"cannot write {path}: {exc.strerror}") from exc

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def frame(self, frame: bytes) -> None:
        """Record a whole frame, received or sent; for Framer.on_frame."""
        if self._failed:
            return
        try:
            self._file.write(_timestamp(int(self._wall_clock() * 1e6)) + frame)
        except OSError as exc:
            self._failed = True
            _log.warning("no further frames in %s: %s", self._path, exc.strerror)


def text_line(direction: str, wire: bytes) -> str:
    """Return a payload in one line."""
    if len(wire) != PAYLOAD_SIZE:
        return f"{direction} of {len(wire)} bytes, malformed"
    payload = decode_request(wire)
    place = f"seq {payload.seq} session {payload.session} offset {payload.offset} size {payload.size}"
    data = _data_that_counts(direction, payload)
    if direction != REPLY:
        return f"-> {opcode_name(payload.opcode)} {place}{_quoted(data)}"
    complete = " complete" if payload.burst_complete else ""
    answer = opcode_name(payload.opcode)
    if payload.opcode == Opcode.NAK and data:
        answer, data = f"{answer} {nak_name(data[0])}", data[1:]
    return f"<- {opcode_name(payload.req_opcode)} {answer} {place}{complete}{_quoted(data)}"


def opcode_name(opcode: int) -> str:
    """Return an opcode's name, or its number as text."""
    return _OPCODES.get(opcode) or str(opcode)


def nak_name(code: int) -> str:
    """Return a NAK code's name, or its number as text."""
    return _NAK_CODES.get(code) or str(code)


def _data_that_counts(direction: str, payload: Payload) -> bytes:
    # A reply's bytes behind `size` are stray memory; ReadFile's `size` is the number of bytes to read.
    wants_data = payload.opcode in (Opcode.READ_FILE, Opcode.BURST_READ_FILE)
    if direction != REPLY and wants_data:
        return b""
    return payload.data[: min(payload.size, PAYLOAD_SIZE - HEADER_SIZE)]


def _quoted(data: bytes) -> str:
    if not data:
        return ""
    return f" {data[:_TEXT_DATA]!r}{'...' if len(data) > _TEXT_DATA else ''}"
