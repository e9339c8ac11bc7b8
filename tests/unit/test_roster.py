"""Which vehicles a mount of all of them has."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Address, Heartbeat
from mavftpfs.mount.roster import (
    HEARD_LATELY,
    LONGEST_PAUSE,
    MOST,
    MemberState,
    Roster,
    parse_name,
)
from mavftpfs.shared.errors import ExitCode


def beat(system: int, component: int = 1, autopilot: int = 12) -> Heartbeat:
    return Heartbeat(Address(system, component), 2, autopilot, False)


@pytest.mark.parametrize(
    ("name", "key"),
    [
        (b"1", (1, 0)),
        (b"255", (255, 0)),
        (b"1-100", (1, 100)),
        (b"0", None),
        (b"01", None),
        (b"256", None),
        (b"1-0", None),
        (b"1-256", None),
        (b"-1", None),
        (b"1-", None),
        (b"1-2-3", None),
        (b"log", None),
    ],
)
def test_names(name: bytes, key: tuple[int, int] | None) -> None:
    assert parse_name(name) == key


def test_an_autopilots_heartbeat_makes_its_vehicle_known() -> None:
    roster = Roster()
    roster.hear(beat(255, 190, MAV_AUTOPILOT_INVALID), 0.0)
    roster.hear(beat(2, 100, MAV_AUTOPILOT_INVALID), 0.0)
    assert len(roster) == 0
    roster.hear(beat(2), 1.0)
    roster.hear(beat(1), 1.0)
    assert [member.name for member in roster] == ["2", "1"]
    assert len({member.ino for member in roster} | {1}) == 3
    member = roster.find(2, 0)
    assert member is not None
    assert roster.at(member.ino) is member
    assert roster.find(3, 0) is None


def due(roster: Roster, now: float) -> list[str]:
    return [member.name for member in roster.due(now)]


def test_a_mount_is_started_once_and_again_after_it_failed() -> None:
    roster = Roster()
    roster.hear(beat(1), 0.0)
    (member,) = roster.due(0.0)
    member.start()
    assert due(roster, 0.0) == []
    member.ended(2, "no vehicle", 0.0)
    assert member.problem == "no vehicle"
    assert due(roster, 0.5) == []
    assert due(roster, 1.0) == ["1"]
    member.start()
    member.mounted()
    assert member.problem == ""
    member.ended(-9, "killed", 5.0)
    assert due(roster, 6.0) == ["1"]


def test_failures_in_a_row_are_tried_again_less_and_less_often() -> None:
    roster = Roster()
    roster.hear(beat(1), 0.0)
    (member,) = roster
    pauses = []
    for _ in range(8):
        member.start()
        member.ended(3, "no", 100.0)
        pauses.append(member.due_at - 100.0)
    assert pauses == sorted(pauses)
    assert pauses[-1] == LONGEST_PAUSE


def test_a_silent_vehicle_is_not_mounted_again_before_it_is_heard() -> None:
    roster = Roster()
    roster.hear(beat(1), 0.0)
    assert due(roster, HEARD_LATELY + 1) == []
    roster.hear(beat(1), 60.0)
    assert due(roster, 60.0) == ["1"]


@pytest.mark.parametrize("code", [ExitCode.OK, ExitCode.UNDELIVERED])
def test_what_the_user_unmounted_stays_so(code: ExitCode) -> None:
    roster = Roster()
    roster.hear(beat(1), 0.0)
    (member,) = roster
    member.start()
    member.mounted()
    member.ended(code, "", 1.0)
    assert member.state is MemberState.UNMOUNTED
    assert due(roster, 2.0) == []


def test_forged_heartbeats_have_an_end() -> None:
    roster = Roster()
    for system in range(1, 256):
        roster.hear(beat(system), 0.0)
    assert len(roster) == MOST
