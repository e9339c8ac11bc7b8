"""The simulated table of parameters does with downloads and uploads what the recorded vehicles did."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import pytest

from mavftpfs.sim.parameters import (
    INT32,
    LenientUpload,
    Parameter,
    ParameterUpload,
    StrictUpload,
    Table,
    parameter,
    selection,
)
from tests.support.recordings import Step, data_of, load_recording, unpacked

PX4, ARDUPILOT = "px4-2026-virtual", "ardupilot-virtual"


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
"""Parameters that the recorded ArduPilot changed by itself between two downloads."""


def without_live(params: list[Parameter]) -> dict[bytes, bytes]:
    return {one.name: one.value for one in params if one.name not in LIVE}


def chunks(steps: dict[str, Step], upload: str) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the writes of a recorded upload: offset, data, whether it was ACKed."""
    for name, step in steps.items():
        if name.startswith(upload + ": write") or name == upload + ": write":
            for request, reply in zip(step.requests, step.replies, strict=True):
                data = request[1][12 : 12 + request[1][4]]
                yield struct.unpack_from("<I", request[1], 8)[0], data, reply[1].opcode == 128


def attempt(upload: ParameterUpload, offset: int, data: bytes) -> bool:
    try:
        upload.write(offset, data, 0)
    except OSError:
        return False
    return True


def ended(upload: ParameterUpload) -> bool:
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
        upload: ParameterUpload = StrictUpload(table) if name == PX4 else LenientUpload(table, says_so=False)
        for offset, data, acked in chunks(steps, upload_name):
            assert attempt(upload, offset, data) == acked, (upload_name, offset)
        closed = steps[upload_name + ": terminate"].replies[0][1].opcode == 128
        assert ended(upload) == closed, upload_name
        after = steps.get(f"after {upload_name}: read")
        if after is not None:
            assert without_live(table.visible(0)) == without_live(unpacked(data_of(after))), upload_name


def test_a_parameter_may_need_another() -> None:
    table = Table([parameter("GRIP_ENABLE", INT32, 0), parameter("GRIP_GRAB", INT32, 9, needs="GRIP_ENABLE")])
    table.set(b"GRIP_GRAB", 100, 0)
    assert [one.number for one in table.visible(0)] == [0]
    table.set(b"GRIP_ENABLE", 1, 0)
    assert table.number("GRIP_GRAB", 0) == 9
