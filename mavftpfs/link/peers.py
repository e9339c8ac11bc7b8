"""Words for the sender of a heartbeat. Layer: link; pure."""

from __future__ import annotations

from collections.abc import Iterable

from mavftpfs.link.framing import word_of
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS, Heartbeat
from mavftpfs.shared.readable import autopilot_name

_NOTHING_TOLD = 0
"""MAV_TYPE_GENERIC."""


def describe_peer(heartbeat: Heartbeat) -> str:
    """Return a description of a heartbeat's sender."""
    number = heartbeat.vehicle_type
    if number == MAV_TYPE_GCS:
        return "ground station"
    kind = None if number == _NOTHING_TOLD else word_of("MAV_TYPE", number)
    if heartbeat.autopilot == MAV_AUTOPILOT_INVALID:
        return kind or word_of("MAV_COMPONENT", heartbeat.source.component) or f"component of type {number}"
    words = [autopilot_name(heartbeat.autopilot), *([kind] if kind else [])]
    return f"{' '.join(words)}, {'armed' if heartbeat.armed else 'disarmed'}"


def vehicles_in(heard: Iterable[Heartbeat]) -> list[Heartbeat]:
    """Return a heartbeat of each vehicle, by system id: that of its autopilot with the lowest component
    id."""
    found: dict[int, Heartbeat] = {}
    for one in sorted(heard, key=lambda heartbeat: heartbeat.source):
        if one.autopilot != MAV_AUTOPILOT_INVALID:
            found.setdefault(one.source.system, one)
    return list(found.values())


def names_of(senders: Iterable[Heartbeat]) -> str:
    """Return the addresses of senders, with their descriptions."""
    return ", ".join(f"{one.source.system}/{one.source.component} ({describe_peer(one)})" for one in senders)
