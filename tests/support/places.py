"""Where each kind of server may be written, and what it needs for that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tests.support.vehicles import UdpVehicle

if TYPE_CHECKING:
    from tests.mount.conftest import Field

REAL = "mavsdk-server"
"""The MAVSDK library's server; all others are simulated."""

FOLDERS = {
    "px4": "",
    "px4-2026": "",
    "px4-nuttx": "fs/microsd",
    "ardupilot": "APM",
    "ardupilot5": "APM",
    "littlefs": "APM",
    "mavsdk": "",
    REAL: "",
}
"""The folder of each that may be written."""

OPTIONS: dict[str, tuple[str, ...]] = {"littlefs": ("inplace",)}
"""Files that mounting needs there."""

NO_RENAME = ("littlefs",)
"""Servers that cannot rename: programs that replace a file by rename cannot work there."""


@dataclass
class Place:
    """A vehicle with an empty card. folder: what of it may be written; card: that on the local disk."""

    kind: str
    vehicle: UdpVehicle
    folder: str
    card: Path

    @property
    def options(self) -> tuple[str, ...]:
        """The options that mounting needs."""
        return OPTIONS.get(self.kind, ())


def start_place(field: Field, kind: str, link: Sequence[str] = ()) -> Place:
    """Start a vehicle of that kind. link: arguments of its link model."""
    root = field.local("card")
    card = root / FOLDERS[kind]
    card.mkdir(parents=True, exist_ok=True)
    vehicle: UdpVehicle = field.mavsdk(root, link) if kind == REAL else field.sim(root, kind, link)
    return Place(kind, vehicle, FOLDERS[kind], card)
