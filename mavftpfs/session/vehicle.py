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

CLIENT_MEMORY = 10.0
"""Seconds for which an FTP client that was heard counts as present."""

ABSENCE = 2.5
"""Seconds of silence in which a vehicle may have restarted, or have been exchanged for another: no autopilot
starts faster. (A cable that is moved reopens the link, which is told.)"""

_REPLACED = "another vehicle answers, or the mounted one stopped sending its unique id"
_SILENT = "the vehicle is silent; waiting for its heartbeat"

_OPCODE_INDEX = 3
_REBOOT_SLACK_MS = 2000
_OLDEST_NEWS_MS = 20_000
"""Of a restart that is news the boot time is less than twice what passed since the last message (simulators
may run faster than the clock), and this. A message that is further behind was held back by the network."""

_MISSING_MS = 20_000
"""Less boot time than half of what passed, and this beyond it, is a restart that nobody saw: a full queue
delays a message less, and simulators may run slower than the clock."""


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
    | while DOUBTED it is heard, and does not tell its id for `patience` seconds | STRANGER |

    Attributes:
        standing: of the one that answers now. Only a trusted one is asked for files.
        left_at: when it was heard last before it was away, the last time.
        heard_at: when it was heard last.
    """

    def __init__(
        self, on_doubt: Callable[[], None], on_trusted: Callable[[bool], None], patience: float
    ) -> None:
        """on_doubt: it may have restarted, or be another one: it is to be asked. on_trusted: called with
        whether it was a stranger meanwhile: it is trusted again."""
        self._patience = patience
        self.standing = Standing.TRUSTED
        self._on_doubt, self._on_trusted = on_doubt, on_trusted
        self._known: AutopilotVersion | None = None  # its id, once it was told
        # A stranger answered since it was trusted last: boot times heard meanwhile are not the vehicle's.
        self._strange = False
        self._doubted_from: float | None = None  # when it was first heard while it was doubted
        self.heard_at: float | None = None
        self._back_at = self.left_at = -inf  # the end of the last absence, and its beginning

    def may_be_asked(self, now: float) -> bool:
        """Whether requests may go out now: not into a silence either, at whose end another one may hear."""
        if self.standing is not Standing.TRUSTED:
            return False
        return self._known is None or self.heard_at is None or now - self.heard_at <= ABSENCE

    def heard(self, now: float) -> None:
        """Note that something came from the vehicle's address."""
        before, self.heard_at = self.heard_at, now
        if before is not None and now - before > ABSENCE:
            self.left_at, self._back_at = before, now
            self.doubt()
        if self.standing is Standing.DOUBTED and self._doubted_from is None:
            self._doubted_from = now

    def reopened(self, now: float) -> None:
        """Note that the link was reopened, or that the vehicle answers from another network address: it may
        have been away, or be another vehicle."""
        if self.heard_at is not None:
            self.left_at, self._back_at = self.heard_at, now
        self.doubt()

    def away_since(self, when: float, now: float) -> bool:
        """Return whether it was away after that, so that it may have restarted."""
        silent = self.heard_at is not None and now - self.heard_at > ABSENCE
        return silent or self._back_at > when

    def heard_since(self, when: float) -> bool:
        """Return whether something came from it after that."""
        return self.heard_at is not None and self.heard_at > when

    def doubt(self) -> None:
        """Doubt that this is still the same vehicle, because it restarted or was silent."""
        if self._known is not None and self.standing is not Standing.DOUBTED:
            self._strange |= self.standing is Standing.STRANGER
            self.standing, self._doubted_from = Standing.DOUBTED, None
        self._on_doubt()

    def told(self, version: AutopilotVersion) -> bool:
        """Take the id that the vehicle told; return whether it is the same as ever."""
        if self._known is not None and is_another(self._known, version):
            self._is_stranger()
            return False
        if self._known is None and (version.uid or any(version.uid2)):
            self._known = version
        self._trust()
        return True

    def expire(self, now: float) -> bool:
        """Take the vehicle for a stranger if it was heard for `patience` seconds without reporting its id;
        return whether it became one just now."""
        since = self._doubted_from
        late = self.standing is Standing.DOUBTED and since is not None and now - since > self._patience
        if late:
            self._is_stranger()
        return late

    def _is_stranger(self) -> None:
        was_trusted, self.standing = self.standing is Standing.TRUSTED, Standing.STRANGER
        if was_trusted:  # nobody asks, and the known vehicle may come back without a silence
            self._on_doubt()

    def _trust(self) -> None:
        if self.standing is Standing.TRUSTED:
            return
        strange = self._strange or self.standing is Standing.STRANGER
        self.standing, self._strange = Standing.TRUSTED, False
        self._on_trusted(strange)


def is_another(known: AutopilotVersion, version: AutopilotVersion) -> bool:
    """Return whether two answers are of two boards.

    A field that one of them lacks proves nothing: uid2 is an extension, which MAVLink 1 frames do not carry.
    """
    if known.uid and version.uid and known.uid != version.uid:
        return True
    return any(known.uid2) and any(version.uid2) and known.uid2 != version.uid2


@dataclass(slots=True)
class Vehicle:
    """Records what the target and its neighbours on the link tell.

    wanted_system, wanted_component: 0 = the first autopilot heard, resp. that system's autopilot.
    write_armed: write in flight, too.
    own: this connection's address. on_another_client: called with each payload from or to another FTP client,
    and whether none was heard for a while before. on_refusal: called when the vehicle refuses to arm.
    on_double: called when another program uses the address `own`. on_doubt, patience: see Identity.

    Attributes:
        armed: whether to treat it as armed; never heard counts as armed. may_write: whether it may be written
            to now (promise 9).
    """

    wanted_system: int
    wanted_component: int
    own: Address
    write_armed: bool = False
    on_reboot: Callable[[], None] = lambda: None
    on_another_client: Callable[[bytes, bool], None] = lambda payload, newcomer: None
    on_heartbeat: Callable[[], None] = lambda: None
    on_armed: Callable[[bool], None] = lambda armed: None
    on_refusal: Callable[[], None] = lambda: None
    on_double: Callable[[], None] = lambda: None
    on_doubt: Callable[[], None] = lambda: None
    patience: float = 30.0
    address: Address | None = None
    heartbeat: Heartbeat | None = None
    heartbeat_at: float | None = None
    version: AutopilotVersion | None = None
    storage: StorageInformation | None = None
    another_client_at: float | None = None
    reboots: int = 0
    refusals: int = 0
    identity: Identity = field(init=False)
    heard: dict[Address, Heartbeat] = field(default_factory=dict)
    armed: bool = True
    may_write: bool = False
    _told_armed: bool | None = None
    _disarmed_at: float = -inf
    _boot_ms: int | None = None
    boot_heard_at: float = -inf
    _held_back: bool = False
    _timed_out: bool = False

    def __post_init__(self) -> None:
        self.identity = Identity(self.on_doubt, self._on_trusted, self.patience)
        self.may_write = self.write_armed

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
        return inf if self.heartbeat_at is None else now - self.heartbeat_at

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
        silent = not self.identity.heard_since(now - SILENCE_LIMIT)
        return _SILENT if silent or self.lost(now) else None

    def another_client_heard(self, now: float) -> bool:
        """Return whether another FTP client of this vehicle was heard lately."""
        return self.another_client_at is not None and now - self.another_client_at < CLIENT_MEMORY

    @property
    def tells_boot_time(self) -> bool:
        """Whether it told it at all; some do only when they are asked (ArduCopter)."""
        return self.boot_heard_at > -inf

    def lacks_boot_time(self, now: float) -> bool:
        """Return whether its boot time is worth asking for again: it was away since it told it, so a restart
        may have gone unnoticed, or what it told does not count."""
        if not self.tells_boot_time:
            return False
        return self._boot_ms is None or self.identity.away_since(self.boot_heard_at, now)

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
                self._on_ftp_of_another_client(message, now)
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
        self.heartbeat_at = now
        self.heartbeat = heartbeat
        self.identity.heard(now)
        if self.identity.standing is Standing.TRUSTED:
            self._timed_out = False
            self.on_heartbeat()

    def _on_trusted(self, was_stranger: bool) -> None:
        """Trust the vehicle again. It counts as restarted if another one answered meanwhile, whose boot times
        tell nothing."""
        if was_stranger:
            self._boot_ms = None
            self.reboots += 1
            self.on_reboot()
        elif self._disarmed_at > self.identity.left_at:  # it was this one that said so
            self._on_armed(False)
        self._timed_out = False
        self.on_heartbeat()

    def _on_armed(self, armed: bool) -> None:
        if armed is not self._told_armed:
            self._told_armed = self.armed = armed
            self.may_write = self.write_armed or not armed
            self.on_armed(armed)

    def _on_ftp_of_another_client(self, run: FtpRun, now: float) -> None:
        if self.address is None or run.source == self.own:
            return
        for payload in run.payloads:
            if payload[_OPCODE_INDEX] in (Opcode.ACK, Opcode.NAK):
                theirs = run.source == self.address and run.target != self.own
            else:
                theirs = run.target.system in (0, self.address.system)
            if theirs:
                newcomer = not self.another_client_heard(now)
                self.another_client_at = now
                self.on_another_client(payload, newcomer)

    def _on_boot_time(self, boot_ms: int, now: float) -> None:
        before, elapsed_ms = self._boot_ms, (now - self.boot_heard_at) * 1000
        # It counted on until it was away: one that tells only when it is asked told this long before.
        # (Simulators may run slower than the clock.)
        counted_on = max(0.0, self.identity.left_at - self.boot_heard_at) * 1000 / 2
        went_back = before is not None and boot_ms + _REBOOT_SLACK_MS < before + counted_on
        # Two of them in a row are believed, whatever clock they follow.
        if went_back and boot_ms > 2 * elapsed_ms + _OLDEST_NEWS_MS and not self._held_back:
            self._held_back = True
            return
        self._held_back = False
        self._boot_ms, self.boot_heard_at = boot_ms, now
        if before is None:
            return
        if went_back or boot_ms - before < elapsed_ms / 2 - _MISSING_MS:
            self.reboots += 1
            self.identity.doubt()
            self.on_reboot()
