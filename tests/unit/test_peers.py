"""The words for components that are heard: link.peers, and the versions that they tell."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mavftpfs.link.messages import Address, AutopilotVersion, Heartbeat
from mavftpfs.link.peers import describe_peer


@pytest.mark.parametrize(
    ("kind", "component", "autopilot", "armed", "words"),
    [
        (2, 1, 12, True, "PX4 quadrotor, armed"),
        (12, 1, 3, False, "ArduPilot submarine, disarmed"),
        (6, 190, 8, False, "ground station"),
        (30, 100, 8, False, "camera"),
        (0, 154, 8, False, "gimbal"),
        (18, 191, 8, False, "onboard controller"),
        (0, 191, 8, False, "onboard computer"),
        (0, 1, 3, False, "ArduPilot, disarmed"),
        (77, 222, 8, False, "component of type 77"),
        (99, 1, 99, False, "autopilot type 99, disarmed"),
    ],
)
def test_what_a_heartbeat_says(kind: int, component: int, autopilot: int, armed: bool, words: str) -> None:
    assert describe_peer(Heartbeat(Address(1, component), kind, autopilot, armed)) == words


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (0x010F04FF, "1.15.4"),
        (0x04060080, "4.6.0 beta"),
        (0x010E00C0, "1.14.0 rc"),
        (0x01100000, "1.16.0 dev"),
    ],
)
def test_firmware_and_board(number: int, words: str) -> None:
    version = AutopilotVersion(Address(1, 1), 0, number, 0x1234, bytes(18))
    assert (version.firmware, version.board) == (words, "0000000000001234")
    assert replace(version, uid2=b"\1" * 18).board == "01" * 18
    assert replace(version, uid=0).board is None
