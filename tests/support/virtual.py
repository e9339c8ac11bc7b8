"""Runs an engine against a server over a modelled link, on virtual time without trio.

The server is anything with `handle`, `outgoing` and `next_deadline` (mavftpfs.sim.vehicle.FtpServer, or a
scripted one). Frames are the trimmed payloads behind 15 bytes that stand for MAVLink's overhead.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Protocol

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import Operation
from mavftpfs.protocol.payload import PAYLOAD_SIZE
from mavftpfs.shared.errors import RemoteProtocolError
from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from tests.support.replies import decode_reply

CLIENT = Address(254, 191)
OVERHEAD = bytes(15)
MAX_STEPS = 2_000_000


class Server(Protocol):
    """What the other end must be."""

    def handle(self, wire: bytes, source: Address, now: float) -> None: ...

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]: ...

    def next_deadline(self) -> float | None: ...


class VirtualLink:
    """The loop. `now` is virtual time in seconds."""

    def __init__(self, server: Server, settings: LinkSettings | None = None, *, seed: int = 0) -> None:
        rng = random.Random(seed)
        self.server = server
        self.model = LinkModel(rng, settings)
        self.engine = Engine(random.Random(rng.random()), Flow(), op_deadline=30.0)
        self.now = 100.0

    def run(self, *operations: Operation, limit: float = 600.0) -> None:
        """Start operations and go on until all are done."""
        for operation in operations:
            self.engine.start(operation, self.now)
        self.run_until(lambda: all(operation.done for operation in operations), limit)

    def run_until(self, finished: Callable[[], bool], limit: float = 600.0) -> None:
        """Go on until `finished`, at most `limit` virtual seconds."""
        end = self.now + limit
        for _ in range(MAX_STEPS):
            self._exchange()
            if finished():
                return
            self.now = self._next_time()
            assert self.now <= end, f"not finished within {limit} virtual seconds"
        raise AssertionError("too many steps")

    def _exchange(self) -> None:
        now = self.now
        for wire in self.engine.outgoing(now):
            assert len(wire) == PAYLOAD_SIZE
            self.model.push(Direction.TO_VEHICLE, OVERHEAD + wire.rstrip(b"\0"), now)
        for frame in self.model.pop(Direction.TO_VEHICLE, now):
            self.server.handle(_payload(frame), CLIENT, now)
        for target, wire in self.server.outgoing(now):
            if target == CLIENT:
                self.model.push(Direction.TO_CLIENT, OVERHEAD + wire.rstrip(b"\0"), now)
        for frame in self.model.pop(Direction.TO_CLIENT, now):
            self._receive(_payload(frame))
        deadline = self.engine.next_deadline()
        if deadline is not None and deadline <= now:
            self.engine.on_deadline(now)
        self.engine.take_finished()
        for wire in self.engine.outgoing(now):
            self.model.push(Direction.TO_VEHICLE, OVERHEAD + wire.rstrip(b"\0"), now)

    def _receive(self, wire: bytes) -> None:
        try:
            reply = decode_reply(wire)
        except RemoteProtocolError:
            return
        self.engine.receive(reply, self.now)

    def _next_time(self) -> float:
        ends = (self.engine, self.server, self.model)
        candidates = [end.next_deadline() for end in ends]
        times = [time for time in candidates if time is not None]
        assert times, "everybody waits for ever"
        return max(min(times), self.now)


def _payload(frame: bytes) -> bytes:
    return frame[len(OVERHEAD) :].ljust(PAYLOAD_SIZE, b"\0")
