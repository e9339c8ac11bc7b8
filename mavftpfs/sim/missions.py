"""Missions of one vehicle, as ArduPilot serves and accepts `@MISSION/*.dat`. Layer: sim; pure.

Source: servers.md 11 and 17; AP_Filesystem_Mission and a recording. Closing an upload replaces all items. If
the vehicle refuses the upload, the old items stay, although some versions ACK the close.
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from mavftpfs.sim.tree import ClaimedFile, fail

MAGIC = 0x763D
NAMES = (b"mission.dat", b"fence.dat", b"rally.dat")
HEADER = struct.Struct("<HHHHH")
ITEM = struct.Struct("<ffffiifHHBBBBBB")
HOME = (0.0, 0.0, 0.0, 0.0, -353632610, 1491652299, 584.0899658203125, 0, 16, 0, 0, 0, 0, 1, 0)

Item = tuple[float | int, ...]
_HEIGHT, _COMMAND, _WAYPOINT = 6, 8, 16
_PLACELESS = frozenset((20, 112, 114, 115, 177, 178, 183, 206, 211))


@dataclass
class Missions:
    """Items by kind: mission, fence, rally. The mission's first item is home.

    limit: the most items that the vehicle accepts. says_so: closing a refused upload is EINVAL; otherwise the
    server ACKs it.
    """

    limit: int = 700
    says_so: bool = False
    items: dict[int, list[Item]] = field(default_factory=lambda: {0: [HOME], 1: [], 2: []})

    def packed(self, name: bytes) -> bytes:
        """Return a file."""
        kind = NAMES.index(name)
        items = self.items[kind]
        return HEADER.pack(MAGIC, kind, 0, 0, len(items)) + b"".join(ITEM.pack(*item) for item in items)

    def replace(self, name: bytes, data: bytes) -> None:
        """Take an upload.

        Raises:
            OSError: EINVAL, the vehicle refuses the upload, and `says_so` is set.
        """
        kind = NAMES.index(name)
        items = self._parsed(kind, data)
        if items is not None:
            self.items[kind] = [HOME, *items[1:]] if kind == 0 else items
        elif self.says_so:
            raise fail(errno.EINVAL)

    def _parsed(self, kind: int, data: bytes) -> list[Item] | None:
        """Return the items as the vehicle stores them, None if it refuses them."""
        if len(data) < HEADER.size:
            return None
        magic, found, _, start, count = HEADER.unpack_from(data)
        body = data[HEADER.size :]
        if magic != MAGIC or found != kind or start or len(body) != count * ITEM.size or count > self.limit:
            return None
        parts = [body[at : at + ITEM.size] for at in range(0, len(body), ITEM.size)]
        if not all(map(any, parts)):
            return None
        items = [ITEM.unpack(part) for part in parts]
        if not all(math.isfinite(item[_HEIGHT]) for item in items):
            return None
        return [self._kept(place, item, kind) for place, item in enumerate(items)]

    def _kept(self, place: int, item: Item, kind: int) -> Item:
        """Return the item as the vehicle stores it: without ids, a waypoint without yaw, heights in steps."""
        p1, p2, p3, p4, x, y, z, _, command, _, _, frame, *_ = item
        if command == _WAYPOINT and kind == 0:
            p2 = p3 = p4 = 0.0
        if command in _PLACELESS:
            frame = 0
        height = float(int(z)) if kind == 2 else int(z * 100) / 100
        return (p1, p2, p3, p4, x, y, height, place, command, 0, 0, frame, 0, 1, kind)


class MissionFile(ClaimedFile):
    """A mission file that a session has open."""

    def __init__(
        self, missions: Missions, name: bytes, claimed: int, *, write: bool, on_close: Callable[[], None]
    ) -> None:
        super().__init__(claimed, on_close)
        self._missions = missions
        self._name = name
        self._written = bytearray() if write else None

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile. Each read returns the present items."""
        if self._written is not None:
            raise fail(errno.EINVAL)
        return self._missions.packed(self._name)[offset : offset + size]

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        if self._written is None:
            raise fail(errno.EBADF)
        self._written += bytes(max(0, offset + len(data) - len(self._written)))
        self._written[offset : offset + len(data)] = data
        return len(data)

    def closed(self) -> None:
        """See ClaimedFile."""
        if self._written is not None:
            self._missions.replace(self._name, bytes(self._written))
