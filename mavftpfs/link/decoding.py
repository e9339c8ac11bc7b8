"""From pymavlink's message objects to `messages` values. Layer: link; pure, imports no pymavlink.

Arguments are pymavlink objects (untyped) as `framing` gets them; array fields come as lists of ints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mavftpfs.link.messages import (
    Address,
    AutopilotVersion,
    CommandLong,
    FtpFrame,
    Heartbeat,
    Message,
    RadioStatus,
    StatusText,
    StorageInformation,
    SystemTime,
)


def _heartbeat(source: Address, m: Any) -> Heartbeat:
    return Heartbeat(source, m.type, m.autopilot, m.base_mode, m.system_status)


def _system_time(source: Address, m: Any) -> SystemTime:
    return SystemTime(source, m.time_unix_usec, m.time_boot_ms)


def _command_long(source: Address, m: Any) -> CommandLong:
    params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
    return CommandLong(source, Address(m.target_system, m.target_component), m.command, params)


def _radio_status(source: Address, m: Any) -> RadioStatus:
    return RadioStatus(source, m.rssi, m.remrssi, m.txbuf, m.rxerrors)


def _ftp(source: Address, m: Any) -> FtpFrame:
    return FtpFrame(source, Address(m.target_system, m.target_component), bytes(m.payload))


def _autopilot_version(source: Address, m: Any) -> AutopilotVersion:
    return AutopilotVersion(
        source,
        m.capabilities,
        m.flight_sw_version,
        bytes(m.flight_custom_version),
        m.uid,
        bytes(m.uid2),
    )


def _status_text(source: Address, m: Any) -> StatusText:
    return StatusText(source, m.severity, m.text)


def _storage_information(source: Address, m: Any) -> StorageInformation:
    return StorageInformation(
        source,
        m.storage_id,
        m.storage_count,
        m.status,
        m.total_capacity,
        m.used_capacity,
        m.available_capacity,
    )


DECODERS: dict[int, Callable[[Address, Any], Message]] = {
    0: _heartbeat,
    2: _system_time,
    76: _command_long,
    109: _radio_status,
    110: _ftp,
    148: _autopilot_version,
    166: _radio_status,  # RADIO, what old SiK firmware sends; same fields
    253: _status_text,
    261: _storage_information,
}
"""By message id; all other messages are `Other`."""
