"""A link to a simulated vehicle in memory, on whatever clock trio runs.

With `trio.testing.MockClock(autojump_threshold=0)` hours of radio pass at once. The link owns no task: time
is caught up, instant by instant and in order, whenever somebody receives or sends, so that what happens at
which moment does not depend on when the client looks.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import pairwise

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import LinkStats
from mavftpfs.shared.errors import LinkClosed
from mavftpfs.sim.linkmodel import Direction, LinkModel
from mavftpfs.sim.vehicle import SimVehicle

MAX_CHUNKS = 256
_MAX_STEPS = 1_000_000
"""Instants in one catch-up: a deadline that never moves on must fail a test, not hang it."""


class MemoryLink:
    """Implements link.base.Link.

    Args:
        model: the bad link in between; None: instant, lossless, without limit.
        stream: hand out bytes in random pieces instead of frame by frame, and give the vehicle likewise.
        rng: for the pieces.
    """

    def __init__(
        self,
        vehicle: SimVehicle,
        model: LinkModel | None = None,
        *,
        stream: bool = False,
        is_serial: bool = False,
        rng: random.Random | None = None,
    ) -> None:
        self.stats = LinkStats()
        self.description = "memory"
        self.is_stream = stream
        self.is_serial = is_serial
        self.vehicle = vehicle
        self.model = model
        self.lost_in_cut = 0
        self._rng = rng if rng is not None else random.Random(0)
        self._inbox: list[bytes] = []
        self._time = float("-inf")
        self._cut = False
        self._fresh = False
        self._closed = False
        self._changed = trio.Event()
        if model is not None:
            vehicle.server.firmware.tx_room = lambda: model.room(Direction.TO_CLIENT)

    @property
    def backlog(self) -> int:
        """Always 0: the model's queue is the radio's, not ours."""
        return 0

    def cut(self) -> None:
        """Break the link: what is on the way and all that follows is lost, in both directions."""
        self._catch_up()
        self._cut = True
        if self.model is not None:
            self.model.cut(self._time)

    def restore(self) -> None:
        """Mend the link; a stream counts as reopened."""
        self._catch_up()
        self._cut = False
        if self.model is not None:
            self.model.restore(self._time)
        if self.is_stream:
            self._fresh = True
            self.stats.reopened += 1
            self.vehicle.framer.reset()
        self._notify()

    async def receive(self) -> list[bytes]:
        """See link.base.Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        waited = False
        while True:
            if self._closed:
                raise LinkClosed("memory is closed")
            self._catch_up()
            if self._fresh or self._inbox:
                if not waited:
                    await trio.lowlevel.cancel_shielded_checkpoint()
                return self._take()
            waited = True
            changed = self._changed
            with trio.CancelScope(deadline=self._next_deadline()):
                await changed.wait()

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """See link.base.Link."""
        now = trio.current_time()
        self._catch_up()
        self.stats.sent_chunks += len(frames)
        self.stats.sent_bytes += sum(map(len, frames))
        for frame in frames:
            if self.model is not None:
                self.model.push(Direction.TO_VEHICLE, frame, now)
            elif self._cut:
                self.lost_in_cut += 1
            else:
                self._deliver(frame, now)
        self._notify()

    def sender(self, index: int) -> NetAddress | None:
        """Nobody else is heard."""
        return None

    def answer(self, address: NetAddress) -> None:
        """Nothing to choose from."""

    def keep_peer(self) -> None:
        """Nobody waits."""

    async def aclose(self) -> None:
        """See link.base.Link."""
        self._closed = True
        self._notify()
        await trio.lowlevel.checkpoint()

    def kick(self) -> None:
        """Look again: the vehicle was changed from outside (armed, rebooted, asked by somebody else)."""
        self._notify()

    def _take(self) -> list[bytes]:
        if self._fresh:
            self._fresh = False
            return []
        chunks, self._inbox = self._inbox[:MAX_CHUNKS], self._inbox[MAX_CHUNKS:]
        self.stats.received_bytes += sum(map(len, chunks))
        return chunks

    def _notify(self) -> None:
        self._changed.set()
        self._changed = trio.Event()

    def _next_deadline(self) -> float:
        due = self.vehicle.next_deadline()
        model = self.model.next_deadline() if self.model is not None else None
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
        if model is None:
            for frame in self.vehicle.outgoing(now):
                if self._cut:
                    self.lost_in_cut += 1
                else:
                    self._arrive(frame)
            return
        for frame in model.pop(Direction.TO_VEHICLE, now):
            self._deliver(frame, now)
        for frame in self.vehicle.outgoing(now):
            model.push(Direction.TO_CLIENT, frame, now)
        for frame in model.pop(Direction.TO_CLIENT, now):
            self._arrive(frame)

    def _deliver(self, frame: bytes, now: float) -> None:
        for piece in self._pieces(frame):
            self.vehicle.receive(piece, now)

    def _arrive(self, frame: bytes) -> None:
        self._inbox += self._pieces(frame)

    def _pieces(self, frame: bytes) -> list[bytes]:
        """Cut a frame in one to four where the link is a stream."""
        if not self.is_stream:
            return [frame]
        cuts = sorted(self._rng.randrange(len(frame) + 1) for _ in range(self._rng.randrange(4)))
        edges = [0, *cuts, len(frame)]
        return [frame[start:stop] for start, stop in pairwise(edges) if start < stop]
