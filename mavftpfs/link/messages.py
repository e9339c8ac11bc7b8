"""MAVLink messages that the framing understands, as plain values. Layer: link; pure, no pymavlink.

Every other message is `Other`: logged in traces, never an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

MAV_TYPE_ONBOARD_CONTROLLER = 18
MAV_TYPE_GCS = 6
MAV_AUTOPILOT_INVALID = 8
MAV_COMP_ID_AUTOPILOT1 = 1
OWN_COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: mavftpfs's id on the link, unless another program there has its address."""
MAV_MODE_FLAG_SAFETY_ARMED = 0x80
MAV_PROTOCOL_CAPABILITY_FTP = 0x20


class Address(NamedTuple):
    """A MAVLink system id and component id, each 0..255."""

    system: int
    component: int


class FtpRun(NamedTuple):
    """FILE_TRANSFER_PROTOCOL messages that arrived in a row from one source for one target. payloads: at
    least one, each of 251 bytes, zero-padded where MAVLink 2 trimmed it."""

    source: Address
    target: Address
    payloads: list[bytes]


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT of any component on the link; autopilot: MAV_AUTOPILOT_INVALID unless the sender is one."""

    source: Address
    vehicle_type: int
    autopilot: int
    armed: bool


_RELEASES = ((255, ""), (192, " rc"), (128, " beta"), (64, " alpha"), (0, " dev"))


@dataclass(frozen=True, slots=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION; `uid` 64-bit, `uid2` 18 bytes."""

    source: Address
    capabilities: int
    flight_sw_version: int
    uid: int
    uid2: bytes

    @property
    def firmware(self) -> str:
        """The flight stack's version: major.minor.patch and the kind of release, as MAVLink packs them."""
        major, minor, patch, kind = self.flight_sw_version.to_bytes(4, "big")
        release = next(word for least, word in _RELEASES if kind >= least)
        return f"{major}.{minor}.{patch}{release}"

    @property
    def board(self) -> str | None:
        """The board's unique id in hex, the long one if the message has it; None if it has neither."""
        if any(self.uid2):
            return self.uid2.hex()
        return f"{self.uid:016x}" if self.uid else None


@dataclass(frozen=True, slots=True)
class StorageInformation:
    """STORAGE_INFORMATION; capacities in MiB as floats, as sent."""

    source: Address
    storage_id: int
    total_capacity: float
    available_capacity: float


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME; a decrease of time_boot_ms means that the vehicle rebooted."""

    source: Address
    time_boot_ms: int


@dataclass(frozen=True, slots=True)
class CommandLong:
    """COMMAND_LONG as the simulated vehicle receives it."""

    source: Address
    target: Address
    command: int
    params: tuple[float, ...]


MAV_CMD_COMPONENT_ARM_DISARM = 400
_ACCEPTED, _IN_PROGRESS = 0, 5
_DENIALS = ("Arm: ", "Arming denied")
"""The beginnings of texts with which ArduPilot and PX4 refuse to arm. "PreArm: " arrives every 30 s
unasked."""


@dataclass(frozen=True, slots=True)
class CommandAck:
    """COMMAND_ACK; result: MAV_RESULT."""

    source: Address
    command: int
    result: int

    @property
    def refuses_to_arm(self) -> bool:
        """Whether the vehicle refused a command to arm or to disarm."""
        return self.command == MAV_CMD_COMPONENT_ARM_DISARM and self.result not in (_ACCEPTED, _IN_PROGRESS)


@dataclass(frozen=True, slots=True)
class StatusText:
    """STATUSTEXT, or the first part of a long one."""

    source: Address
    text: str

    @property
    def refuses_to_arm(self) -> bool:
        """Whether the text says that the vehicle refuses to be armed."""
        return self.text.startswith(_DENIALS)


@dataclass(frozen=True, slots=True)
class Other:
    """Any other valid message."""

    source: Address
    message_id: int


Message: TypeAlias = (
    FtpRun
    | Heartbeat
    | AutopilotVersion
    | StorageInformation
    | SystemTime
    | CommandLong
    | CommandAck
    | StatusText
    | Other
)
