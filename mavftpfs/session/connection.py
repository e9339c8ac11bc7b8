"""A live connection to one vehicle: builds the session's objects and runs their tasks. Layer: session."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from functools import partial
from math import inf
from typing import Any

import trio

from mavftpfs.link.addresses import readable_address
from mavftpfs.link.base import Link
from mavftpfs.link.framing import (
    AUTOPILOT_VERSION_ID,
    STORAGE_INFORMATION_ID,
    SYSTEM_TIME_ID,
    Framer,
    FramerStats,
)
from mavftpfs.link.messages import (
    MAV_AUTOPILOT_INVALID,
    MAV_TYPE_ONBOARD_CONTROLLER,
    OWN_COMPONENT,
    Address,
    Heartbeat,
)
from mavftpfs.link.peers import names_of
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.session.driver import Driver, PayloadSink
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.store import Store
from mavftpfs.session.upload import Upload
from mavftpfs.session.vehicle import SILENCE_LIMIT, Standing, Vehicle
from mavftpfs.shared.errors import MavftpfsError, VehicleLost
from mavftpfs.shared.options import Options

log = logging.getLogger("mavftpfs.session")

SIGNING_EPOCH = 1_420_070_400
"""2015-01-01 UTC in seconds since 1970 (MAVLink guide, "Message Signing")."""

LOSSY = 0.1
"""The share of lost packets from which the link is no longer reported as fine."""

HEARTBEAT_PERIOD = 1.0
MOST_HEARD = 32
"""The most components in a status, which must fit into an extended attribute."""
HEARD_SOON = 1.2
"""Seconds in which a present vehicle is heard, because it sends one heartbeat a second."""
TERMINATE_ON_EXIT, WHERE_SILENT = 5.0, 1.0
"""Seconds for closing the server's session at the end of a connection, at most; the second if the vehicle is
not heard."""

SILENT_ON_EXIT = 2.5
"""Seconds without a heartbeat after which the vehicle is not heard: at least two heartbeats are missing."""

_INFO_TRIES = 5
_INFO_PERIOD, _HURRIED = 2.0, 0.5
"""Seconds between two requests for the same; the second where it is doubted that the vehicle is the same."""

_OLD_WAY_FROM = 2
"""The try from which AUTOPILOT_VERSION is also requested in the way of older firmware."""

_ANOTHER = "another vehicle answers as %d/%d: nothing is read from it or written to it; mount it anew"
_TELLS_NO_ID = "%d/%d stopped sending its unique id: nothing is read from it or written to it until it does"


@dataclass(frozen=True, slots=True)
class ConnectOptions(Options):
    """The options, and the key from the file of `signing_key`.

    With `bwlimit` nothing is read by bursts, because the server sets their pace.

    patient: wait for another client as long as it is heard and has a file open, because a person may
        interrupt this command; otherwise SessionBusy after `op_deadline`.
    """

    key: bytes | None = None
    patient: bool = False


class Connection:
    """One reachable vehicle. Made by `connected`, which runs its tasks.

    Attributes:
        began_at: the time since which the link is listened to. news: see `subscribe`.
    """

    def __init__(
        self,
        link: Link,
        options: ConnectOptions,
        *,
        rng: random.Random,
        clock: Callable[[], float],
        on_payload: PayloadSink | None = None,
        on_frame: Callable[[bytes], None] | None = None,
    ) -> None:
        self.link, self.options, self.clock = link, options, clock
        self.began_at = clock()
        self.news: list[Callable[[str], None]] = []
        self._first_heartbeat, self._doubted = trio.Event(), trio.Event()
        own = Address(options.source_system, OWN_COMPONENT) if link.seat is None else link.seat.own
        framer = Framer(
            own,
            stream=link.is_stream,
            signing_key=options.key,
            signing_clock=signing_now,
            on_frame=on_frame,
        )
        framer.link_id = 0 if link.seat is None else link.seat.number
        self.vehicle = Vehicle(
            options.target_system,
            options.target_component,
            own,
            write_armed=options.when_armed == "ok",
            on_reboot=self._on_reboot,
            on_another_client=self._on_another_client,
            on_heartbeat=self._on_heartbeat,
            on_armed=self._on_armed,
            on_refusal=partial(self._tell, "arming refused"),
            on_double=self._move_away,
            on_doubt=self._on_doubt,
            on_stranger=self._on_stranger,
            patience=options.op_deadline,
        )
        flow = Flow(serial=link.is_serial, bwlimit=options.bwlimit)
        self.engine = Engine(rng, flow, op_deadline=options.op_deadline)
        self.driver = Driver(link, framer, self.engine, self.vehicle, clock=clock, on_payload=on_payload)
        self.scheduler = Scheduler(
            self.driver,
            clock=clock,
            rng=rng,
            op_deadline=options.op_deadline,
            patient=options.patient,
            read_mode=options.read_mode if options.bwlimit is None else "window",
            chunk=options.chunk,
        )
        self.store = Store(self.scheduler)

    async def ready(self, timeout: float, on_wait: Callable[[], None] = lambda: None) -> None:
        """Wait for the vehicle's first heartbeat; on_wait: called if it does not arrive at once.

        Raises:
            VehicleLost: none within `timeout` seconds; the text says what was heard instead.
        """
        if not await heard_within(self._first_heartbeat, timeout, on_wait):
            raise nobody(self.link, timeout, self.vehicle.heard, self.driver.framer.stats)

    def subscribe(self, listener: Callable[[str], None]) -> None:
        """Call `listener` with "reboot", "armed", "disarmed", "arming refused" or "back" from now on."""
        self.news.append(listener)

    def status(self) -> dict[str, dict[str, Any]]:
        """Return JSON-able facts: `vehicle` and `link` (docs/json.md, `status --json`), and details."""
        now, stats, link = self.clock(), self.engine.stats, self.link
        heartbeat, server = self.vehicle.heartbeat, self.scheduler.server.opened
        details = {
            "autopilot": None if heartbeat is None else heartbeat.autopilot,
            "type": None if heartbeat is None else heartbeat.vehicle_type,
            "read_mode": self.scheduler.read_mode,
            "window": self.engine.flow.window,
            "in_flight": self.engine.in_flight,
            "chunk": self.scheduler.read_chunks.size,
            "session_open": None if server is None else server.path.decode("utf-8", "replace"),
            **asdict(self.engine.traits),
            "uploads": [user.status() for user in self.scheduler.users if isinstance(user, Upload)],
            "heard": [
                asdict(self.vehicle.heard[source]) for source in sorted(self.vehicle.heard)[:MOST_HEARD]
            ],
            "dropped_sends": link.stats.dropped_sends,
            "bad_frames": self.driver.framer.stats.bad_crc,
        }
        return {
            "vehicle": {**self.vehicle.status(now), "when_armed": self.options.when_armed},
            "link": {
                "state": self._link_state(now),
                "rtt": self.engine.rtt,
                "loss": round(self.engine.flow.path.loss, 4),
                "other_ftp_client": self.scheduler.server.others.are_heard(now),
                "waits_for": self.scheduler.waits_for,
                "received_bytes": link.stats.received_bytes,
                "sent_bytes": link.stats.sent_bytes,
                "requests": stats.requests,
                "retransmissions": stats.lost,
                "reopened": link.stats.reopened,
                "source": link.description,
                "address": None if self.driver.peer is None else readable_address(self.driver.peer),
                "second": None if self.driver.second is None else readable_address(self.driver.second),
            },
            "connection": details,
        }

    def _link_state(self, now: float) -> str:
        """Return `fine`, `lossy`, `lost`, or `replaced` if another vehicle answers in place of the known
        one."""
        if self.vehicle.identity.standing is Standing.STRANGER:
            return "replaced"
        if SILENCE_LIMIT < self.vehicle.silence(now) < inf or self.vehicle.lost(now):
            return "lost"
        return "lossy" if self.engine.flow.path.loss >= LOSSY else "fine"

    # --- what the vehicle tells

    def _on_reboot(self) -> None:
        self.engine.forget_server()
        self.scheduler.server.distrust(reads=True)
        self._tell("reboot")

    def _on_another_client(self, payload: bytes) -> None:
        self.engine.flow.sole_client = False
        self.scheduler.server.on_another_client(payload)

    def _on_armed(self, armed: bool) -> None:
        self.scheduler.on_armed_changed()
        self._tell("armed" if armed else "disarmed")

    def _move_away(self) -> None:
        """Take the next component id, because another program uses this one, and replies would be
        ambiguous."""
        own = self.vehicle.own
        # If even the sixth id is taken, the messages are more likely this connection's echo.
        if own.component - OWN_COMPONENT <= 5:
            self.vehicle.own = self.driver.framer.source = Address(own.system, own.component % 249 + 1)

    def _on_doubt(self) -> None:
        self._doubted.set()  # wakes `_ask_about_vehicle`

    def _on_stranger(self, told: bool) -> None:
        if self.vehicle.address is not None:
            log.warning(_ANOTHER if told else _TELLS_NO_ID, *self.vehicle.address)

    def _on_heartbeat(self, was_lost: bool) -> None:
        self._first_heartbeat.set()
        if was_lost:
            self.scheduler.server.wake()
            self._tell("back")

    def _tell(self, news: str) -> None:
        for listener in self.news:
            listener(news)

    # --- what runs as long as the connection

    async def _beat(self) -> None:
        """Each second, send a heartbeat, and tell the flow control whether other clients are heard.

        The heartbeats are an onboard controller's, because those of a GCS would feed the GCS-loss failsafe
        (promise 6).
        """
        driver, others = self.driver, self.scheduler.server.others
        while True:
            driver.send(driver.framer.encode_heartbeat(MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID))
            self.engine.flow.sole_client = not others.are_heard(self.clock())
            await trio.sleep(HEARTBEAT_PERIOD)

    async def _ask_about_vehicle(self) -> None:
        """Ask for the vehicle's id, boot time and card, a few times, since none of this is necessary.

        Each time that the vehicle may have restarted, or may be another one, ask again, and for the id until
        it is known. Nothing is asked while the vehicle is silent.
        """
        driver, identity = self.driver, self.vehicle.identity
        await self._first_heartbeat.wait()
        while True:
            asked, asked_at, self._doubted = 0, -inf, trio.Event()
            while not self._doubted.is_set() and (wanted := self._wanted(asked)):
                address, now = self.vehicle.address, self.clock()
                period = _HURRIED if identity.standing is Standing.DOUBTED else _INFO_PERIOD
                if address is not None and identity.heard_at > asked_at and now - asked_at >= period:
                    for message_id in wanted:
                        driver.send(driver.framer.encode_request_message(address, message_id))
                    if asked >= _OLD_WAY_FROM and AUTOPILOT_VERSION_ID in wanted:
                        driver.send(driver.framer.encode_request_capabilities(address))
                    asked, asked_at = asked + 1, now
                await trio.sleep(_HURRIED)
            await self._doubted.wait()

    def _wanted(self, asked: int) -> list[int]:
        """Return the messages to request; asked: the number of earlier requests. The boot time comes first,
        because no file is requested before the id is known, and by then a restart is known, too."""
        vehicle, wanted, optional = self.vehicle, [], asked < _INFO_TRIES
        if optional and vehicle.lacks_boot_time:
            wanted.append(SYSTEM_TIME_ID)
        if vehicle.identity.standing is not Standing.TRUSTED or (optional and vehicle.version is None):
            wanted.append(AUTOPILOT_VERSION_ID)
        if optional and vehicle.storage is None:
            wanted.append(STORAGE_INFORMATION_ID)
        return wanted


async def heard_within(first: trio.Event, timeout: float, on_wait: Callable[[], None]) -> bool:
    """Return whether the first heartbeat arrives within `timeout` seconds.

    on_wait: called if it does not arrive at once.
    """
    with trio.move_on_after(min(HEARD_SOON, timeout)):
        await first.wait()
    if not first.is_set() and timeout > HEARD_SOON:
        on_wait()
        with trio.move_on_after(timeout - HEARD_SOON):
            await first.wait()
    return first.is_set()


def nobody(link: Link, timeout: float, heard: Mapping[Address, Heartbeat], stats: FramerStats) -> VehicleLost:
    """Return the error for no vehicle on a link within `timeout` seconds. heard: what was heard instead;
    stats: of the frames that arrived."""
    if heard:
        found = names_of(heard[source] for source in sorted(heard))
        reason = f"heard only {found}; check target_system and target_component"
    elif stats.bad_time:
        reason = (
            f"heard only {stats.bad_time} frames with the right key and a signature that is too old; "
            "compare the clocks of the vehicle and of this computer"
        )
    elif stats.bad_signature:
        reason = f"heard only {stats.bad_signature} frames with no or a bad signature; check signing_key"
    else:
        what = "cable and baud rate" if link.is_serial else "address, port and firewall"
        reason = f"no heartbeat heard at all; check SOURCE: {what}"
    return VehicleLost(f"no vehicle on {link.description} within {timeout:g} s: {reason}")


@asynccontextmanager
async def connected(
    link: Link,
    options: ConnectOptions,
    *,
    rng: random.Random | None = None,
    clock: Callable[[], float] = trio.current_time,
    on_payload: PayloadSink | None = None,
    on_frame: Callable[[bytes], None] | None = None,
) -> AsyncIterator[Connection]:
    """Run a connection over an open link for the length of the body; the session is terminated at its end.

    on_payload, on_frame: called with each FTP payload, and with each whole frame, received or sent.
    """
    rng = rng or random.SystemRandom()
    connection = Connection(link, options, rng=rng, clock=clock, on_payload=on_payload, on_frame=on_frame)
    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        serving = _Task(nursery, connection.scheduler.serve)
        tasks = [serving, _Task(nursery, connection.driver.pump), _Task(nursery, connection._beat)]
        tasks.append(_Task(nursery, connection._ask_about_vehicle))
        try:
            await connection.scheduler.serving.wait()
            yield connection
        except Exception as error:  # raised again outside the nursery, which would wrap it in a group
            failure = error
        finally:
            with trio.CancelScope(shield=True):
                await _leave(connection, serving)
            for task in tasks:
                task.scope.cancel()
    for task in tasks:
        failure = task.failure or failure
    if failure is not None:
        raise failure


async def _leave(connection: Connection, serving: _Task) -> None:
    """Close the server's session."""
    heard = connection.vehicle.silence(connection.clock()) <= SILENT_ON_EXIT
    with trio.move_on_after(TERMINATE_ON_EXIT if heard else WHERE_SILENT):
        serving.scope.cancel()
        await serving.ended.wait()
        await connection.scheduler.close()


class _Task:
    """A task that Ctrl-C does not cancel, because the session must be terminated first."""

    def __init__(self, nursery: trio.Nursery, function: Callable[[], Awaitable[None]]) -> None:
        self.scope = trio.CancelScope(shield=True)
        self.ended = trio.Event()
        self.failure: MavftpfsError | None = None
        nursery.start_soon(self._run, nursery, function)

    async def _run(self, nursery: trio.Nursery, function: Callable[[], Awaitable[None]]) -> None:
        try:
            with self.scope:
                await function()
        except MavftpfsError as error:
            self.failure = error
            nursery.cancel_scope.cancel()
        finally:
            self.ended.set()


def signing_now() -> int:
    """Return the present in MAVLink 2's signing time: units of 10 µs since 2015-01-01 UTC."""
    return int((time.time() - SIGNING_EPOCH) * 100_000)
