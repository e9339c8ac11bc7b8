"""A simulated vehicle: an FTP server with the rest of an autopilot's MAVLink around it. Layer: sim; pure.

Neither class does any I/O. Requests or frames go in, replies or frames come out. `now` is in monotonic
seconds and must not go back. `next_deadline` returns the time of the next call. The server never raises,
whatever request arrives.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

from mavftpfs.link.framing import (
    AUTOPILOT_VERSION_ID,
    MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    MAV_CMD_REQUEST_MESSAGE,
    STORAGE_INFORMATION_ID,
    SYSTEM_TIME_ID,
    Framer,
)
from mavftpfs.link.messages import (
    MAV_MODE_FLAG_SAFETY_ARMED,
    MAV_PROTOCOL_CAPABILITY_FTP,
    Address,
    CommandLong,
    FtpRun,
    Heartbeat,
)
from mavftpfs.protocol.payload import MAX_DATA, PAYLOAD_SIZE, Opcode
from mavftpfs.sim.ardupilot import ArduPilot
from mavftpfs.sim.firmware import Firmware
from mavftpfs.sim.mavsdk import Mavsdk
from mavftpfs.sim.profiles import Family, Profile
from mavftpfs.sim.pseudo import VirtualTrees
from mavftpfs.sim.px4 import Px4
from mavftpfs.sim.storage import Storage
from mavftpfs.sim.tree import Tree

AUTOPILOT = Address(1, 1)
_OPCODE = itemgetter(3)
_ASKING_DATA = (Opcode.READ_FILE, Opcode.BURST_READ_FILE)
_FIRMWARES: dict[Family, type[Firmware]] = {
    Family.PX4: Px4,
    Family.ARDUPILOT: ArduPilot,
    Family.MAVSDK: Mavsdk,
}


class FtpServer:
    """The FTP server of one vehicle component.

    tree: the files that it serves. profile: the server that it imitates. rng: for stray memory and chance.
    firmware: the code that answers, with its counters. requests: the number of requests by opcode.
    """

    def __init__(
        self,
        tree: Tree,
        profile: Profile,
        *,
        rng: random.Random,
        virtual: VirtualTrees | None = None,
    ) -> None:
        self.tree = tree
        self.profile = profile
        self.requests: Counter[int] = Counter()
        self.malformed = 0
        self._storage = Storage(tree, profile, rng, virtual)
        self.firmware = _FIRMWARES[profile.family](self._storage, profile, rng)

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Take the 251-byte payload of a request from `source`; another length is counted and dropped."""
        if len(wire) != PAYLOAD_SIZE:
            self.malformed += 1
            return
        self.requests[wire[3]] += 1
        if not self.firmware.crashed:
            self.firmware.handle(self._shortened(wire), source, now)

    def _shortened(self, wire: bytes) -> bytes:
        """Return a request, for data shortened to the size that the server sends."""
        longest = self.profile.longest_reply
        if longest == MAX_DATA or wire[3] not in _ASKING_DATA or 0 < wire[4] <= longest:
            return wire
        return wire[:4] + bytes([longest]) + wire[5:]

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Take payloads that arrived together, with the same result as one by one, in less time."""
        firmware = self.firmware
        alone = len(wires) == 1  # as over every link in memory, where tests look at each in `handle`
        unfit = firmware.crashed or any(len(wire) != PAYLOAD_SIZE for wire in wires)
        if alone or unfit or self.profile.longest_reply < MAX_DATA:
            for wire in wires:
                self.handle(wire, source, now)
            return
        self.requests.update(map(_OPCODE, wires))
        firmware.handle_run(wires, source, now)

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Return (target, 251-byte payload) of the replies due by `now`, in order."""
        return self.firmware.outgoing(now)

    def next_deadline(self) -> float | None:
        """Return when to call `outgoing` again if no request arrives; a past time if there is a reply now."""
        return self.firmware.next_deadline()

    def reboot(self, now: float) -> None:
        """Lose every session, queue and reply, as a restarted vehicle does. Files stay, except for the bytes
        that FAT storage writes only when a file is closed.
        """
        self.firmware.crashed = False
        self._storage.lose_power()
        self._storage.virtual.reboot()
        self.firmware.reboot(now)

    @property
    def open_paths(self) -> list[bytes]:
        """Paths of the files that clients hold open, as they named them."""
        return self.firmware.open_paths()

    @property
    def open_sessions(self) -> int:
        """The number of sessions that hold a file."""
        return len(self.open_paths)


HEARTBEAT_PERIOD = 1.0
CAPACITY_MIB = 30436.0
"""A 32 GB card."""

_TYPE_QUADROTOR = 2
_AUTOPILOT_TYPE = {Family.ARDUPILOT: 3, Family.PX4: 12, Family.MAVSDK: 0}
_MAVLINK2 = 0x2000
_MODE_ENABLED = 0x01 | 0x40
_ACCEPTED = 0
_UNSUPPORTED = 3
_UNIX_AT_START = 1_795_000_000
_MOST_TELEMETRY_PER_CALL = 50
_SLOWED = 4.0
_SLOWED_FOR = 1.0


class SimVehicle:
    """One vehicle on one link.

    Args:
        telemetry: bytes per second of other messages beside heartbeat and system time.
        armed: at the start; after a reboot it is always disarmed.
        signing_key: as for Framer.

    Attributes:
        tells_time: whether it sends its boot time unasked. ArduCopter does so only after a request for its
            EXTRA3.
        on_news: called when somebody changed the vehicle from outside, so that the link looks at it again.
    """

    def __init__(
        self,
        tree: Tree,
        profile: Profile,
        *,
        rng: random.Random,
        address: Address = AUTOPILOT,
        telemetry: float = 0.0,
        armed: bool = False,
        signing_key: bytes | None = None,
    ) -> None:
        self.server = FtpServer(tree, profile, rng=rng)
        self.framer = Framer(address, stream=False, signing_key=signing_key)
        self.profile = profile
        self.address = address
        self.telemetry = telemetry
        self.armed = armed
        self.tells_time = True
        self.on_news: Callable[[], None] = lambda: None
        self.heard: dict[Address, Heartbeat] = {}
        self._uid = rng.getrandbits(64) ^ address.system  # differs for a second vehicle of the same seed
        self._booted_at: float | None = None
        self._down_until = float("-inf")
        self._next_beat = float("-inf")
        self._next_telemetry = float("-inf")
        self._telemetry_step = 0
        self._replied_at = float("-inf")
        self._ready: list[bytes] = []

    def arm(self) -> None:
        """Arm, and send the next heartbeat at once."""
        self._set_armed(True)

    def disarm(self) -> None:
        """Disarm, and send the next heartbeat at once."""
        self._set_armed(False)

    def reboot(self, now: float, downtime: float = 0.0, *, beat_after: float = 0.0) -> None:
        """Restart: sessions and boot time are lost, files stay; the vehicle is deaf and mute for `downtime`
        seconds. The first heartbeat and boot time are sent `beat_after` seconds later."""
        self.server.reboot(now)
        self.framer.reset()
        self.armed = False
        self._ready.clear()
        self._booted_at = now
        self._down_until = now + downtime
        self._next_beat = self._down_until + beat_after
        self._next_telemetry = float("-inf")
        self.on_news()

    def set_stream(self, stream: bool) -> None:
        """Set, before the first `receive`, whether that takes pieces of a stream or datagrams."""
        self.framer.stream = stream

    def receive(self, data: bytes, now: float) -> None:
        """Take a datagram or a piece of the stream."""
        if now < self._down_until:
            return
        address = self.address
        for message in self.framer.feed(data):
            if type(message) is FtpRun:  # a transfer has thousands of these a second
                source, target, payloads = message
                if target == address or self._is_for_us(target):
                    self.server.handle_run(payloads, source, now)
                continue
            match message:
                case CommandLong():
                    if self._is_for_us(message.target):
                        self._on_command(message, now)
                case Heartbeat():
                    self.heard[message.source] = message

    def foreign_request(self, payload: bytes, source: Address, now: float, *, audible: bool = True) -> None:
        """Let another ground station send a request over another link.

        This link hears the replies to `source`, too, and, if `audible`, the request, as a router forwards it.
        """
        if audible:
            self._ready.append(Framer(source, stream=False).encode_ftp(self.address, payload))
        self.server.handle(payload, source, now)
        self.on_news()

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT."""
        self._ready.append(self.framer.encode("statustext", severity, text.encode()[:50]))
        self.on_news()

    def outgoing(self, now: float) -> list[bytes]:
        """Return the frames to send now, in order."""
        if now < self._down_until:
            return []
        if self._booted_at is None:
            self._booted_at = now
        frames, self._ready = self._ready, []
        if now >= self._next_beat:
            self._beat(frames, now)
        replies = self.server.outgoing(now)
        if replies:
            self._replied_at = now
            for target, run in groupby(replies, key=itemgetter(0)):
                frames += self.framer.encode_ftp_run(target, [wire for _, wire in run])
        if self.telemetry > 0:
            self._add_telemetry(frames, now)
        return frames

    def next_deadline(self) -> float:
        """Return when to call `outgoing` again if nothing arrives; a past time if there is a frame now."""
        if self._ready:
            return self._down_until
        due = self._next_beat
        if self.telemetry > 0:
            due = min(due, self._next_telemetry)
        server = self.server.next_deadline()
        if server is not None:
            due = min(due, server)
        return max(due, self._down_until)

    def _set_armed(self, armed: bool) -> None:
        self.armed = armed
        self._next_beat = float("-inf")
        self.on_news()

    def _is_for_us(self, target: Address) -> bool:
        if target.system not in (0, self.address.system):
            return False
        # ArduPilot also answers for components of its system that it cannot reach (MAVLink_routing.cpp).
        answers_for_all = self.profile.family is Family.ARDUPILOT
        return target.component in (0, self.address.component) or answers_for_all

    def _boot_ms(self, now: float) -> int:
        return int((now - (now if self._booted_at is None else self._booted_at)) * 1000)

    def _beat(self, frames: list[bytes], now: float) -> None:
        mode = _MODE_ENABLED | (MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        status = 4 if self.armed else 3
        frames.append(
            self.framer.encode_heartbeat(_TYPE_QUADROTOR, _AUTOPILOT_TYPE[self.profile.family], mode, status)
        )
        if self.tells_time:
            frames.append(self._system_time(now))
        self._next_beat = now + HEARTBEAT_PERIOD

    def _add_telemetry(self, frames: list[bytes], now: float) -> None:
        """Add the messages that are due. For a second after each FTP reply ArduPilot sends only a quarter
        (GCS_Common.cpp)."""
        slowed = self.profile.family is Family.ARDUPILOT and now - self._replied_at < _SLOWED_FOR
        rate = self.telemetry / (_SLOWED if slowed else 1.0)
        for _ in range(_MOST_TELEMETRY_PER_CALL):
            if self._next_telemetry > now:
                return
            frame = self.framer.encode(*telemetry(self._telemetry_step, self._boot_ms(now)))
            self._telemetry_step += 1
            frames.append(frame)
            self._next_telemetry = max(self._next_telemetry, self._booted_at or 0.0) + len(frame) / rate
        self._next_telemetry = now  # because an autopilot skips messages that it could not send

    def _on_command(self, command: CommandLong, now: float) -> None:
        wanted = int(command.params[0]) if abs(command.params[0]) < 1e6 else -1
        asks = command.command == MAV_CMD_REQUEST_MESSAGE
        frame: bytes | None = None
        if command.command == MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
            asks and wanted == AUTOPILOT_VERSION_ID
        ):
            frame = self._version()
        elif asks and wanted == SYSTEM_TIME_ID:
            frame = self._system_time(now)
        elif asks and wanted == STORAGE_INFORMATION_ID and self.profile.family is not Family.MAVSDK:
            size = (CAPACITY_MIB, CAPACITY_MIB / 4, CAPACITY_MIB * 3 / 4)
            frame = self.framer.encode("storage_information", self._boot_ms(now), 1, 1, 2, *size, 0, 0)
        result = _UNSUPPORTED if frame is None else _ACCEPTED
        self._ready.append(self.framer.encode("command_ack", command.command, result, 0, 0, *command.source))
        if frame is not None:
            self._ready.append(frame)

    def _system_time(self, now: float) -> bytes:
        boot_ms = self._boot_ms(now)
        return self.framer.encode("system_time", _UNIX_AT_START * 1_000_000 + boot_ms * 1000, boot_ms)

    def _version(self) -> bytes:
        # MAVSDK's server never says that it speaks FTP (servers.md 5).
        ftp = 0 if self.profile.family is Family.MAVSDK else MAV_PROTOCOL_CAPABILITY_FTP
        versions = (ftp | _MAVLINK2, self.profile.version, 0, 0, 0, b"simulate", bytes(8), bytes(8), 0, 0)
        return self.framer.encode("autopilot_version", *versions, self._uid, list(bytes(18)))


def telemetry(step: int, boot_ms: int) -> tuple[Any, ...]:
    """Return the next message of an autopilot's usual mix, for Framer.encode; `step` counts up."""
    mix: tuple[tuple[Any, ...], ...] = (
        ("attitude", boot_ms, 0.1, 0.2, 0.3, 0.01, 0.02, 0.03),
        ("global_position_int", boot_ms, 473977418, 85455938, 488000, 50000, 120, -30, 4, 9000),
        ("vfr_hud", 12.5, 12.0, 90, 55, 488.1, 0.4),
        ("sys_status", *[0x3FFFFF] * 3, 350, 15800, 1200, 80, 0, 0, 1, 1, 1, 1),
        ("highres_imu", boot_ms * 1000, *[0.1] * 9, 958.0, 1.0, 488.0, 31.5, 0x1FFF),
    )
    return mix[step % len(mix)]
