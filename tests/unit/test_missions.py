"""Missions as packed files and as lines of "QGC WPL 110" (docs/servers.md 17)."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.parameters.missions import (
    FENCE,
    MISSION,
    RALLY,
    Item,
    differences,
    pack_upload,
    parse,
    render,
    unpack,
)
from mavftpfs.shared.errors import RemoteProtocolError
from mavftpfs.sim.missions import Missions
from tests.support.recordings import data_of, load_recording

HOME = Item(0, 16, (0, 0, 0, 0), -353632610, 1491652299, 584.0899658203125)
TAKEOFF = Item(3, 22, (0, 0, 0, 0), 0, 0, 20.0)
GO = Item(3, 16, (2.0, 0, 0, 0), -353610000, 1491610000, 30.0)
RETURN = Item(3, 20, (0, 0, 0, 0), 0, 0, 0.0)
PLAN = [HOME, TAKEOFF, GO, RETURN]


def recorded() -> dict[str, bytes]:
    return {step.name: data_of(step) for step in load_recording("ardupilot-virtual")}


def sent(name: str) -> bytes:
    step = next(step for step in load_recording("ardupilot-virtual") if step.name == name)
    return b"".join(wire[12 : 12 + wire[4]] for _, wire in step.requests)


# --- packed


def test_recorded_files() -> None:
    steps = recorded()
    assert unpack(steps["mission.dat: read"], MISSION) == [HOME]
    assert unpack(steps["fence.dat: read"], FENCE) == unpack(steps["rally.dat: read"], RALLY) == []
    after = unpack(steps["mission.dat after: read"], MISSION)
    assert [item.command for item in after] == [16, 22, 16, 20]
    assert after[2].scale == 1e7


def test_an_upload_is_packed_as_a_recorded_one() -> None:
    upload = sent("mission of four: write at 0")
    items = unpack(upload, MISSION)
    assert b"".join(pack_upload(items, MISSION, (1, 1))) == upload


def test_what_the_recorded_vehicle_made_of_it_counts_as_taken() -> None:
    steps = recorded()
    wanted = unpack(sent("mission of four: write at 0"), MISSION)
    assert differences(wanted, unpack(steps["mission.dat after: read"], MISSION), MISSION) == []
    assert differences(wanted, unpack(steps["mission.dat: read"], MISSION), MISSION) != []


def test_the_simulated_vehicle_does_what_the_recorded_one_did() -> None:
    steps, missions = recorded(), Missions()
    assert missions.packed(b"mission.dat") == steps["mission.dat: read"]
    for name in ("mission of four", "mission, wrong count"):
        missions.replace(b"mission.dat", sent(f"{name}: write at 0"))
        assert missions.packed(b"mission.dat") == steps["mission.dat after: read"]
    assert steps["mission.dat after a refused one: read"] == steps["mission.dat after: read"]
    missions.replace(b"mission.dat", b"".join(pack_upload([HOME, replace(GO, z=math.nan)], MISSION, (1, 1))))
    assert missions.packed(b"mission.dat") == steps["mission.dat after: read"]
    assert missions.packed(b"fence.dat") == steps["fence.dat: read"]


HEADER = struct.Struct("<HHHHH")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x3d\x76",
        HEADER.pack(0x763D, 1, 0, 0, 0),
        HEADER.pack(0x1234, 0, 0, 0, 0),
        HEADER.pack(0x763D, 0, 0, 1, 0),
        HEADER.pack(0x763D, 0, 0, 0, 1),
        HEADER.pack(0x763D, 0, 0, 0, 1) + bytes(37),
        HEADER.pack(0x763D, 0, 0, 0, 1) + bytes(39),
    ],
)
def test_files_that_do_not_add_up_are_errors(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        unpack(data, MISSION)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_mission_or_an_error(data: bytes) -> None:
    for whole in (data, HEADER.pack(0x763D, 0, 0, 0, len(data) // 38) + data):
        try:
            items = unpack(whole, MISSION)
        except RemoteProtocolError:
            continue
        assert all("is no " in problem.reason for problem in parse(render(items))[1])


# --- text


def test_lines() -> None:
    lines = [line.replace("\t", " ") for line in render(PLAN).splitlines()]
    assert lines[0] == "QGC WPL 110"
    assert lines[1] == "0 0 0 16 0 0 0 0 -35.3632610 149.1652299 584.08997 1"
    assert lines[3] == "2 0 3 16 2 0 0 0 -35.3610000 149.1610000 30 1"
    assert render(PLAN).count("\t") == 44
    assert parse(render(PLAN)) == (PLAN, [])


def test_places_of_commands_without_one_are_plain_numbers() -> None:
    local, plain = Item(1, 16, (0, 0, 0, 0), 12345, -5, 1.0), Item(0, 203, (1, 0, 0, 0), 7, 8, 9.0)
    lines = [line.split("\t")[8:10] for line in render([local, plain]).splitlines()[1:]]
    assert lines == [["1.2345", "-0.0005"], ["7", "8"]]
    assert parse(render([local, plain]))[0] == [local, plain]


@given(
    st.lists(
        st.builds(
            Item,
            st.integers(0, 255),
            st.integers(0, 65535),
            st.tuples(*[st.floats(width=32, allow_nan=False)] * 4),
            st.integers(-90 * 10**7, 90 * 10**7) | st.just(2**31 - 1),
            st.integers(-180 * 10**7, 180 * 10**7) | st.just(2**31 - 1),
            st.floats(width=32, allow_nan=False, allow_infinity=False),
            st.integers(0, 255),
            st.integers(0, 255),
        ),
        max_size=5,
    )
)
def test_missions_come_back(items: list[Item]) -> None:
    assert parse(render(items)) == (items, [])
    assert unpack(b"".join(pack_upload(items, RALLY, (1, 1))), RALLY) == items


@pytest.mark.parametrize(
    ("text", "number", "said"),
    [
        ("", 1, "QGC WPL 110"),
        ("0 0 0\n", 1, "QGC WPL 110"),
        ("QGC WPL 120\n", 1, "QGC WPL 110"),
        ("QGC WPL 110\n0 0 0\n", 2, "12 numbers, but this line has 3"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 x 1 2 1\n", 2, "'x' is not a number"),
        ("QGC WPL 110\n0 0 0 99999 0 0 0 0 0 1 2 1\n", 2, "the command"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 999 1 2 1\n", 2, "not a place"),
        ("QGC WPL 110\n0 0 0.5 16 0 0 0 0 9 1 2 1\n", 2, "the frame"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 90.1 1 2 1\n", 2, "90.1 is not a latitude"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 90 -181 2 1\n", 2, "-181 is not a longitude"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 nan 1 2 1\n", 2, "not a place"),
        (f"QGC WPL 110\n0 0 0 16 0 0 0 0 {10**400} 1 2 1\n", 2, "not a place"),
        ("QGC WPL 110\n0 0 2 178 0 0 0 0 2147483647.6 1 2 1\n", 2, "not a place"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 9 1 nan 1\n", 2, "nan is not a height"),
        ("QGC WPL 110\n0 0 0 16 0 0 0 0 9 1 -inf 1\n", 2, "-inf is not a height"),
        ("QGC WPL 110\n1 0 0 16 0 0 0 0 9 1 2 1\n", 2, "this is item 0, but its number is 1"),
        ("QGC WPL 110\n0 0 0 16 1e39 0 0 0 9 1 2 1\n", 2, "too large"),
    ],
)
def test_lines_that_cannot_be(text: str, number: int, said: str) -> None:
    (problem,) = parse(text)[1]
    assert problem.number == number
    assert said in problem.reason


def test_comments_and_windows_lines() -> None:
    text = "QGC  WPL\t110\r\n# home\r\n" + render(PLAN).partition("\n")[2].replace("\n", "\r\n")
    assert parse(text) == (PLAN, [])


# --- what counts


def changed(**more: object) -> list[Item]:
    return [HOME, TAKEOFF, replace(GO, **more), RETURN]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("got", "count"),
    [
        (PLAN, 0),
        ([replace(HOME, x=5), *PLAN[1:]], 0),
        (changed(current=1, autocontinue=0), 0),
        (changed(x=GO.x + 1), 0),
        (changed(x=GO.x + 2), 1),
        (changed(z=30.01), 0),
        (changed(z=30.5), 1),
        (changed(command=17), 1),
        (changed(frame=6), 0),
        (changed(frame=0), 1),
        (changed(parameters=(3.0, 0, 0, 0)), 1),
        (PLAN[:-1], 1),
        ([*PLAN[:-1], replace(RETURN, frame=0)], 0),
    ],
)
def test_what_counts_as_a_difference(got: list[Item], count: int) -> None:
    assert len(differences(PLAN, got, MISSION)) == count


def test_what_there_is_no_room_for_is_no_error() -> None:
    wanted = [HOME, replace(GO, parameters=(2.0, 5.0, math.nan, 90.0))]
    found = differences(wanted, [HOME, GO], MISSION)
    assert [(one.text, one.kept) for one in found] == [
        ("item 1: parameter 2: wanted 5, got 0", False),
        ("item 1: parameter 4: wanted 90, got 0", False),
    ]


def test_rally_points_have_whole_metres_and_all_items_count() -> None:
    point = Item(3, 5100, (0, 0, 0, 0), 1, 2, 30.9)
    assert differences([point], [replace(point, z=30.0)], RALLY) == []
    assert len(differences([point], [replace(point, z=29.0)], RALLY)) == 1
    assert len(differences([point], [], RALLY)) == 1
