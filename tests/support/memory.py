"""A link to a simulated vehicle in memory, on whatever clock trio runs.

With `trio.testing.MockClock(autojump_threshold=0)` hours of radio pass at once. The link owns no task: time
is caught up, instant by instant and in order, whenever somebody receives or sends, so that what happens at
which moment does not depend on when the client looks.
"""

from __future__ import annotations

from collections.abc import Sequence

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import LinkStats, Piece, Seat
from mavftpfs.sim.linkmodel import Direction, LinkModel
from mavftpfs.sim.vehicle import SimVehicle

MAX_PIECES = 256
_MAX_STEPS = 1_000_000
"""Instants in one catch-up: a deadline that never moves on must fail a test, not hang it."""


class MemoryLink:
    """Implements link.base.Link. model: the bad link in between."""

    def __init__(self, vehicle: SimVehicle, model: LinkModel, *, is_serial: bool = False) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.description = "memory"
        self.is_stream = False
        self.is_serial = is_serial
        self.vehicle = vehicle
        self.model = model
        self._inbox: list[Piece] = []
        self._time = float("-inf")
        self._changed = trio.Event()
        vehicle.on_news = self.kick
        vehicle.server.firmware.tx_room = lambda: model.room(Direction.TO_CLIENT)

    @property
    def backlog(self) -> int:
        """Always 0: the model's queue is the radio's, not ours."""
        return 0

    def cut(self) -> None:
        """Break the link: what is on the way and all that follows is lost, in both directions."""
        self._catch_up()
        self.model.cut(self._time)

    def restore(self) -> None:
        """Mend the link."""
        self._catch_up()
        self.model.restore(self._time)
        self._notify()

    async def receive(self) -> list[Piece]:
        """See link.base.Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        waited = False
        while True:
            self._catch_up()
            if self._inbox:
                if not waited:
                    await trio.lowlevel.cancel_shielded_checkpoint()
                return self._take()
            waited = True
            changed = self._changed
            with trio.CancelScope(deadline=self._next_deadline()):
                await changed.wait()

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """See link.base.Link."""
        now = trio.current_time()
        self._catch_up()
        self.stats.sent_bytes += sum(map(len, frames))
        for frame in frames:
            self.model.push(Direction.TO_VEHICLE, frame, now)
        self._notify()

    def kick(self) -> None:
        """Look again at the vehicle, and at what is on its way."""
        self._notify()

    def _take(self) -> list[Piece]:
        pieces, self._inbox = self._inbox[:MAX_PIECES], self._inbox[MAX_PIECES:]
        self.stats.received_bytes += sum(len(data) for data, _ in pieces)
        return pieces

    def _notify(self) -> None:
        self._changed.set()
        self._changed = trio.Event()

    def _next_deadline(self) -> float:
        due = self.vehicle.next_deadline()
        model = self.model.next_deadline()
        return due if model is None else min(due, model)

    def _catch_up(self) -> None:
        """Let everything happen that was due by now, each at its own instant."""
        now = trio.current_time()
        if self._time == float("-inf"):
            self._time = now
        for _ in range(_MAX_STEPS):
            due = self._next_deadline()
            if due > now:
                self._time = now
                return
            self._time = max(due, self._time)
            self._step(self._time)
        raise AssertionError("the simulated vehicle does not get past one instant")

    def _step(self, now: float) -> None:
        model = self.model
        for frame in model.pop(Direction.TO_VEHICLE, now):
            self.vehicle.receive(frame, now)
        for frame in self.vehicle.outgoing(now):
            model.push(Direction.TO_CLIENT, frame, now)
        for frame in model.pop(Direction.TO_CLIENT, now):
            self._arrive(frame)

    def _arrive(self, frame: bytes) -> None:
        self._inbox.append((frame, None))
