"""Facts about the vehicle that listening tells."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    Address,
    AutopilotVersion,
    FtpRun,
    Heartbeat,
    Message,
    StorageInformation,
    SystemTime,
)
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.session.vehicle import SILENCE_LIMIT, Vehicle
from tests.support.replies import request

pytestmark = pytest.mark.holds("fault boot time asked")

OWN = Address(254, 191)
PILOT = Address(1, 1)
GCS = Address(255, 190)


def heartbeat(source: Address, *, autopilot: int = 12, armed: bool = False) -> Heartbeat:
    return Heartbeat(source, 2, autopilot, armed)


def version(source: Address, uid: int = 1) -> AutopilotVersion:
    return AutopilotVersion(source, 0x20, 1, uid, b"")


OURS, THEIRS = version(PILOT), version(PILOT, 2)
FLIES, LANDED = heartbeat(PILOT, armed=True), heartbeat(PILOT)


def listener(system: int = 0, component: int = 0) -> Vehicle:
    return Vehicle(system, component, OWN)


def tell_boot_times(vehicle: Vehicle, *times: tuple[float, int]) -> None:
    """Have it tell at each of these times how many milliseconds ago it booted."""
    for now, boot_ms in times:
        vehicle.on_message(SystemTime(PILOT, boot_ms), now)


@pytest.mark.holds("rule 14.37")
def test_the_first_autopilot_becomes_the_target_and_others_do_not_replace_it() -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(GCS, autopilot=MAV_AUTOPILOT_INVALID), 0.0)
    assert vehicle.address is None
    vehicle.on_message(heartbeat(Address(7, 1)), 1.0)
    vehicle.on_message(heartbeat(PILOT), 2.0)
    assert vehicle.address == (7, 1)
    assert vehicle.heartbeat_at == 1.0


def test_a_wanted_system_or_component_waits_for_its_own_autopilot() -> None:
    """A component without heartbeats lives by that."""
    vehicle = listener(system=9)
    vehicle.on_message(heartbeat(PILOT), 0.0)
    assert vehicle.address is None
    vehicle.on_message(heartbeat(Address(9, 1)), 0.0)
    assert vehicle.address == (9, 1)
    vehicle = listener(system=1, component=100)
    vehicle.on_message(heartbeat(PILOT), 3.0)
    assert (vehicle.address, vehicle.heartbeat_at) == ((1, 100), 3.0)
    vehicle.on_message(heartbeat(Address(1, 100), autopilot=MAV_AUTOPILOT_INVALID), 4.0)
    vehicle.on_message(heartbeat(PILOT), 9.0)
    assert vehicle.heartbeat_at == 4.0


@pytest.mark.holds("promise 9")
def test_never_heard_is_armed_and_lost_needs_silence_and_a_time_out() -> None:
    vehicle = listener()
    assert vehicle.armed
    vehicle.on_message(heartbeat(PILOT), 10.0)
    assert not vehicle.armed
    assert not vehicle.lost(10.0 + SILENCE_LIMIT + 1)
    vehicle.note_timeout()
    assert not vehicle.lost(10.0 + SILENCE_LIMIT - 1)
    assert vehicle.lost(10.0 + SILENCE_LIMIT + 1)
    vehicle.on_message(heartbeat(PILOT), 30.0)
    assert not vehicle.lost(40.0)


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize(
    "story",
    [
        pytest.param(
            [(10.0, LANDED, True), (20.0, OURS, True), (21.0, LANDED, False), (31.0, FLIES, True)],
            id="one that may be another vehicle does not disarm ours",
        ),
        pytest.param(
            [(4.0, LANDED, True), (4.1, OURS, False), (8.0, LANDED, False), (8.1, FLIES, True)],
            id="seldom heard, it is disarmed when it tells its id",
        ),
        pytest.param(
            [(10.0, LANDED, True), (11.0, FLIES, True), (12.0, OURS, True)],
            id="but not if it was armed again meanwhile",
        ),
        pytest.param(
            [(1.0, THEIRS, True), (5.0, LANDED, True), (5.1, OURS, True), (6.0, LANDED, False)],
            id="nor if another vehicle, which was away too, may have said so",
        ),
    ],
)
def test_when_a_vehicle_in_flight_counts_as_armed(story: list[tuple[float, Message, bool]]) -> None:
    vehicle = listener()
    vehicle.on_message(FLIES, 0.0)
    vehicle.on_message(OURS, 0.0)
    for now, message, armed in story:
        vehicle.on_message(message, now)
        assert vehicle.armed is armed, now


def test_a_component_cannot_disarm_the_autopilot() -> None:
    news: list[bool] = []
    companion = Address(1, 100)
    vehicle = listener(system=1, component=100)
    vehicle.on_armed = news.append
    vehicle.on_message(heartbeat(companion, autopilot=MAV_AUTOPILOT_INVALID), 0.0)
    assert vehicle.armed  # the autopilot was never heard
    vehicle.on_message(heartbeat(PILOT, armed=True), 1.0)
    vehicle.on_message(heartbeat(companion, autopilot=MAV_AUTOPILOT_INVALID), 2.0)
    vehicle.on_message(heartbeat(Address(2, 1)), 2.0)
    assert vehicle.armed
    vehicle.on_message(heartbeat(PILOT), 3.0)
    assert not vehicle.armed
    assert news == [False]


@pytest.mark.holds("promise 6", "rule 14.39")
def test_ftp_of_others_is_another_clients_and_our_own_replies_are_not() -> None:
    vehicle, heard = listener(), list[bytes]()
    vehicle.on_another_client = heard.append
    vehicle.on_message(heartbeat(PILOT), 0.0)
    reply = Payload(2, 0, Opcode.ACK, 0, Opcode.READ_FILE).encode()
    ask = request(1, Opcode.READ_FILE).encode()
    assert (vehicle.address, vehicle.own) == (PILOT, OWN)  # by which the driver knows our replies
    vehicle.on_message(FtpRun(Address(5, 1), GCS, [reply]), 1.0)
    vehicle.on_message(FtpRun(GCS, Address(5, 1), [ask]), 1.0)
    assert heard == []
    vehicle.on_message(FtpRun(PILOT, GCS, [reply]), 2.0)
    vehicle.on_message(FtpRun(GCS, PILOT, [ask]), 20.0)
    assert heard == [reply, ask]


HELD_BACK = [(0.0, 60_000), (4.0, 64_000), (4.1, 61_000), (5.0, 65_000), (8.0, 62_000), (9.0, 69_000)]
OUTAGE = [(10.0, 20_000), (25.0, 21_000), (26.0, 36_000), (626.0, 636_000)]


@pytest.mark.parametrize(
    ("told", "reboots"),
    [
        pytest.param([(0.0, 5000), (0.0, 4500), (0.0, 6000), (0.0, 600_000)], 0, id="reordered"),
        pytest.param([(0.0, 5000), (0.0, 600_000), (0.0, 1200)], 1, id="it goes back"),
        pytest.param(HELD_BACK, 0, id="held back by the network"),
        pytest.param([*HELD_BACK, (12.0, 900)], 1, id="held back, then it goes back"),
        pytest.param([(0.0, 900_000), (1.0, 60_000), (2.0, 61_000), (3.0, 62_000)], 1, id="it stays behind"),
        pytest.param(OUTAGE, 0, id="an outage"),
        pytest.param([*OUTAGE, (1226.0, 700_000)], 1, id="time is missing after an outage"),
    ],
)
def test_when_boot_times_tell_of_a_reboot(told: list[tuple[float, int]], reboots: int) -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    tell_boot_times(vehicle, *told)
    vehicle.on_message(SystemTime(Address(8, 1), 10), 2000.0)
    assert vehicle.reboots == reboots


@pytest.mark.parametrize(("restarts", "told"), [(True, 8_000), (False, 40_000), (False, 24_000)])
def test_a_restart_of_who_told_its_boot_time_long_ago_is_seen(restarts: bool, told: int) -> None:
    """The vehicle was heard all the time, and had counted on; perhaps at half the speed, as a simulator."""
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    tell_boot_times(vehicle, (0.0, 5_000))
    for second in [*range(21), 35]:
        vehicle.on_message(heartbeat(PILOT), float(second))
    assert vehicle.lacks_boot_time
    tell_boot_times(vehicle, (35.0, told))
    assert vehicle.reboots == restarts
    assert not vehicle.lacks_boot_time


def test_facts_are_taken_from_the_target_alone() -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    vehicle.on_message(version(Address(3, 1)), 0.0)
    assert vehicle.ftp_flag is None
    vehicle.on_message(OURS, 0.0)
    assert vehicle.ftp_flag is True
    vehicle.on_message(StorageInformation(PILOT, 2, 8.0, 7.0), 0.0)
    vehicle.on_message(StorageInformation(PILOT, 1, 16.0, 15.0), 0.0)
    vehicle.on_message(StorageInformation(PILOT, 2, 8.0, 7.0), 0.0)
    assert vehicle.storage is not None
    assert vehicle.storage.total_capacity == 16.0
