"""The vehicles of a mount of all of them."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Address, Heartbeat
from mavftpfs.mount.members import HEARD_LATELY, MOST, PAUSE, Members, MemberState
from mavftpfs.shared.errors import ExitCode


def beat(system: int, component: int = 1, autopilot: int = 12) -> Heartbeat:
    return Heartbeat(Address(system, component), 2, autopilot, False)


def test_an_autopilots_heartbeat_makes_its_vehicle_known_and_they_are_in_order() -> None:
    members = Members()
    members.hear(beat(255, 190, MAV_AUTOPILOT_INVALID), 0.0)
    members.hear(beat(2, 100, MAV_AUTOPILOT_INVALID), 0.0)
    assert len(members) == 0
    members.hear(beat(10), 1.0)
    members.hear(beat(2), 1.0)
    assert [member.name for member in members] == ["2", "10"]


def due(members: Members, now: float) -> list[str]:
    return [member.name for member in members.due(now)]


def test_a_mount_is_started_once_and_again_after_it_failed() -> None:
    members = Members()
    members.hear(beat(1), 0.0)
    (member,) = members.due(0.0)
    member.start()
    assert due(members, 0.0) == []
    member.ended(2, "no vehicle", 0.0)
    assert member.problem == "no vehicle"
    assert due(members, PAUSE / 2) == []
    assert due(members, PAUSE) == ["1"]
    member.start()
    member.mounted()
    assert member.problem == ""
    member.ended(-9, "killed", 5.0)
    assert due(members, 5.0 + PAUSE) == ["1"]


def test_a_silent_vehicle_is_not_mounted_again_before_it_is_heard() -> None:
    members = Members()
    members.hear(beat(1), 0.0)
    assert due(members, HEARD_LATELY + 1) == []
    members.hear(beat(1), 60.0)
    assert due(members, 60.0) == ["1"]


@pytest.mark.parametrize("code", [ExitCode.OK, ExitCode.UNDELIVERED])
def test_what_the_user_unmounted_stays_so(code: ExitCode) -> None:
    members = Members()
    members.hear(beat(1), 0.0)
    (member,) = members
    member.start()
    member.mounted()
    member.ended(code, "", 1.0)
    assert member.state is MemberState.UNMOUNTED
    assert due(members, 2.0) == []


def test_forged_heartbeats_have_an_end() -> None:
    members = Members()
    for system in range(1, 256):
        members.hear(beat(system), 0.0)
    assert len(members) == MOST
