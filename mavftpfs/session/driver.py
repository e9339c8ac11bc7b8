"""The pump between link and engine. Layer: session; the only task that reads the link.

Everything but `pump` and `run` is synchronous: an operation started by any task is on the wire before
that task next awaits. Waiters are woken once per batch of input, never once per packet (a trio event
and a time-out per request cost more than the rest of a chunk together).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import trio

from mavftpfs.link.base import Link, PinsPeer
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpRun, Message, singly
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.operations import Operation
from mavftpfs.protocol.payload import decode_reply
from mavftpfs.session.notes import Remarks
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import RemoteProtocolError, RequestTimeout

QUIET = 0.5
"""Seconds of silence in mid-frame after which a stream's unfinished frame is not waited for. TCP may pause
for a retransmission, serial ports do not pause inside a frame."""

REFILL_AT = 32
"""Replies after which room in the window is used at once: the server works meanwhile."""

BACKLOG_LIMIT = 16 * 1024
"""Bytes the link may hold unsent before the engine is asked for more: nothing overtakes what waits there."""


class PayloadTrace(Protocol):
    """Sees every FTP payload, both ways."""

    def payload(self, now: float, direction: str, wire: bytes, note: str = "") -> None:
        """Record 251 bytes; direction is "request" or "reply"."""
        ...


class Driver:
    """Moves payloads between one link and one engine, and everything else to the vehicle."""

    def __init__(
        self,
        link: Link,
        framer: Framer,
        engine: Engine,
        vehicle: Vehicle,
        *,
        clock: Callable[[], float],
        on_batch: Callable[[float], None] = lambda now: None,
        trace: PayloadTrace | None = None,
    ) -> None:
        self.link = link
        self.framer = framer
        self.engine = engine
        self.vehicle = vehicle
        self.bad_payloads = 0
        self.last_reply_at = clock()
        self._heard_at = clock()
        self.on_batch = on_batch
        self._clock = clock
        self._trace = trace
        self._remarks = Remarks(engine.stats)
        self._pins = link if isinstance(link, PinsPeer) else None
        self._scope: trio.CancelScope | None = None
        self._waiting: dict[Operation, Callable[[], None]] = {}
        self._budget = engine.flow.budget
        self._gathered: list[bytes] = []

    async def pump(self) -> None:
        """Run until cancelled or the link is closed for good (LinkClosed)."""
        while True:
            with trio.CancelScope(deadline=self._next_deadline()) as scope:
                self._scope = scope
                try:
                    chunks = await self.link.receive()
                finally:
                    self._scope = None
            now = self._clock()
            if scope.cancelled_caught:
                self.engine.on_deadline(now)
                if now >= self._quiet_at:
                    self._handle(self.framer.give_up(), now)
                    self._pass_on(now)
                    self.on_batch(now)
            else:
                self._take(chunks, now)
            self._settle(now)

    async def run(self, *operations: Operation) -> None:
        """Carry operations out, each sent without an answer to the one before; a cancelled caller takes them
        with it.

        Raises:
            MavftpfsError: the error of the first that failed.
        """
        finished = trio.Event()

        def on_finished() -> None:
            if all(operation.done for operation in operations):
                finished.set()

        try:
            for operation in operations:
                self.start(operation, on_finished)
            await finished.wait()
        finally:
            for operation in operations:
                self.cancel(operation)
        for operation in operations:
            if operation.error is not None:
                raise operation.error

    def start(self, operation: Operation, on_finished: Callable[[], None]) -> None:
        """Begin an operation; `on_finished` is called from the pump when it is done or failed."""
        self._waiting[operation] = on_finished
        self.engine.start(operation, self._clock())
        self.kick()

    def cancel(self, operation: Operation) -> None:
        """Forget an operation (harmless when it is finished)."""
        if self._waiting.pop(operation, None) is not None:
            self.engine.cancel(operation, self._clock())
            self.kick()

    def kick(self) -> None:
        """Send what the engine has to send now; call after anything that may have given it work."""
        self._settle(self._clock())

    def send(self, frame: bytes) -> None:
        """Send one ready frame that is not FTP (a heartbeat, a command)."""
        if self._budget is not None:
            self._budget.spend(len(frame), self._clock())
        self.link.send_nowait([frame])

    def _take(self, chunks: list[bytes], now: float) -> None:
        if not chunks:
            self.framer.reset()
            self.vehicle.identity.reopened(now)
            return
        self._heard_at = now
        feed = self.framer.feed_runs
        for index, chunk in enumerate(chunks):
            self._handle(feed(chunk), now, index)
            if len(self._gathered) >= REFILL_AT:
                self._pass_on(now)
                self._refill(now)
        self._pass_on(now)
        self.on_batch(now)

    def _handle(self, messages: list[Message | FtpRun], now: float, index: int = -1) -> None:
        """Gather replies, and tell the vehicle everything else, in its turn."""
        vehicle = self.vehicle
        for message in messages:
            ours = (vehicle.address, vehicle.own)
            if type(message) is FtpRun and (message.source, message.target) == ours:
                self._gathered += message.payloads
            else:
                self._pass_on(now)
                for single in singly([message]):
                    self._on_other(single, now, index)

    def _pass_on(self, now: float) -> None:
        """Give the engine the gathered replies."""
        wires = self._gathered
        if not wires:
            return
        self._gathered = []
        if self._budget is not None:
            for wire in wires:
                self._budget.on_reply(wire, now)
        if not self.vehicle.believes_reply(now):
            return  # what was asked is asked again once it is known who answers
        if self._trace is not None:
            for wire in wires:
                self._on_traced_reply(wire, now, self._trace)
            return
        malformed = self.engine.receive_run(wires, now)
        self.bad_payloads += malformed
        if malformed < len(wires):
            self.last_reply_at = now

    @property
    def _quiet_at(self) -> float:
        return self._heard_at + QUIET if self.framer.waiting else float("inf")

    def _on_traced_reply(self, wire: bytes, now: float, trace: PayloadTrace) -> None:
        try:
            reply = decode_reply(wire)
        except RemoteProtocolError:
            self.bad_payloads += 1
            trace.payload(now, "reply", wire, "malformed")
            return
        self.last_reply_at = now
        self._remarks.before_reply()
        self.engine.receive(reply, now)
        trace.payload(now, "reply", wire, self._remarks.after_reply(reply))

    def _on_other(self, message: Message, now: float, index: int) -> None:
        self.vehicle.on_message(message, now)
        # Of a target without heartbeats of its own the vehicle takes its system's autopilot's.
        if self._pins is not None and message is self.vehicle.heartbeat:
            self._pins.pin_peer(index)

    def _refill(self, now: float) -> None:
        target = self.vehicle.address
        if target is not None and self._may_send(now):
            self._send(target, self.engine.outgoing(now), now)
        else:
            self.engine.hold(now)

    def _may_send(self, now: float) -> bool:
        return self.link.backlog < BACKLOG_LIMIT and self.vehicle.identity.may_be_asked(now)

    def _settle(self, now: float) -> None:
        self._refill(now)
        for operation in self.engine.take_finished():
            on_finished = self._waiting.pop(operation, None)
            if isinstance(operation.error, RequestTimeout):
                self.vehicle.note_timeout()
            if on_finished is not None:
                on_finished()
        if self._scope is not None:
            self._scope.deadline = self._next_deadline()

    def _send(self, target: Address, payloads: list[bytes], now: float) -> None:
        if not payloads:
            return
        if self._budget is not None:
            for wire in payloads:
                self._budget.on_request(wire, now)
        if self._trace is not None:
            for wire in payloads:
                self._trace.payload(now, "request", wire, self._remarks.on_request(wire))
        self.link.send_nowait(self.framer.encode_ftp_run(target, payloads))

    def _next_deadline(self) -> float:
        deadline, now = self.engine.next_deadline(), self._clock()
        if self.link.backlog >= BACKLOG_LIMIT:
            # Nobody tells us that the link drained, and before that nothing can go out.
            deadline = now + 0.01
        elif deadline is not None and not self._may_send(now):
            deadline = max(deadline, now + 0.05)  # nothing can go out, whatever is due
        return self._quiet_at if deadline is None else min(deadline, self._quiet_at)
