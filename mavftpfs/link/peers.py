"""Words for the sender of a heartbeat. Layer: link; pure."""

from __future__ import annotations

from collections.abc import Iterable

from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS, Heartbeat
from mavftpfs.shared.readable import autopilot_name

_COMPONENTS = {
    1: "autopilot",
    68: "telemetry radio",
    **dict.fromkeys(range(100, 106), "camera"),
    154: "gimbal",
    158: "peripheral",
    190: "mission planner",
    191: "companion computer",
    **dict.fromkeys(range(192, 195), "companion computer"),
    240: "MAVLink router",
}
_TYPES = {
    **{1: "fixed wing", 2: "quadrotor", 3: "coaxial helicopter", 4: "helicopter", 5: "antenna tracker"},
    **{7: "airship", 8: "balloon", 9: "rocket", 10: "rover", 11: "boat", 12: "submarine"},
    **{13: "hexarotor", 14: "octorotor", 15: "tricopter", 29: "dodecarotor"},
    **dict.fromkeys(range(19, 26), "VTOL"),
    **{6: "ground station", 18: "companion computer", 26: "gimbal", 27: "ADS-B receiver", 30: "camera"},
    **{33: "gimbal", 34: "battery", 36: "battery", 35: "parachute", 37: "telemetry radio"},
}
"""Common MAV_COMPONENT and MAV_TYPE values."""


def describe_peer(heartbeat: Heartbeat) -> str:
    """Return a description of a heartbeat's sender."""
    kind = _TYPES.get(heartbeat.vehicle_type)
    if heartbeat.vehicle_type == MAV_TYPE_GCS:
        return "ground station"
    if heartbeat.autopilot == MAV_AUTOPILOT_INVALID:
        return (
            kind
            or _COMPONENTS.get(heartbeat.source.component)
            or f"component of type {heartbeat.vehicle_type}"
        )
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
