"""A simulated MAVLink FTP server without I/O. Layer: sim; pure.

`handle` takes requests, `outgoing` gives replies, `next_deadline` says when to ask again. Time is whatever
monotonic seconds the caller passes; it must not go back. Nothing a client sends makes it raise.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from operator import itemgetter

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import PAYLOAD_SIZE
from mavftpfs.sim.ardupilot import ArduPilot
from mavftpfs.sim.filesystem import Tree
from mavftpfs.sim.firmware import Firmware
from mavftpfs.sim.mavsdk import Mavsdk
from mavftpfs.sim.profiles import Family, Profile
from mavftpfs.sim.pseudo import VirtualTrees
from mavftpfs.sim.px4 import Px4
from mavftpfs.sim.spec import Spec
from mavftpfs.sim.storage import Storage

AUTOPILOT = Address(1, 1)
_OPCODE = itemgetter(3)
_FIRMWARES: dict[Family, type[Firmware]] = {
    Family.SPEC: Spec,
    Family.PX4: Px4,
    Family.ARDUPILOT: ArduPilot,
    Family.MAVSDK: Mavsdk,
}


class FtpServer:
    """The FTP server of one vehicle component.

    tree: what it serves. profile: whose behaviour it has. rng: its stray memory and its bad luck.
    tx_room: tells how many bytes the link's transmit buffer still takes (PX4 and ArduPilot pace by it);
    None = as much as the profile's own buffer. requests: counts by opcode, of all that were handed in.
    disabled: True = no request is answered (ArduPilot's BRD_OPTIONS can do that).
    """

    def __init__(
        self,
        tree: Tree,
        profile: Profile,
        *,
        rng: random.Random,
        address: Address = AUTOPILOT,
        virtual: VirtualTrees | None = None,
    ) -> None:
        self.tree = tree
        self.profile = profile
        self.address = address
        self.requests: Counter[int] = Counter()
        self.malformed = 0
        self.disabled = False
        self._storage = Storage(tree, profile, rng, virtual)
        self._firmware = _FIRMWARES[profile.family](self._storage, profile, rng)

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Take the 251-byte payload of a request from `source`; another length is counted and dropped."""
        if len(wire) != PAYLOAD_SIZE:
            self.malformed += 1
            return
        self.requests[wire[3]] += 1
        firmware = self._firmware
        if not self.disabled and not firmware.crashed:
            firmware.handle(wire, source, now)

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Take payloads that came together: the same as one by one, in less time."""
        firmware = self._firmware
        alone = len(wires) == 1  # as over every link in memory, where tests look at each in `handle`
        unfit = firmware.crashed or any(len(wire) != PAYLOAD_SIZE for wire in wires)
        if alone or unfit or self.disabled:
            for wire in wires:
                self.handle(wire, source, now)
            return
        self.requests.update(map(_OPCODE, wires))
        firmware.handle_run(wires, source, now)

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Return (target, 251-byte payload) of the replies due by `now`, in order."""
        return self._firmware.outgoing(now)

    def next_deadline(self) -> float | None:
        """When to call `outgoing` again if no request comes; in the past if it has something now."""
        return self._firmware.next_deadline()

    def reboot(self, now: float) -> None:
        """Lose every session, queue and reply, as a vehicle that restarts does.

        Files stay, but for what FAT storage learns only when a file is closed.
        """
        self._firmware.crashed = False
        self._storage.lose_power()
        if self._storage.virtual is not None:
            self._storage.virtual.reboot()
        self._firmware.reboot(now)

    @property
    def tx_room(self) -> Callable[[], int] | None:
        """See the class."""
        return self._firmware.tx_room

    @tx_room.setter
    def tx_room(self, room: Callable[[], int] | None) -> None:
        self._firmware.tx_room = room

    @property
    def open_paths(self) -> list[bytes]:
        """Paths of the files that clients hold open, as they named them."""
        return self._firmware.open_paths()

    @property
    def open_sessions(self) -> int:
        """How many sessions hold a file."""
        return len(self._firmware.open_paths())

    @property
    def crashed(self) -> bool:
        """Whether the server process died (MAVSDK) and stays silent until `reboot`."""
        return self._firmware.crashed

    @property
    def ready(self) -> int:
        """How many replies wait for the next `outgoing`, not counting those that are due only later."""
        return self._firmware.ready

    @property
    def dropped_requests(self) -> int:
        """Requests lost to a full queue or receive buffer."""
        return self._firmware.dropped_requests

    @property
    def dropped_replies(self) -> int:
        """Replies lost to a full transmit buffer."""
        return self._firmware.dropped_replies

    @property
    def pauses(self) -> Sequence[float]:
        """Seconds for which a slow card made each of the last reads and writes wait, 0 included."""
        return self._firmware.pauses

    @property
    def replays(self) -> int:
        """Requests answered from the replay slot."""
        return self._firmware.replays
