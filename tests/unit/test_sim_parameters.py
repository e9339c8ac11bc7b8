"""The simulated table of parameters does with downloads and uploads what the recorded vehicles did."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import pytest

from mavftpfs.sim.parameters import (
    FLOAT,
    HEADER,
    INT8,
    INT16,
    INT32,
    MAGIC,
    LenientUpload,
    Parameter,
    Selection,
    StrictUpload,
    Table,
    Upload,
    parameter,
    selection,
)
from tests.support.recordings import Step, data_of, load_recording

PX4, ARDUPILOT = "px4-2026-virtual", "ardupilot-virtual"


def unpacked(packed: bytes) -> list[Parameter]:
    """Parse param.pck: each name lies over the one before it; pad bytes are skipped."""
    params: list[Parameter] = []
    at, last = HEADER.size, b""
    while at < len(packed):
        if packed[at] == 0:
            at += 1
            continue
        kind, flags, lengths = packed[at] & 15, packed[at] >> 4, packed[at + 1]
        start, width = at + 3 + (lengths >> 4), {1: 1, 2: 2, 3: 4, 4: 4}[kind]
        last = last[: lengths & 15] + packed[at + 2 : start]
        at = start + width
        default = packed[at : at + width] if flags else None
        value = packed[start:at]
        params.append(Parameter(last, kind, value, default, misfit=default == value))
        at += width if flags else 0
    return params


def steps_of(name: str) -> dict[str, Step]:
    return {step.name: step for step in load_recording(name)}


def recorded_table(steps: dict[str, Step]) -> Table:
    return Table(unpacked(data_of(steps["param.pck?withdefaults=1: read"])))


@pytest.mark.parametrize(("name", "narrow"), [(PX4, 239), (ARDUPILOT, 110)])
def test_downloads_are_those_that_were_recorded(name: str, narrow: int) -> None:
    steps = steps_of(name)
    known = {one.name: one for one in unpacked(data_of(steps["param.pck?withdefaults=1: read"]))}
    for query, block in (
        ("", 239),
        ("?withdefaults=1", 239),
        ("?start=50&count=10", 239),
        (" by 110", narrow),
    ):
        recorded = data_of(steps[f"param.pck{query}: read"])
        values = {one.name: replace(known[one.name], value=one.value) for one in unpacked(recorded)}
        table = Table((known | values).values())  # some values changed from one download to the next
        assert table.download(selection(query.partition("?")[2].encode()), block, 0) == recorded, query


UPLOADS = (
    "two changed",
    "unknown name",
    "wrong magic",
    "wrong total",
    "a defaults flag",
    "60 unchanged",
    "60 out of order",
    "60, second chunk repeated",
    "as open WO",
    "abandoned upload",
)


LIVE = frozenset({b"BARO1_GND_PRESS", b"BARO2_GND_PRESS", b"MIS_TOTAL", b"STAT_RUNTIME", b"COMPASS_DEC"})
"""What the recorded ArduPilot changed by itself between two downloads."""


def without_live(params: list[Parameter]) -> dict[bytes, bytes]:
    return {one.name: one.value for one in params if one.name not in LIVE}


def chunks(steps: dict[str, Step], upload: str) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the writes of a recorded upload: offset, data, whether it was ACKed."""
    for name, step in steps.items():
        if name.startswith(upload + ": write") or name == upload + ": write":
            for request, reply in zip(step.requests, step.replies, strict=True):
                data = request[1][12 : 12 + request[1][4]]
                yield struct.unpack_from("<I", request[1], 8)[0], data, reply[1].opcode == 128


def attempt(upload: Upload, offset: int, data: bytes) -> bool:
    try:
        upload.write(offset, data, 0)
    except OSError:
        return False
    return True


def ended(upload: Upload) -> bool:
    try:
        upload.close(0)
    except OSError:
        return False
    return True


@pytest.mark.parametrize("name", [PX4, ARDUPILOT])
def test_uploads_are_acked_and_refused_as_recorded(name: str) -> None:
    steps = steps_of(name)
    table = recorded_table(steps)
    for upload_name in UPLOADS:
        upload: Upload = StrictUpload(table) if name == PX4 else LenientUpload(table, says_so=False)
        for offset, data, acked in chunks(steps, upload_name):
            assert attempt(upload, offset, data) == acked, (upload_name, offset)
        closed = steps[upload_name + ": terminate"].replies[0][1].opcode == 128
        assert ended(upload) == closed, upload_name
        after = steps.get(f"after {upload_name}: read")
        if after is not None:
            assert without_live(table.visible(0)) == without_live(unpacked(data_of(after))), upload_name


def table_of_two() -> Table:
    return Table([parameter("A_FLOAT", FLOAT, 1.5, 0.0), parameter("A_INT", INT32, 3, 3)])


def packed(*entries: tuple[bytes, int, bytes], magic: int = MAGIC) -> bytes:
    body = b"".join(bytes([kind, (len(name) - 1) << 4]) + name + value for name, kind, value in entries)
    return HEADER.pack(magic, len(entries), len(body) + HEADER.size) + body


def send(upload: Upload, data: bytes) -> None:
    upload.write(0, data, 0)
    upload.close(0)


def test_a_float_is_cut_or_rounded_for_an_integer() -> None:
    data = packed((b"A_INT", FLOAT, struct.pack("<f", 2.9)))
    table = table_of_two()
    send(StrictUpload(table), data)
    assert table.number("A_INT", 0) == 2
    table = table_of_two()
    send(LenientUpload(table, says_so=True), packed((b"A_INT", FLOAT, struct.pack("<f", 5.995))))
    assert table.number("A_INT", 0) == 6


def test_what_came_before_the_mistake_is_set_by_px4_alone() -> None:
    good = packed((b"A_FLOAT", FLOAT, struct.pack("<f", 7)))
    wrong_length = HEADER.pack(MAGIC, 1, 9) + good[HEADER.size :]
    strict, lenient = table_of_two(), table_of_two()
    with pytest.raises(OSError, match="Invalid"):
        send(StrictUpload(strict), wrong_length)
    send(LenientUpload(lenient, says_so=False), wrong_length)
    with pytest.raises(OSError, match="Invalid"):
        send(LenientUpload(lenient, says_so=True), wrong_length)
    assert (strict.number("A_FLOAT", 0), lenient.number("A_FLOAT", 0)) == (7, 1.5)


def test_values_drift_by_whole_seconds_and_a_download_follows() -> None:
    table = Table([parameter("STAT_RUNTIME", INT32, 10, drift=2), parameter("X", INT8, 1)])
    before = table.download(Selection(), 239, 100.0)
    assert table.download(Selection(), 239, 100.9) == before
    assert table.number("STAT_RUNTIME", 103.5) == 16
    assert table.download(Selection(), 239, 103.5) != before
    table.set(b"STAT_RUNTIME", 0, 103.6)
    assert table.number("STAT_RUNTIME", 104.1) == 2


def test_limits_read_only_and_parameters_that_need_another() -> None:
    table = Table(
        [
            parameter("LIMITED", FLOAT, 1, limits=(0, 5)),
            parameter("FIXED", INT16, 3, read_only=True),
            parameter("GRIP_ENABLE", INT8, 0),
            parameter("GRIP_GRAB", INT16, 9, needs="GRIP_ENABLE"),
        ]
    )
    for name in (b"LIMITED", b"FIXED", b"GRIP_GRAB"):
        table.set(name, 100, 0)
    assert [one.number for one in table.visible(0)] == [5, 3, 0]
    table.set(b"GRIP_ENABLE", 1, 0)
    assert table.number("GRIP_GRAB", 0) == 9


def test_a_table_may_tell_every_default() -> None:
    some = table_of_two().download(Selection(defaults=True), 239, 0)
    every = Table(unpacked(some), every_default=True).download(Selection(defaults=True), 239, 0)
    assert len(every) == len(some) + 4
    assert [one.default for one in unpacked(every)] == [bytes(4), struct.pack("<i", 3)]
