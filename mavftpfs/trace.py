"""Records of what went over the link: FTP payloads as text or JSON lines, frames as .tlog. Layer: top.

A sink is handed to the session layer, which calls `payload` for each of the 251-byte payloads; without a sink
nothing is computed. A sink that cannot write any more (disk full) says so once and falls silent: a trace must
never break what it watches.

JSON lines: {"t", "time", "dir", "seq", "session", "opcode", "size", "offset", "data"}, in replies also
"req_opcode" and "burst_complete", and "note" if there is one (see Remarks); opcodes by
name, data in hex (the part that counts). "t" is in seconds of a clock that never jumps, "time" is UTC. The
.tlog format is pymavlink's: 8 bytes big-endian microseconds since 1970, then the frame.
"""

from __future__ import annotations

import json
import logging
import os
import struct
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Protocol, Self

from mavftpfs.protocol.payload import HEADER_SIZE, PAYLOAD_SIZE, NakCode, Opcode, Payload, decode_request
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.private import open_private

REPLY = "reply"

_FLUSH_PERIOD = 1.0
_TEXT_DATA = 16
_REMEMBERED = 1024
_OPCODES = {opcode.value: opcode.name for opcode in Opcode}
_NAK_CODES = {code.value: code.name for code in NakCode}
_timestamp = struct.Struct(">Q").pack
_log = logging.getLogger(__name__)


class _File:
    """A file that is written to until it fails.

    Raises:
        UsageError: it cannot be created.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._flushed_at = 0.0
        try:
            descriptor = open_private(path, os.O_WRONLY | os.O_TRUNC)
            self._file: BinaryIO | None = open(descriptor, "wb")  # noqa: SIM115 (closed by close)
        except OSError as exc:
            raise UsageError(f"cannot write {path}: {exc.strerror}") from exc

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Write out what is buffered and close."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as exc:
                self._complain(exc)

    def _write(self, data: bytes, now: float) -> None:
        if self._file is None:
            return
        try:
            self._file.write(data)
            if now - self._flushed_at > _FLUSH_PERIOD:
                self._file.flush()
                self._flushed_at = now
        except OSError as exc:
            self._complain(exc)
            file, self._file = self._file, None
            with suppress(OSError):  # what is buffered cannot be written either; close() closes all the same
                file.close()

    def _complain(self, problem: OSError) -> None:
        _log.warning("no further trace in %s: %s", self._path, problem.strerror)


class JsonTrace(_File):
    """Payloads as JSON lines. wall_clock: seconds since 1970.

    Raises:
        UsageError: the file cannot be created.
    """

    def __init__(self, path: str | Path, *, wall_clock: Callable[[], float] = time.time) -> None:
        super().__init__(path)
        self._wall_clock = wall_clock

    def payload(self, now: float, direction: str, wire: bytes, note: str = "") -> None:
        """See Sink."""
        record = describe(direction, wire)
        if note:
            record["note"] = note
        wall = datetime.fromtimestamp(self._wall_clock(), UTC).isoformat(timespec="microseconds")
        line = json.dumps({"t": round(now, 6), "time": wall, **record}, separators=(",", ":"))
        self._write(line.encode() + b"\n", now)


class TlogWriter(_File):
    """Frames in pymavlink's .tlog format, for every tool that reads these.

    wall_clock: seconds since 1970.

    Raises:
        UsageError: the file cannot be created.
    """

    def __init__(self, path: str | Path, *, wall_clock: Callable[[], float] = time.time) -> None:
        super().__init__(path)
        self._wall_clock = wall_clock

    def frame(self, frame: bytes) -> None:
        """Record a whole frame, received or sent; made to be Framer.on_frame."""
        now = self._wall_clock()
        self._write(_timestamp(int(now * 1e6)) + frame, now)


class TextTrace:
    """Payloads as lines for a person.

    write: takes a line without line end; wall_clock: seconds since 1970.
    """

    def __init__(self, write: Callable[[str], None], *, wall_clock: Callable[[], float] = time.time) -> None:
        self._write = write
        self._wall_clock = wall_clock

    def payload(self, now: float, direction: str, wire: bytes, note: str = "") -> None:
        """See Sink."""
        time_of_day = datetime.fromtimestamp(self._wall_clock()).strftime("%H:%M:%S.%f")
        self._write(f"{time_of_day} {text_line(direction, wire)}{f' ({note})' if note else ''}")


class Sink(Protocol):
    """Takes payloads with what is to be said of them."""

    def payload(self, now: float, direction: str, wire: bytes, note: str = "") -> None:
        """Record a payload; note: see Remarks."""
        ...


class Tee:
    """Hands each payload to several sinks, with a remark."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)
        self._remarks = Remarks()

    def payload(self, now: float, direction: str, wire: bytes) -> None:
        """See PayloadTrace."""
        note = self._remarks.of(direction, wire)
        for sink in self._sinks:
            sink.payload(now, direction, wire, note)


class Remarks:
    """What is said of a payload beside its bytes, by what went over the link before."""

    def __init__(self) -> None:
        self._unanswered: OrderedDict[bytes, int] = OrderedDict()  # seq by all else of a request

    def of(self, direction: str, wire: bytes) -> str:
        """Return "" for a new request or an answer to one; else "retransmit", or what is wrong with the
        answer."""
        if len(wire) != PAYLOAD_SIZE:
            return "malformed"
        payload = decode_request(wire)
        if direction != REPLY:
            what = wire[2:5] + wire[8:-1]  # the last byte may be what gives a repetition its full length
            earlier = self._unanswered.get(what)
            self._unanswered[what] = payload.seq
            if len(self._unanswered) > _REMEMBERED:
                self._unanswered.popitem(last=False)
            if earlier is None:
                return ""
            return "retransmit" if earlier == payload.seq else f"retransmit of {earlier}"
        asked = (payload.seq - 1) & 0xFFFF
        answered = [what for what, seq in self._unanswered.items() if seq == asked]
        if payload.req_opcode == Opcode.BURST_READ_FILE:
            return ""  # each request has many answers
        if not answered:
            return "late, duplicate or not ours"
        if answered[0][1] != payload.req_opcode:
            return "stale replay"
        for what in answered:
            del self._unanswered[what]
        return ""


def describe(direction: str, wire: bytes) -> dict[str, str | int]:
    """Return a payload's fields by name, as JSON takes them; what is no payload shows as its bytes."""
    if len(wire) != PAYLOAD_SIZE:
        return {"dir": direction, "malformed": wire.hex()}
    payload = decode_request(wire)
    record: dict[str, str | int] = {
        "dir": direction,
        "seq": payload.seq,
        "session": payload.session,
        "opcode": opcode_name(payload.opcode),
        "size": payload.size,
        "offset": payload.offset,
    }
    if direction == REPLY:
        record["req_opcode"] = opcode_name(payload.req_opcode)
        record["burst_complete"] = payload.burst_complete
    record["data"] = _data_that_counts(direction, payload).hex()
    return record


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
    # A reply's bytes behind `size` are stray memory; ReadFile's `size` is what it wants, not what it holds.
    wants_data = payload.opcode in (Opcode.READ_FILE, Opcode.BURST_READ_FILE)
    if direction != REPLY and wants_data:
        return b""
    return payload.data[: min(payload.size, PAYLOAD_SIZE - HEADER_SIZE)]


def _quoted(data: bytes) -> str:
    if not data:
        return ""
    return f" {data[:_TEXT_DATA]!r}{'...' if len(data) > _TEXT_DATA else ''}"
