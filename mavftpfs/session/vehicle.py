"""The vehicle and its neighbours on the link, as their messages show them. Layer: session; pure.

Everything here is learned by listening. Link health (promise 4) is heartbeats plus one fact from the
session: that a request timed out since the last heartbeat.

Two vehicles have the same MAVLink address unless somebody gave them others: PX4's system id is 1 wherever it
is fresh. Bytes for the first must not be written to the second, nor a file of one be completed from the
other. So a vehicle that once reported its unique id (AUTOPILOT_VERSION) has to report it again after each
restart and each silence, before this connection believes or sends anything else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Any

from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_COMP_ID_AUTOPILOT1,
    MAV_PROTOCOL_CAPABILITY_FTP,
    Address,
    AutopilotVersion,
    CommandAck,
    FtpRun,
    Heartbeat,
    Message,
    StatusText,
    StorageInformation,
    SystemTime,
)
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import Armed, VehicleLost
from mavftpfs.shared.readable import autopilot_name

SILENCE_LIMIT = 5.0
"""Seconds without heartbeats after which one timed-out request means that the vehicle is lost."""

ABSENCE = 2.5
"""Seconds of silence in which a vehicle may have restarted, or have been exchanged for another: no autopilot
starts faster. (A cable that is moved reopens the link, which is told.)"""

_REPLACED = "another vehicle answers, or the mounted one stopped sending its unique id"
_SILENT = "the vehicle is silent; waiting for its heartbeat"

_OPCODE_INDEX = 3
_SLACK_MS = 2000
"""How far behind a message may be whose vehicle did not restart."""

_MOST_DELAY_MS = 20_000
"""More than a full queue delays a message."""


class Standing(Enum):
    """Whether the one that answers is the vehicle that was mounted."""

    TRUSTED = "trusted"
    DOUBTED = "doubted"
    STRANGER = "stranger"


class Identity:
    """Tells the vehicle from another one at its address, by the unique id.

    | what happens | standing |
    |---|---|
    | it was silent, it restarted, or the link was reopened | DOUBTED, if it ever told its id |
    | it answers from another network address | the same |
    | it tells the id that is known, or the first one | TRUSTED |
    | it tells another id | STRANGER |
    | while DOUBTED it is heard for `patience` seconds, and does not tell its id | STRANGER |

    Attributes:
        standing: of the one that answers now. Only a trusted one is asked for files.
        heard_at: when it was heard last.
        left_at: when it was heard last before it was away, the last time.
    """

    def __init__(
        self,
        on_doubt: Callable[[], None],
        on_trusted: Callable[[], None],
        on_stranger: Callable[[bool], None],
        patience: float,
    ) -> None:
        """on_doubt: it is to be asked, because it may have restarted, or be another one. on_trusted: it is
        TRUSTED again. on_stranger: called with whether it told another id."""
        self._patience = patience
        self.standing = Standing.TRUSTED
        self._on_doubt, self._on_trusted, self._on_stranger = on_doubt, on_trusted, on_stranger
        self._known: AutopilotVersion | None = None  # its id, once it was told
        self._doubted_for = 0.0  # seconds for which it was heard while DOUBTED
        self.heard_at = self.left_at = -inf

    def may_be_asked(self, now: float) -> bool:
        """Whether requests may go out now: not into a silence either, at whose end another one may hear."""
        heard = self._known is None or now - self.heard_at <= ABSENCE
        return heard and self.standing is Standing.TRUSTED

    def heard(self, now: float) -> None:
        """Note that something came from the vehicle's address."""
        pause = now - self.heard_at
        if ABSENCE < pause < inf:
            self.reopened()
        self.heard_at = now
        if self.standing is Standing.DOUBTED:
            self._doubted_for += min(pause, ABSENCE)
            if self._doubted_for > self._patience:
                self._is_stranger(told=False)

    def reopened(self) -> None:
        """Note that the link was reopened, or that the vehicle answers from another network address: it may
        have been away, or be another vehicle."""
        self.left_at = self.heard_at
        self.doubt()

    def doubt(self) -> None:
        """Doubt that this is still the same vehicle, because it restarted or was away."""
        if self._known is not None and self.standing is not Standing.DOUBTED:
            self.standing, self._doubted_for = Standing.DOUBTED, 0.0
        self._on_doubt()

    def told(self, version: AutopilotVersion) -> bool:
        """Take the id that the vehicle told; return whether it is the same as ever."""
        if self._known is not None and is_another(self._known, version):
            self._is_stranger(told=True)
            return False
        if self._known is None and (version.uid or any(version.uid2)):
            self._known = version
        if self.standing is not Standing.TRUSTED:
            self.standing = Standing.TRUSTED
            self._on_trusted()
        return True

    def _is_stranger(self, *, told: bool) -> None:
        if self.standing is not Standing.STRANGER:
            self.standing = Standing.STRANGER
            self._on_stranger(told)
            self._on_doubt()  # it is asked on, because the known vehicle may return without a silence


def is_another(known: AutopilotVersion, version: AutopilotVersion) -> bool:
    """Return whether two answers are of two boards.

    A field that one of them lacks proves nothing: uid2 is an extension, which MAVLink 1 frames do not carry.
    """
    if known.uid and version.uid and known.uid != version.uid:
        return True
    return any(known.uid2) and any(version.uid2) and known.uid2 != version.uid2


@dataclass(slots=True)
class BootTime:
    """The boot time that the vehicle told last, which shows whether it restarted since then.

    Simulators run at half to twice the clock's speed. So after a restart, the boot time is at most twice what
    passed since the last one. If it is behind and more than that, the network held the message back.
    Exception: two of them in a row are believed, whatever clock they follow.

    told_ms: milliseconds since the vehicle started, by the last message that was believed. told_at: when that
    message came.
    """

    told_ms: int
    told_at: float
    _held_back: bool = False

    def shows_restart(self, boot_ms: int, now: float, left_at: float) -> bool:
        """Take the next boot time; return whether the vehicle restarted. left_at: see Identity."""
        passed_ms = (now - self.told_at) * 1000
        # It counted on until it left, perhaps for long: some tell their boot time only when they are asked.
        counted_ms = max(0.0, left_at - self.told_at) * 1000
        least = max(counted_ms / 2 - _SLACK_MS, passed_ms / 2 - _MOST_DELAY_MS)
        is_behind = boot_ms - self.told_ms < least
        self._held_back = is_behind and not self._held_back and boot_ms > 2 * passed_ms + _MOST_DELAY_MS
        if not self._held_back:
            self.told_ms, self.told_at = boot_ms, now
        return is_behind and not self._held_back


@dataclass(slots=True)
class Vehicle:
    """Records what the target and its neighbours on the link tell.

    wanted_system, wanted_component: 0 = the first autopilot heard, resp. that system's autopilot.
    write_armed: write in flight, too.
    own: this connection's address. on_another_client: called with each payload from or to another FTP client.
    on_heartbeat: called with whether the vehicle was lost. on_refusal: called when it refuses to arm.
    on_double: called when another program uses the address `own`. on_doubt, on_stranger, patience: see
    Identity.

    Attributes:
        armed: whether to treat it as armed; never heard counts as armed.
    """

    wanted_system: int
    wanted_component: int
    own: Address
    write_armed: bool = False
    on_reboot: Callable[[], None] = lambda: None
    on_another_client: Callable[[bytes], None] = lambda payload: None
    on_heartbeat: Callable[[bool], None] = lambda was_lost: None
    on_armed: Callable[[bool], None] = lambda armed: None
    on_refusal: Callable[[], None] = lambda: None
    on_double: Callable[[], None] = lambda: None
    on_doubt: Callable[[], None] = lambda: None
    on_stranger: Callable[[bool], None] = lambda told: None
    patience: float = 30.0
    address: Address | None = None
    heartbeat: Heartbeat | None = None
    heartbeat_at: float = -inf
    version: AutopilotVersion | None = None
    storage: StorageInformation | None = None
    reboots: int = 0
    refusals: int = 0
    identity: Identity = field(init=False)
    heard: dict[Address, Heartbeat] = field(default_factory=dict)
    armed: bool = True
    _disarmed_at: float = -inf
    _boot: BootTime | None = None
    _timed_out: bool = False

    def __post_init__(self) -> None:
        self.identity = Identity(self.on_doubt, self._on_trusted, self._on_stranger, self.patience)

    @property
    def may_write(self) -> bool:
        """Whether it may be written to now (promise 9)."""
        return self.write_armed or not self.armed

    @property
    def ftp_flag(self) -> bool | None:
        """AUTOPILOT_VERSION's FTP capability, None while unknown. It proves nothing (servers.md 5)."""
        return None if self.version is None else bool(self.version.capabilities & MAV_PROTOCOL_CAPABILITY_FTP)

    def status(self, now: float) -> dict[str, Any]:
        """Return JSON-able facts: those of `vehicle` in docs/json.md, `status --json`."""
        heartbeat, version = self.heartbeat, self.version
        return {
            "system": None if self.address is None else self.address.system,
            "component": None if self.address is None else self.address.component,
            "autopilot": None if heartbeat is None else autopilot_name(heartbeat.autopilot),
            "armed": self.armed,
            "heartbeat_age": None if heartbeat is None else round(self.silence(now), 1),
            "says_ftp": self.ftp_flag,
            "firmware": None if version is None else version.firmware,
            "uid": None if version is None else version.board,
            "restarts": self.reboots,
            "arming_refused": self.refusals,
        }

    def silence(self, now: float) -> float:
        """Return the seconds since the vehicle's last heartbeat (infinite before the first)."""
        return now - self.heartbeat_at

    def lost(self, now: float) -> bool:
        """Return whether requests that need the link should fail at once."""
        strange = self.identity.standing is Standing.STRANGER
        return strange or (self._timed_out and self.silence(now) > SILENCE_LIMIT)

    def require(self, now: float, *, writing: bool = False) -> None:
        """Raise VehicleLost while requests that need the link should fail at once; writing: or Armed while
        nothing may be written (promise 9)."""
        if writing and not self.may_write:
            raise Armed(readonly.ARMED)
        if self.identity.standing is Standing.STRANGER:
            raise VehicleLost(_REPLACED)
        if self.lost(now):
            raise VehicleLost(_SILENT)

    def why_lost(self, now: float) -> str | None:
        """Return why nothing should begin that needs the vehicle; None if it may.

        Requests in flight go on until one of them has timed out, too (`lost`): the vehicle may return.
        """
        if self.identity.standing is Standing.STRANGER:
            return _REPLACED
        silent = self.identity.heard_at <= now - SILENCE_LIMIT
        return _SILENT if silent or self.lost(now) else None

    @property
    def lacks_boot_time(self) -> bool:
        """Whether its boot time is worth asking for, because some tell it only then (ArduCopter): it was not
        told yet, or the vehicle was away since, so a restart may have gone unnoticed."""
        return self._boot is None or self._boot.told_at <= self.identity.left_at

    def note_timeout(self) -> None:
        """Note that a request to the vehicle went unanswered to its deadline."""
        self._timed_out = True

    def on_message(self, message: Message, now: float) -> None:
        """Learn from any message except FTP replies to this connection."""
        if self.address is not None and message.source == self.address:
            self.identity.heard(now)
        match message:
            case Heartbeat():
                self._on_heartbeat(message, now)
            case FtpRun():
                self._on_ftp_of_another_client(message)
            case _ if self.address is None or message.source.system != self.address.system:
                return
            case AutopilotVersion() if message.source == self.address:
                if self.identity.told(message):
                    self.version = message
            case _ if self.identity.standing is Standing.STRANGER:
                return
            case StorageInformation():
                if self.storage is None or message.storage_id <= self.storage.storage_id:
                    self.storage = message
            case SystemTime() if message.source == self.address:
                self._on_boot_time(message.time_boot_ms, now)
            case CommandAck() | StatusText() if message.refuses_to_arm:
                self.refusals += 1
                self.on_refusal()

    def _on_heartbeat(self, heartbeat: Heartbeat, now: float) -> None:
        """Learn from a heartbeat, in this order: which components there are, which of them is the vehicle,
        whether it is armed, and that it lives."""
        source, pilot = heartbeat.source, heartbeat.autopilot != MAV_AUTOPILOT_INVALID
        if source == self.own:
            self.on_double()
            return
        if len(self.heard) < 256 or source in self.heard:
            self.heard[source] = heartbeat
        if self.address is None and self.wanted_system in (0, source.system):
            component = self.wanted_component or (source.component if pilot else 0)
            if pilot or source.component == component != 0:
                self.address = Address(source.system, component)
        if self.address is None or source.system != self.address.system:
            return
        if pilot:
            self._disarmed_at = -inf if heartbeat.armed else now
            # While it is unknown which vehicle answers, "disarmed" is not believed.
            if heartbeat.armed or self.identity.may_be_asked(now):
                self._on_armed(heartbeat.armed)
        # A component may send no heartbeats of its own; its system's autopilot then speaks for it.
        speaks = self.address not in self.heard and source.component == MAV_COMP_ID_AUTOPILOT1
        if source != self.address and not speaks:
            return
        was_lost = self.lost(now)
        self.heartbeat, self.heartbeat_at = heartbeat, now
        self.identity.heard(now)
        if self.identity.standing is Standing.TRUSTED:
            self._lives(was_lost)

    def _lives(self, was_lost: bool) -> None:
        self._timed_out = False
        self.on_heartbeat(was_lost)

    def _on_trusted(self) -> None:
        """Believe that it is disarmed if it said so since it was away. Exception: after a STRANGER, who may
        have said so, or a request that timed out, only its next heartbeat is believed."""
        if not self._timed_out and self._disarmed_at > self.identity.left_at:
            self._on_armed(False)
        self._lives(self._timed_out)

    def _on_stranger(self, told: bool) -> None:
        """Count the vehicle as restarted when another one takes its place, whose boot times tell nothing."""
        self._boot, self._timed_out = None, True
        self._on_restart()
        self.on_stranger(told)

    def _on_restart(self) -> None:
        self.reboots += 1
        self.on_reboot()

    def _on_armed(self, armed: bool) -> None:
        if armed is not self.armed:
            self.armed = armed
            self.on_armed(armed)

    def _on_ftp_of_another_client(self, run: FtpRun) -> None:
        if self.address is None or run.source == self.own:
            return
        for payload in run.payloads:
            if payload[_OPCODE_INDEX] in (Opcode.ACK, Opcode.NAK):
                theirs = run.source == self.address and run.target != self.own
            else:
                theirs = run.target.system in (0, self.address.system)
            if theirs:
                self.on_another_client(payload)

    def _on_boot_time(self, boot_ms: int, now: float) -> None:
        if self._boot is None:
            self._boot = BootTime(boot_ms, now)
        elif self._boot.shows_restart(boot_ms, now, self.identity.left_at):
            self.identity.doubt()
            self._on_restart()
