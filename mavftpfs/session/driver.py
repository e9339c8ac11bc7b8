"""The pump between link and engine. Layer: session; the only task that reads the link.

When a task starts an operation (`start`, `run`), its first request is sent before that task next awaits,
unless nothing may be sent. The pump wakes waiting tasks once per batch of input, never once per packet,
because a trio event and a time-out per request cost more than the rest of a chunk together.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from math import inf

import trio

from mavftpfs.link.addresses import AddressBook, NetAddress, readable_address
from mavftpfs.link.base import Link, Piece
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import MAV_COMP_ID_AUTOPILOT1, Address, FtpRun, Message
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.requests import Operation
from mavftpfs.session.vehicle import Standing, Vehicle
from mavftpfs.shared.errors import RequestTimeout

log = logging.getLogger("mavftpfs.session")

_MOVED = "the vehicle is silent at %s; its id is asked for at %s"
_IGNORED = (
    "%s says that it is %d/%d, too: ignored as long as the vehicle is heard where it was; "
    "if these are two vehicles, and not frames that a router sends back, give each a system id of its own"
)

QUIET = 0.5
"""Seconds of silence after which the driver stops waiting for the rest of a stream's frame. TCP may pause for
a retransmission; serial ports do not pause inside a frame."""

REFILL_AT = 32
"""The number of replies after which the engine fills free room at once, because the server works
meanwhile."""

BACKLOG_LIMIT = 16 * 1024
"""Unsent bytes in the link above which the engine is asked for no more, because an urgent request could not
overtake them."""


PayloadSink = Callable[[float, str, bytes], None]
"""Called with each FTP payload (251 bytes): the time, "request" or "reply", and the payload."""


class Driver:
    """Moves payloads between one link and one engine, and everything else to the vehicle.

    Attributes:
        second: the network address of another sender that claims to be the vehicle.
    """

    def __init__(
        self,
        link: Link,
        framer: Framer,
        engine: Engine,
        vehicle: Vehicle,
        *,
        clock: Callable[[], float],
        on_payload: PayloadSink | None = None,
    ) -> None:
        self.link = link
        self.framer = framer
        self.engine = engine
        self.vehicle = vehicle
        self.second: NetAddress | None = None
        self.last_reply_at = clock()
        self._heard_at = clock()
        self._clock = clock
        self._on_payload = on_payload
        self._addresses = AddressBook()
        self._impostor_at = inf  # when another sender claimed for the first time to be the vehicle
        self._waiting = trio.CancelScope()  # of `pump`, now or the next time
        # Each operation with its `on_finished` and `on_batch`.
        self._under_way: dict[Operation, tuple[Callable[[], None], Callable[[float], None] | None]] = {}
        self._silent_until = -inf
        self._gathered: list[bytes] = []

    @property
    def peer(self) -> NetAddress | None:
        """The vehicle's network address; None where the link has only one. A target that was never heard has
        the address of its system's autopilot."""
        target = self.vehicle.address
        if target is None:
            return None
        pilot = Address(target.system, MAV_COMP_ID_AUTOPILOT1)
        return self._addresses.of(target) or self._addresses.of(pilot)

    async def pump(self) -> None:
        """Run until cancelled or the link is closed for good (LinkClosed)."""
        sender: NetAddress | None = None
        while True:
            pieces: list[Piece] = []
            with self._waiting as waiting:
                pieces = await self.link.receive()
            self._waiting, now = trio.CancelScope(), self._clock()
            if waiting.cancelled_caught:
                self.engine.on_deadline(now)
                if self.framer.waiting and now >= self._heard_at + QUIET:
                    self._handle(self.framer.on_silence(), now, sender)
            for data, sender in pieces:
                if not data:
                    self._on_reopened(now)
                    continue
                self._heard_at = now
                self._handle(self.framer.feed(data), now, sender)
                if len(self._gathered) >= REFILL_AT:
                    self._pass_on(now)
                    self._refill(now)
            self._pass_on(now)
            for _, on_batch in list(self._under_way.values()):
                if on_batch is not None:
                    on_batch(now)
            self.kick()

    def _on_reopened(self, now: float) -> None:
        """Start afresh on a reopened link: half a frame is lost, the hub may have given this connection
        another seat, and another vehicle may answer."""
        self.framer.reset()
        if self.link.seat is not None:
            self.vehicle.own = self.framer.source = self.link.seat.own
            self.framer.link_id = self.link.seat.number
        self.vehicle.identity.reopened()

    async def run(self, operation: Operation) -> None:
        """Carry out an operation; cancelling the caller cancels the operation.

        Raises:
            MavftpfsError: the error of the operation.
        """
        finished = trio.Event()
        try:
            self.start(operation, finished.set)
            await finished.wait()
        finally:
            self.cancel(operation)
        if operation.error is not None:
            raise operation.error

    def start(
        self,
        operation: Operation,
        on_finished: Callable[[], None],
        on_batch: Callable[[float], None] | None = None,
    ) -> None:
        """Begin an operation.

        on_finished: called when the operation is done or has failed. on_batch: called until then after each
            batch of input, with the time.
        """
        self._under_way[operation] = on_finished, on_batch
        self.engine.start(operation, self._clock())
        self.kick()

    def cancel(self, operation: Operation) -> None:
        """Forget an operation (harmless if it has finished)."""
        if self._under_way.pop(operation, None) is not None:
            self.engine.remove(operation)
            self.kick()

    async def be_silent(self, seconds: float) -> None:
        """Send no FTP requests for `seconds` after the answers to those in flight. Operations wait."""
        seconds += self.engine.rtt or 0.0
        self._silent_until = max(self._silent_until, self._clock() + seconds)
        await trio.sleep(seconds)

    @property
    def silent(self) -> bool:
        """Whether `be_silent` holds back requests now."""
        return self._clock() < self._silent_until

    def kick(self) -> None:
        """Send the requests that may go out now, and call `on_finished` of operations that ended. Call this
        after anything that may have given the engine work."""
        now = self._clock()
        may_send = self._refill(now)
        for operation, (on_finished, _) in list(self._under_way.items()):
            if operation.done and self._under_way.pop(operation, None) is not None:
                if isinstance(operation.error, RequestTimeout):
                    self.vehicle.note_timeout()
                on_finished()
        due = self.engine.next_deadline()
        deadline = inf if due is None else due
        if self.link.backlog >= BACKLOG_LIMIT:
            # The link does not report that it drained, and before that nothing can go out.
            deadline = now + 0.01
        elif not may_send:
            deadline = max(deadline, now + 0.05)  # because nothing can be sent, whatever is due
        if self.framer.waiting:
            deadline = min(deadline, self._heard_at + QUIET)
        self._waiting.deadline = deadline

    def send(self, frame: bytes) -> None:
        """Send one ready frame that is not FTP (a heartbeat, a command)."""
        self.link.send([frame], self.peer)

    def _handle(self, messages: list[Message], now: float, sender: NetAddress | None) -> None:
        """Collect replies, and pass all other messages to the vehicle, in order."""
        vehicle = self.vehicle
        for message in messages:
            if sender is not None and not self._is_from(message.source, sender, now):
                continue
            ours = (vehicle.address, vehicle.own)
            if type(message) is FtpRun and (message.source, message.target) == ours:
                self._gathered += message.payloads
                continue
            self._pass_on(now)
            vehicle.on_message(message, now)
            # A target without heartbeats of its own moves with its system's autopilot.
            target, speaks = vehicle.address, message is vehicle.heartbeat
            if target is not None and sender is not None and speaks and self._addresses.of(target):
                self._is_from(target, sender, now)

    def _pass_on(self, now: float) -> None:
        """Pass the collected replies to the engine."""
        wires = self._gathered
        if not wires:
            return
        self._gathered = []
        self.vehicle.identity.heard(now)
        if self.vehicle.identity.standing is not Standing.TRUSTED:
            return  # the requests time out, and go out again when the vehicle has told its id
        if self._on_payload is not None:
            for wire in wires:
                self._on_payload(now, "reply", wire)
        malformed = self.engine.receive_run(wires, now)
        if malformed < len(wires):
            self.last_reply_at = now

    def _is_from(self, source: Address, sender: NetAddress, now: float) -> bool:
        """Return whether a message from this network address counts; follow the vehicle if it moved there."""
        is_vehicle, before = source == self.vehicle.address, self._addresses.of(source)
        strange = self.vehicle.identity.standing is Standing.STRANGER
        if not self._addresses.accepts(source, sender, now, self.peer if strange else None):
            if is_vehicle:
                self._on_impostor(source, sender, now)
            return False
        if is_vehicle and before is not None and before != sender:
            self._pass_on(now)
            self._impostor_at, self.second = inf, None
            log.warning(_MOVED, readable_address(before), readable_address(sender))
            self.vehicle.identity.reopened()
        return True

    def _on_impostor(self, source: Address, sender: NetAddress, now: float) -> None:
        """Warn once that another sender claims to be the vehicle. The vehicle itself may have moved there, so
        warn only when it is heard at its old address again."""
        if self.second is None and self.vehicle.identity.heard_at > self._impostor_at:
            self.second = sender
            log.warning(_IGNORED, readable_address(sender), *source)
        self._impostor_at = min(self._impostor_at, now)

    def _refill(self, now: float) -> bool:
        """Send the engine's requests, if the link has room; return whether requests may go out now."""
        target, link = self.vehicle.address, self.link
        may_send = link.backlog < BACKLOG_LIMIT and self.vehicle.identity.may_be_asked(now)
        may_send &= now >= self._silent_until
        if target is None or not may_send:
            self.engine.hold(now)
            return may_send
        payloads = self.engine.outgoing(now)
        if payloads:
            if self._on_payload is not None:
                for wire in payloads:
                    self._on_payload(now, "request", wire)
            link.send(self.framer.encode_ftp_run(target, payloads), self.peer)
        return True
