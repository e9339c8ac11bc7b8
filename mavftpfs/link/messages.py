"""What the framing understands of MAVLink, as plain values. Layer: link; pure, no pymavlink.

Every other message is `Other`: traced, never an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

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
    """HEARTBEAT of anybody on the link."""

    source: Address
    vehicle_type: int
    autopilot: int
    base_mode: int
    system_status: int

    @property
    def armed(self) -> bool:
        """The safety-armed flag of base_mode."""
        return bool(self.base_mode & MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def is_autopilot(self) -> bool:
        """Whether the sender says it is an autopilot."""
        return self.autopilot != MAV_AUTOPILOT_INVALID


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
    """SYSTEM_TIME; time_boot_ms going back means that the vehicle rebooted. unix_usec 0 = unknown."""

    source: Address
    unix_usec: int
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


READABLE = frozenset((0, 2, 76, 110, 148, 261))
"""The ids of messages that `read_message` looks into."""


def read_message(source: Address, message_id: int, m: Any) -> Message:
    """Return what pymavlink's message object says. One that lacks a field raises AttributeError or such."""
    match message_id:
        case 0:
            return Heartbeat(source, m.type, m.autopilot, m.base_mode, m.system_status)
        case 2:
            return SystemTime(source, m.time_unix_usec, m.time_boot_ms)
        case 76:
            params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
            return CommandLong(source, Address(m.target_system, m.target_component), m.command, params)
        case 110:
            return FtpRun(source, Address(m.target_system, m.target_component), [bytes(m.payload)])
        case 148:
            git_hash, uid2 = bytes(m.flight_custom_version), bytes(m.uid2)
            return AutopilotVersion(source, m.capabilities, m.flight_sw_version, git_hash, m.uid, uid2)
        case 261:
            size = (m.total_capacity, m.used_capacity, m.available_capacity)
            return StorageInformation(source, m.storage_id, m.storage_count, m.status, *size)
        case _:
            return Other(source, message_id)
