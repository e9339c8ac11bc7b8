"""A ceiling on what we cause on the link (`bwlimit=`). Layer: protocol; pure.

Every byte counts that would not be on the link without us: our frames, and the vehicle's replies to them,
both ways together, because they share a radio's airtime. A read's reply is paid for when the read goes out;
other replies are paid for when they come. A request that has to wait for the budget is not sent yet, so no
timer runs.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import HEADER_SIZE, Opcode

FRAME_OVERHEAD = 15
"""Bytes of a MAVLink 2 frame around a payload of FTP: header, CRC, and the three ids of the target."""

SIGNATURE = 13

_DEPTH_SECONDS = 0.010
_DEBT_SECONDS = 0.1
_LEAST_DEBT = 600.0
_FULL_FRAME = 300.0
_MOST = 1 << 16
_OPCODE, _SIZE, _REQ_OPCODE = 3, 4, 5
_READ = int(Opcode.READ_FILE)
_ACK = int(Opcode.ACK)


class Budget:
    """Allows `rate` bytes a second. Unused bytes are saved up for 10 ms only.

    Small requests of people (listings, opens) may go ahead by 0.1 s or two frames, whichever is more; bulk
    work then waits for it. overhead: bytes of a frame beside the 251 of its payload.

    Attributes:
        exhausted: since `begin` a request had to wait.
    """

    def __init__(self, rate: float, overhead: int = FRAME_OVERHEAD) -> None:
        self.rate = rate
        self.exhausted = False
        self._overhead = overhead
        self._depth = rate * _DEPTH_SECONDS
        self._debt = max(_LEAST_DEBT, rate * _DEBT_SECONDS)
        self._balance = 0.0
        self._at = -inf
        self._left = 0
        self._lent = 0.0
        self._wanted: float | None = None

    # --- what may go out

    def begin(self) -> None:
        """See Flow.begin."""
        self.exhausted = False
        self._wanted = None

    def room(self, now: float, *, urgent: bool) -> int:
        """Return how many requests may go out now. urgent: a program waits for a small answer."""
        self._refill(now)
        self._lent = self._debt if urgent else 0.0
        balance = self._balance + self._lent
        self._left = 0 if balance < 0.0 else min(_MOST, 1 + int(balance / _FULL_FRAME))
        if self._left == 0:
            self.exhausted = True
            self._want()
        return self._left

    def on_sent(self, count: int) -> None:
        """Note that so many of these requests go out."""
        self._left -= count
        if self._left == 0:
            self._want()

    def _want(self) -> None:
        """Note that there may be more to send than there is room for."""
        self._wanted = self._lent if self._wanted is None else max(self._wanted, self._lent)

    def next_room_at(self) -> float:
        """Return when there will be more room; infinite if there was enough for everything."""
        if self._wanted is None:
            return inf
        return self._at + max(0.0, -self._balance - self._wanted) / self.rate + 1e-6

    def _refill(self, now: float) -> None:
        if now > self._at:
            gained = 0.0 if self._at == -inf else (now - self._at) * self.rate
            self._balance = min(self._depth, self._balance + gained)
            self._at = now

    # --- what it cost

    def spend(self, count: int, now: float) -> None:
        """Pay for bytes on the link."""
        self._refill(now)
        self._balance -= count

    def on_request(self, wire: bytes, now: float) -> None:
        """Pay for a request of 251 bytes that goes out."""
        cost = self._overhead + len(wire.rstrip(b"\0"))
        if wire[_OPCODE] == _READ:
            cost += self._overhead + HEADER_SIZE + wire[_SIZE]
        self.spend(cost, now)

    def on_reply(self, wire: bytes, now: float) -> None:
        """Pay for a reply of 251 bytes that came."""
        if wire[_REQ_OPCODE] != _READ or wire[_OPCODE] != _ACK:
            self.spend(self._overhead + len(wire.rstrip(b"\0")), now)
