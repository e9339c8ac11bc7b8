"""What is learned of the vehicle by listening."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    Address,
    AutopilotVersion,
    FtpFrame,
    Heartbeat,
    StorageInformation,
    SystemTime,
)
from mavftpfs.protocol.payload import Opcode, Payload, request
from mavftpfs.session.vehicle import FOREIGN_MEMORY, SILENCE_LIMIT, Standing, Vehicle

pytestmark = pytest.mark.holds("fault boot time asked")

OWN = Address(254, 191)
PILOT = Address(1, 1)
GCS = Address(255, 190)


def heartbeat(source: Address, *, autopilot: int = 12, armed: bool = False) -> Heartbeat:
    return Heartbeat(source, 2, autopilot, 0x80 if armed else 0, 4)


def version(source: Address) -> AutopilotVersion:
    return AutopilotVersion(source, 0x20, 1, b"", 1, b"")


OURS = version(PILOT)


def listener(system: int = 0, component: int = 0) -> Vehicle:
    return Vehicle(system, component, OWN)


def in_flight() -> Vehicle:
    """Return one that is armed, and told which it is."""
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT, armed=True), 0.0)
    vehicle.on_message(OURS, 0.0)
    return vehicle


def counting_reboots() -> tuple[Vehicle, list[int]]:
    """Return one that was heard, and what gets an item at each reboot."""
    reboots: list[int] = []
    vehicle = listener()
    vehicle.on_reboot = lambda: reboots.append(1)
    vehicle.on_message(heartbeat(PILOT), 0.0)
    return vehicle, reboots


def tell_boot_times(vehicle: Vehicle, *times: tuple[float, int]) -> None:
    """Have it tell at each of these times how many milliseconds ago it booted."""
    for now, boot_ms in times:
        vehicle.on_message(SystemTime(PILOT, 0, boot_ms), now)


@pytest.mark.holds("rule 14.37")
def test_the_first_autopilot_becomes_the_target_and_others_do_not_replace_it() -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(GCS, autopilot=MAV_AUTOPILOT_INVALID), 0.0)
    assert vehicle.address is None
    vehicle.on_message(heartbeat(Address(7, 1)), 1.0)
    vehicle.on_message(heartbeat(PILOT), 2.0)
    assert vehicle.address == (7, 1)
    assert vehicle.heartbeat_at == 1.0


def test_a_wanted_system_waits_for_its_own_autopilot() -> None:
    vehicle = listener(system=9)
    vehicle.on_message(heartbeat(PILOT), 0.0)
    assert vehicle.address is None
    vehicle.on_message(heartbeat(Address(9, 1)), 0.0)
    assert vehicle.address == (9, 1)


def test_a_wanted_component_without_heartbeats_lives_by_its_systems_autopilot() -> None:
    vehicle = listener(system=1, component=100)
    vehicle.on_message(heartbeat(PILOT), 3.0)
    assert vehicle.address == (1, 100)
    assert vehicle.heartbeat_at == 3.0
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


def test_arming_is_told_once_each_way() -> None:
    news: list[bool] = []
    vehicle = listener()
    vehicle.on_armed = news.append
    for armed in (False, False, True, True, False):
        vehicle.on_message(heartbeat(PILOT, armed=armed), 0.0)
    assert news == [False, True, False]


def test_who_may_be_another_vehicle_does_not_disarm_ours() -> None:
    vehicle = in_flight()
    vehicle.on_message(heartbeat(PILOT), 10.0)
    assert vehicle.armed
    vehicle.on_message(OURS, 20.0)  # it is back, and flies
    assert vehicle.identity.standing is Standing.TRUSTED
    assert vehicle.armed
    vehicle.on_message(heartbeat(PILOT), 21.0)
    assert not vehicle.armed
    vehicle.on_message(heartbeat(PILOT, armed=True), 31.0)
    assert vehicle.armed


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("beats", [True, False])
def test_nor_does_the_autopilot_beside_a_component_that_may_be_another_ones(beats: bool) -> None:
    """The target is a component; beats: it sends heartbeats of its own."""
    target = Address(PILOT.system, 191)
    vehicle = listener(component=191)
    ours = version(target)
    vehicle.on_message(heartbeat(PILOT, armed=True), 0.0)
    if beats:
        vehicle.on_message(heartbeat(target, autopilot=8), 0.0)
    vehicle.on_message(ours, 0.0)
    vehicle.on_message(heartbeat(PILOT), 10.0)
    assert vehicle.armed
    vehicle.on_message(ours, 10.1)
    assert not vehicle.armed


def test_a_vehicle_that_is_seldom_heard_is_disarmed_when_it_tells_who_it_is() -> None:
    vehicle = in_flight()
    vehicle.on_message(heartbeat(PILOT), 4.0)
    assert vehicle.armed
    vehicle.on_message(OURS, 4.1)
    assert not vehicle.armed
    vehicle.on_message(heartbeat(PILOT), 8.0)
    vehicle.on_message(heartbeat(PILOT, armed=True), 8.1)
    vehicle.on_message(OURS, 8.2)
    assert vehicle.armed


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
    assert news == [True, False]


@pytest.mark.holds("promise 6", "rule 14.39")
def test_ftp_of_others_is_foreign_and_our_own_replies_are_not() -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    reply = Payload(2, 0, Opcode.ACK, 0, Opcode.READ_FILE).encode()
    ask = request(1, Opcode.READ_FILE).encode()
    assert (vehicle.address, vehicle.own) == (PILOT, OWN)  # by which the driver knows our replies
    vehicle.on_message(FtpFrame(Address(5, 1), GCS, reply), 1.0)
    vehicle.on_message(FtpFrame(GCS, Address(5, 1), ask), 1.0)
    assert not vehicle.foreign_client(1.0)
    vehicle.on_message(FtpFrame(PILOT, GCS, reply), 2.0)
    assert vehicle.foreign_client(2.0)
    assert not vehicle.foreign_client(2.0 + FOREIGN_MEMORY)
    vehicle.on_message(FtpFrame(GCS, PILOT, ask), 20.0)
    assert vehicle.foreign_client(20.0)


def test_boot_time_going_back_is_a_reboot_and_reordering_is_not() -> None:
    vehicle, reboots = counting_reboots()
    tell_boot_times(vehicle, (0.0, 5000), (0.0, 4500), (0.0, 6000), (0.0, 600_000), (0.0, 1200))
    assert reboots == [1]
    vehicle.on_message(SystemTime(Address(8, 1), 0, 10), 0.0)
    assert reboots == [1]


def test_a_message_that_was_held_back_is_no_reboot() -> None:
    vehicle, reboots = counting_reboots()
    tell_boot_times(vehicle, (0.0, 60_000), (4.0, 64_000), (4.1, 61_000), (5.0, 65_000), (8.0, 62_000))
    assert reboots == []
    assert vehicle.boot_heard_at == 5.0
    tell_boot_times(vehicle, (9.0, 69_000))
    assert reboots == []
    tell_boot_times(vehicle, (12.0, 900))
    assert reboots == [1]


def test_a_clock_that_stays_behind_is_one_of_another_boot() -> None:
    vehicle, reboots = counting_reboots()
    tell_boot_times(vehicle, (0.0, 900_000), (1.0, 60_000), (2.0, 61_000), (3.0, 62_000))
    assert reboots == [1]


def test_a_reboot_during_a_long_outage_is_seen_by_the_time_that_is_missing() -> None:
    vehicle, reboots = counting_reboots()
    tell_boot_times(vehicle, (10.0, 20_000), (25.0, 21_000), (26.0, 36_000), (626.0, 636_000))
    assert reboots == []
    tell_boot_times(vehicle, (1226.0, 700_000))
    assert reboots == [1]


@pytest.mark.parametrize(("restarts", "told"), [(True, 8_000), (False, 40_000), (False, 24_000)])
def test_a_restart_of_who_told_its_boot_time_long_ago_is_seen(restarts: bool, told: int) -> None:
    """It was heard all the time, and had counted on; perhaps at half the speed, as a simulator."""
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    tell_boot_times(vehicle, (0.0, 5_000))
    for second in [*range(21), 35]:
        vehicle.on_message(heartbeat(PILOT), float(second))
    assert vehicle.lacks_boot_time(35.0)
    tell_boot_times(vehicle, (35.0, told))
    assert vehicle.reboots == restarts
    assert not vehicle.lacks_boot_time(35.0)


def test_facts_are_taken_from_the_target_alone() -> None:
    vehicle = listener()
    vehicle.on_message(heartbeat(PILOT), 0.0)
    vehicle.on_message(version(Address(3, 1)), 0.0)
    assert vehicle.ftp_flag is None
    vehicle.on_message(OURS, 0.0)
    assert vehicle.ftp_flag is True
    vehicle.on_message(StorageInformation(PILOT, 2, 2, 2, 8.0, 1.0, 7.0), 0.0)
    vehicle.on_message(StorageInformation(PILOT, 1, 2, 2, 16.0, 1.0, 15.0), 0.0)
    vehicle.on_message(StorageInformation(PILOT, 2, 2, 2, 8.0, 1.0, 7.0), 0.0)
    assert vehicle.storage is not None
    assert vehicle.storage.total_capacity == 16.0


def test_our_own_address_heard_from_somebody_else_is_told() -> None:
    doubles: list[int] = []
    vehicle = listener()
    vehicle.on_double = lambda: doubles.append(1)
    vehicle.on_message(heartbeat(OWN, autopilot=MAV_AUTOPILOT_INVALID), 0.0)
    assert doubles == [1]
    assert vehicle.address is None
