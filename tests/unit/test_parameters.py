"""Parameters as values, packed files and lines of text (docs/servers.md 17).

What a saved text asks for: tests/sim/test_parameters.py.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from itertools import accumulate

import pytest

from mavftpfs.client.parameters import read_with_defaults
from mavftpfs.parameters.own import is_own
from mavftpfs.parameters.packed import HEADER, MAGIC, MAGIC_DEFAULTS, pack_upload, unpack
from mavftpfs.parameters.text import parse, render_all, render_changed, render_qgc
from mavftpfs.parameters.values import (
    BadValue,
    Kind,
    Number,
    Parameter,
    fit,
    float_text,
    nearest_float,
    parse_number,
)
from mavftpfs.protocol.writing import Pieces
from mavftpfs.shared.errors import RemoteProtocolError
from tests.ops.faketree import FakeTree, session_of
from tests.support.recordings import data_of, load_recording

# --- values


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0.0, "0"),
        (-0.0, "-0"),
        (0.135, "0.135"),
        (1e6, "1000000"),
        (1e-45, "1e-45"),
        (math.inf, "inf"),
        (math.nan, "nan"),
    ],
)
def test_floats_are_the_shortest_decimals(number: float, text: str) -> None:
    assert float_text(nearest_float(number)) == text


@pytest.mark.parametrize(
    ("text", "number"), [("7", 7), ("-1.5e3", -1500.0), (".5", 0.5), ("2.", 2.0), ("+3", 3), ("007", 7)]
)
def test_numbers(text: str, number: Number) -> None:
    assert parse_number(text) == number
    assert type(parse_number(text)) is type(number)


@pytest.mark.parametrize(
    "text", ["", "x", "1_000", "0x10", "1,5", "--1", "1e", "e5", "1 2", "٣", "1e999", "∞"]
)
def test_what_is_no_number(text: str) -> None:
    with pytest.raises(BadValue):
        parse_number(text)


def test_what_fits_a_type() -> None:
    assert fit(Kind.INT8, 127.0) == 127
    assert fit(Kind.INT32, -(2**31)) == -(2**31)
    assert fit(Kind.FLOAT, 1) == 1.0
    for kind, number in (
        (Kind.INT8, 128),
        (Kind.INT16, 40_000),
        (Kind.INT32, 2**31),
        (Kind.INT32, 2.9),
        (Kind.INT16, math.nan),
        (Kind.INT16, -math.inf),
        (Kind.INT32, 10**400),
        (Kind.FLOAT, 1e39),
        (Kind.FLOAT, 10**400),
    ):
        with pytest.raises(BadValue):
            fit(kind, number)


async def test_the_default_of_each_name_is_found() -> None:
    one = Parameter("A-B.1", Kind.INT8, 2)
    tree = FakeTree({b"/@PARAM/param.pck": b"".join(pack_upload([one]))})
    tree.files[b"/@PARAM/changed.parm"] = render_changed([replace(one, default=3)]).encode()
    assert await read_with_defaults(session_of(tree)) == [replace(one, default=3)]


# --- packed files


@pytest.mark.parametrize(("name", "count"), [("px4-2026-virtual", 905), ("ardupilot-virtual", 1349)])
def test_recorded_downloads(name: str, count: int) -> None:
    steps = {step.name: data_of(step) for step in load_recording(name)}
    whole = unpack(steps["param.pck: read"])
    assert (len(whole.parameters), whole.total, whole.with_defaults) == (count, count, False)
    told = unpack(steps["param.pck?withdefaults=1: read"])
    assert [one.name for one in told.parameters] == [one.name for one in whole.parameters]
    assert told.with_defaults
    assert [one.kind for one in told.parameters] == [one.kind for one in whole.parameters]
    part = unpack(steps["param.pck?start=50&count=10: read"])
    assert (part.parameters, part.total) == (whole.parameters[50:60], count)
    narrow = unpack(steps["param.pck by 110: read"])
    assert [one.name for one in narrow.parameters] == [one.name for one in whole.parameters]


def test_recorded_uploads_are_packed_like_ours() -> None:
    steps = {step.name: step for step in load_recording("px4-2026-virtual")}
    sent = b"".join(
        wire[12 : 12 + wire[4]]
        for at in (0, 239, 478)
        for _, wire in steps[f"60 unchanged: write at {at}"].requests
    )
    first = unpack(data_of(steps["param.pck: read"])).parameters[:60]
    assert b"".join(pack_upload(first)) == sent


def test_a_default_that_equals_the_value_is_no_change() -> None:
    """ArduPilot tells one for SIM_OH_RELAY_MSK, whose default does not fit its type."""
    steps = {step.name: data_of(step) for step in load_recording("ardupilot-virtual")}
    told = {one.name: one for one in unpack(steps["param.pck?withdefaults=1: read"]).parameters}
    assert told["SIM_OH_RELAY_MSK"].default == -1
    assert not told["SIM_OH_RELAY_MSK"].changed
    assert told["INS_GYR_ID"].changed


def entry(name: bytes, kind: int, value: bytes, *, shared: int = 0, flags: int = 0) -> bytes:
    return bytes([kind | flags << 4, shared | (len(name) - 1) << 4]) + name + value


def file_of(*entries: bytes, count: int | None = None, total: int | None = None, magic: int = MAGIC) -> bytes:
    number = len(entries) if count is None else count
    return HEADER.pack(magic, number, number if total is None else total) + b"".join(entries)


A, B = entry(b"A", 1, b"\x01"), entry(b"B", 2, b"\x02\x00")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x1b\x67\x00",
        file_of(A, magic=0x1234),
        file_of(A, count=2),
        file_of(A, B, count=1),
        file_of(A, count=1, total=0),
        file_of(A, A),
        file_of(A[:-1]),
        file_of(entry(b"A", 5, b"\x01")),
        file_of(entry(b"A", 1, b"\x01", flags=2)),
        file_of(entry(b"A", 1, b"\x01", shared=1)),
        file_of(entry(b"A,B", 1, b"\x01")),
        file_of(entry(b"A\n", 1, b"\x01")),
        file_of(A, entry(b"\xff", 1, b"\x01")),
        file_of(entry(b"A", 4, b"\x01\x02\x03")),
        file_of(entry(b"A", 1, b"\x01", flags=1), magic=MAGIC_DEFAULTS),
        file_of(A) + b"\0\0x",
    ],
)
def test_files_that_do_not_add_up_are_errors(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        unpack(data)


def test_a_name_of_sixteen_letters_shares_at_most_fifteen() -> None:
    long = Parameter("ABCDEFGHIJKLMNO1", Kind.INT8, 1), Parameter("ABCDEFGHIJKLMNO2", Kind.INT8, 2)
    packed = b"".join(pack_upload(long))
    assert struct.unpack_from("<HHH", packed) == (MAGIC, 2, len(packed))
    assert unpack(file_of(packed[6:], count=2)).parameters == list(long)


# --- lines


PARAMETERS = [
    Parameter("RTL_ALT", Kind.INT32, 1500, 1500),
    Parameter("ATC_P", Kind.FLOAT, nearest_float(0.135), nearest_float(0.1)),
]


def test_the_three_spellings() -> None:
    assert render_all(PARAMETERS) == "RTL_ALT,1500\nATC_P,0.135\n"
    assert render_changed(PARAMETERS).splitlines()[1:] == ["ATC_P,0.135 # default 0.1"]
    assert "Deleting" in render_changed(PARAMETERS).splitlines()[0]
    lines = render_qgc(PARAMETERS, 3, 1).splitlines()
    assert lines[-2:] == ["3\t1\tRTL_ALT\t1500\t6", "3\t1\tATC_P\t0.135\t9"]


def test_each_line_says_which_spelling_it_has() -> None:
    text = "# x\r\n\r\nA,1\r\n  B   2.5 # default 3\nC\t-3\nD , 4\n2\t1\tE\t5\t9\nF,6"
    lines, problems = parse(text)
    found = [(line.name, line.value, line.number, line.system) for line in lines]
    assert problems == []
    assert found == [
        *(("A", 1, 3, None), ("B", 2.5, 4, None), ("C", -3, 5, None)),
        *(("D", 4, 6, None), ("E", 5, 7, 2), ("F", 6, 8, None)),
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("A", "not NAME,VALUE"),
        ("A,", "not a number"),
        ("A,x", "'x' is not a number"),
        ("A,1,2", "not NAME,VALUE"),
        ("A 1 2 3 4", "not NAME,VALUE"),
        ("1\t100\tA\t5\t9", "component 100"),
        ("1\t1\tA\t5\tfloat", "not a type"),
        ("1\t1\tA\tx\t9", "'x' is not a number"),
        ("OK,2", "another value on line 1"),
    ],
)
def test_lines_that_cannot_be(line: str, said: str) -> None:
    _, problems = parse(f"OK,1\n{line}\n", component=1)
    assert [problem.number for problem in problems] == [2]
    assert said in problems[0].reason


def test_a_name_twice_with_one_value_is_one_line() -> None:
    assert parse("A,1\nA,1.0\n")[1] == []
    assert parse("A,nan\nA,nan\n")[1] == []


@pytest.mark.parametrize(
    ("names", "own"),
    [
        (("STAT_RUNTIME", "BARO1_GND_PRESS", "CAL_BARO0_OFF", "MIS_TOTAL", "FORMAT_VERSION"), True),
        (("RTL_ALT", "BARO_ALT_OFFSET", "COMPASS_DEC", "MIS_TAKEOFF_ALT", "X_TOTAL"), False),
    ],
    ids=["the vehicle's", "the user's"],
)
def test_which_ones_the_vehicle_sets_by_itself(names: tuple[str, ...], own: bool) -> None:
    assert {name: is_own(name) for name in names} == dict.fromkeys(names, own)


# --- how an upload is cut


@pytest.mark.parametrize("size", [239, 80, 30])
def test_no_request_ends_within_a_value(size: int) -> None:
    """ArduPilot fills up with zeros what did not come."""
    pieces = pack_upload([Parameter(f"GAIN_{i}", Kind.FLOAT, i) for i in range(99)])
    told: list[int] = []
    source, ends = Pieces(pieces, told.append), set()
    taken = b""
    while (chunk := source.next_chunk(size)) is not None:
        assert chunk[0] == len(taken)
        taken += chunk[1]
        ends.add(len(taken))
        source.on_acked(chunk[0], len(taken))
    assert taken == b"".join(pieces)
    assert ends <= set(accumulate(map(len, pieces)))
    assert sum(told) == len(taken)


def test_a_piece_longer_than_a_request_is_cut() -> None:
    source = Pieces([b"x" * 10])
    assert [source.next_chunk(4) for _ in range(4)] == [(0, b"xxxx"), (4, b"xxxx"), (8, b"xx"), None]
