"""The common part of the simulated firmwares. Layer: sim; pure.

This module has requests and replies of its own in place of protocol.payload's, because servers echo fields
and leave stray bytes behind `size`, and because this code must be fast.

Time: `handle` and `outgoing` first do everything that was due by `now`, in order, each at its own instant.
Replies leave in the order of their due times: the outbox is a list of the due ones and a queue of the others.
"""

from __future__ import annotations

import random
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mavftpfs.link.messages import Address
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import Storage

HEADER = struct.Struct("<HBBBBBxI")
HEADER_SIZE = HEADER.size
REPLY = struct.Struct("<HBBBBBxI239s")
FRAME_OVERHEAD = 12
"""Bytes that MAVLink 2 puts around a payload, unsigned."""
FULL_FRAME = 266
"""An FTP frame with 239 bytes of data."""
ACK = 128
NAK = 129


class Request(NamedTuple):
    """A request; `data` is the whole 239-byte field."""

    seq: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes
    source: Address


@dataclass(slots=True)
class Reply:
    """A reply under construction. `data` may be longer than `size`: the rest is stray memory."""

    target: Address
    seq: int
    session: int
    opcode: int
    size: int
    req_opcode: int
    burst_complete: int
    offset: int
    data: bytes

    def encode(self) -> bytes:
        """Return the 251 wire bytes."""
        return REPLY.pack(
            self.seq & 0xFFFF,
            self.session,
            self.opcode,
            self.size,
            self.req_opcode,
            self.burst_complete,
            self.offset & 0xFFFFFFFF,
            self.data,
        )


def parse(wire: bytes, source: Address) -> Request:
    """Split 251 wire bytes."""
    seq, session, opcode, size, _, _, offset = HEADER.unpack_from(wire)
    return Request(seq, session, opcode, size, offset, wire[HEADER_SIZE:], source)


def c_string(data: bytes) -> bytes:
    """Return the bytes before the first NUL."""
    return data.partition(b"\0")[0]


def frame_size(wire: bytes) -> int:
    """Return the size of a MAVLink 2 frame with this payload; trailing zeros are not sent."""
    return FRAME_OVERHEAD + 3 + len(wire.rstrip(b"\0"))


def u32(value: int) -> bytes:
    """Return four bytes, little-endian, modulo 2^32 as the servers do."""
    return (value & 0xFFFFFFFF).to_bytes(4, "little")


Room = Callable[[], int]


_PAUSES_KEPT = 1 << 18


class Refusal(Exception):
    """A NAK with data that the server chooses: a code, perhaps more. For an OSError the errno decides."""

    def __init__(self, code: int, *more: int) -> None:
        super().__init__(code, *more)
        self.code = code
        self.data = bytes([code, *more])


class Firmware(ABC):
    """One server's code. Subclasses decide; this class keeps time and the outbox.

    Attributes:
        tx_room: returns the number of bytes that fit the link's transmit buffer now (PX4 and ArduPilot pace
            by it); None = as many as the profile's own buffer.
        crashed: the process died (MAVSDK) and is silent until `reboot`.
        dropped_requests: requests lost to a full queue or receive buffer. dropped_replies: to a full transmit
            buffer.
        replays: requests answered from the replay slot.
        pauses: seconds that a slow card added to each of the last reads and writes, 0 included.
    """

    def __init__(self, storage: Storage, profile: Profile, rng: random.Random) -> None:
        self.storage = storage
        self.profile = profile
        self.rng = rng
        self.tx_room: Room | None = None
        self.crashed = False
        self.dropped_requests = 0
        self.dropped_replies = 0
        self.replays = 0
        self.pauses: deque[float] = deque(maxlen=_PAUSES_KEPT)
        self.now = float("-inf")
        storage.virtual.clock = lambda: self.now
        self._ready: list[tuple[Address, bytes]] = []
        self._ready_bytes = 0
        self._later: deque[tuple[float, Address, bytes]] = deque()

    @abstractmethod
    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Take a request of 251 bytes."""

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Take requests of 251 bytes that arrived together, with the same result as one by one."""
        for wire in wires:
            if self.crashed:
                return
            self.handle(wire, source, now)

    @abstractmethod
    def advance(self, now: float) -> None:
        """Do everything that is due by `now`."""

    @abstractmethod
    def next_wake(self) -> float | None:
        """Return when `advance` has something to do next."""

    @abstractmethod
    def open_paths(self) -> list[bytes]:
        """Return the paths of the open files, as the client named them."""

    @abstractmethod
    def reboot(self, now: float) -> None:
        """Close everything and start afresh at `now`."""

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Return the replies due by `now`."""
        self.advance(now)
        if self._later:
            self._promote(now)
        ready, self._ready = self._ready, []
        self._ready_bytes = 0
        return ready

    @property
    def ready(self) -> int:
        """The number of replies for the next `outgoing`, without those that are due later."""
        return len(self._ready)

    def next_deadline(self) -> float | None:
        """Return when `outgoing` may have a reply, or a timer runs; None if only a request can change
        anything."""
        if self._ready:
            return self.now
        wake = self.next_wake()
        if self._later:
            due = self._later[0][0]
            return due if wake is None else min(due, wake)
        return wake

    def forget_outbox(self) -> None:
        """Drop the unsent replies."""
        self._ready = []
        self._ready_bytes = 0
        self._later.clear()

    def _promote(self, now: float) -> None:
        while self._later and self._later[0][0] <= now:
            _, target, wire = self._later.popleft()
            self._ready.append((target, wire))

    def emit(self, target: Address, wire: bytes, due: float, now: float) -> None:
        """Put a reply into the outbox, to leave at `due` (but after the earlier ones)."""
        if due > now or self._later:
            self._later.append((due, target, wire))
        else:
            self._ready.append((target, wire))
        if self.tx_room is not None:
            self._ready_bytes += frame_size(wire)

    def room(self) -> int:
        """Return the bytes free in the link's transmit buffer, less those that wait in the outbox. Plenty if
        `tx_room` is None."""
        if self.tx_room is None:
            return 10 * FULL_FRAME + self.profile.tx_buffer
        return self.tx_room() - self._ready_bytes
