"""What the framing understands of MAVLink, as plain values. Layer: link; pure, no pymavlink.

Every other message is `Other`: traced, never an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

MAV_TYPE_ONBOARD_CONTROLLER = 18
MAV_TYPE_GCS = 6
MAV_AUTOPILOT_INVALID = 8
MAV_COMP_ID_AUTOPILOT1 = 1
MAV_MODE_FLAG_SAFETY_ARMED = 0x80
MAV_PROTOCOL_CAPABILITY_FTP = 0x20


class Address(NamedTuple):
    """A MAVLink system id and component id, each 0..255."""

    system: int
    component: int


class FtpRun(NamedTuple):
    """FILE_TRANSFER_PROTOCOL messages that came in a row from one source to one target. payloads: at least
    one, each of 251 bytes, zero-padded where MAVLink 2 trimmed it."""

    source: Address
    target: Address
    payloads: list[bytes]


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT of anybody on the link; autopilot: MAV_AUTOPILOT_INVALID of who is none."""

    source: Address
    vehicle_type: int
    autopilot: int
    armed: bool


@dataclass(frozen=True, slots=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION; `git_hash` is flight_custom_version (8 bytes), `uid` 64-bit, `uid2` 18 bytes."""

    source: Address
    capabilities: int
    flight_sw_version: int
    git_hash: bytes
    uid: int
    uid2: bytes


@dataclass(frozen=True, slots=True)
class StorageInformation:
    """STORAGE_INFORMATION; capacities in MiB as floats, as sent."""

    source: Address
    storage_id: int
    storage_count: int
    status: int
    total_capacity: float
    used_capacity: float
    available_capacity: float


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME; time_boot_ms going back means that the vehicle rebooted."""

    source: Address
    time_boot_ms: int


@dataclass(frozen=True, slots=True)
class CommandLong:
    """COMMAND_LONG as the simulated vehicle hears it."""

    source: Address
    target: Address
    command: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Other:
    """Any other valid message."""

    source: Address
    message_id: int


Message: TypeAlias = (
    FtpRun | Heartbeat | AutopilotVersion | StorageInformation | SystemTime | CommandLong | Other
)
