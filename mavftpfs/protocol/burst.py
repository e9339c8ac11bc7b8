"""One BurstReadFile stream: which packets belong to it, and when it is over. Layer: protocol; pure.

A packet belongs when seq and offset agree: offset == start + k * packet size and seq == request seq + 1
+ k (mod 2^16). The packet size is what the server sends, not what was asked (PX4 ignores that). The end
is an EOF NAK, the end of the file, `burst_complete` followed by quiet, or quiet alone (servers.md 14.15):
the flag may be garbage, the NAK's offset may be wrong, and MAVSDK sends no NAK.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import NakCode, Opcode, Payload

_MAX_STRAY_NAK = 40_000
_MIN_QUIET = 1.0
_SLOW_PACKET = 0.03
_SLOW_QUIET = 2.0
_INTERVALS = 8


class Burst:
    """State of the running burst. start: offset asked for. size: of the file. asked: bytes per packet."""

    __slots__ = (
        "asked",
        "complete_seen",
        "empties",
        "failures",
        "first_at",
        "highest",
        "interval",
        "last_at",
        "nak",
        "over",
        "packet",
        "packets",
        "received",
        "rto",
        "sent_at",
        "seq",
        "size",
        "start",
    )

    def __init__(self, seq: int, start: int, size: int, asked: int, now: float, rto: float) -> None:
        self.seq = seq
        self.start = start
        self.size = size
        self.asked = asked
        self.sent_at = now
        self.rto = rto
        self.packet = 0
        self.packets = 0
        self.received = 0
        self.highest = start
        self.first_at = inf
        self.last_at = now
        self.interval = 0.0
        self.complete_seen = False
        self.empties = 0
        self.failures = 0
        self.over = False
        self.nak: int | None = None

    @property
    def endless(self) -> bool:
        """Whether the server repeats itself for ever and must be stopped by Terminate (servers.md 14.19)."""
        return self.empties >= 2 or self.failures >= 2

    def quiet_deadline(self) -> float:
        """Return when silence means that the burst is over.

        Never early: ArduPilot queues each new request as another full burst (servers.md 14.16).
        """
        if self.packets == 0:
            return self.sent_at + max(_MIN_QUIET, 3 * self.rto)
        if self.complete_seen:
            return self.last_at + max(self.rto, 4 * self.interval)
        least = _SLOW_QUIET if self.interval > _SLOW_PACKET else _MIN_QUIET
        return self.last_at + max(least, _INTERVALS * self.interval)

    def take(self, reply: Payload, now: float) -> bytes | None:
        """Take a packet; return its data (b"" for a control packet), or None if it does not belong."""
        index = (reply.seq - self.seq - 1) & 0xFFFF
        if reply.opcode == Opcode.ACK:
            return self._take_data(reply, index, now)
        if reply.opcode == Opcode.NAK and index <= self._most_packets():
            return self._take_nak(reply, now)
        return None

    def _most_packets(self) -> int:
        # One packet may be as small as what was asked for; the NAK comes right behind the last.
        packet = self.packet or self.asked
        return min((self.size - self.start) // packet + 2, _MAX_STRAY_NAK)

    def _take_nak(self, reply: Payload, now: float) -> bytes:
        code = reply.data[0] if reply.data else int(NakCode.NONE)
        self._touch(now)
        self.nak = code
        if code == NakCode.EOF:
            self.over = True
        else:
            self.failures += 1
        return b""

    def _take_data(self, reply: Payload, index: int, now: float) -> bytes | None:
        data = reply.data
        if not self._fits(reply.offset, len(data), index):
            return None
        self._touch(now)
        if reply.burst_complete:
            self.complete_seen = True
        if not data:
            self.empties += 1
            return b""
        self.empties = self.failures = 0
        stop = reply.offset + len(data)
        if stop > self.highest:
            self.highest = stop
        if stop >= self.size:
            self.over = True
            data = data[: max(0, self.size - reply.offset)]
        self.packets += 1
        self.received += len(data)
        return data

    def _fits(self, offset: int, count: int, index: int) -> bool:
        ahead = offset - self.start
        packet = self.packet
        if packet == 0:
            packet = self._learn_packet(ahead, count, index, offset)
            if packet == 0:
                return False
        steps, odd = divmod(ahead, packet)
        if odd or ahead < 0 or steps & 0xFFFF != index or count > packet:
            return False
        if count == packet or offset + count >= self.size or count == 0:
            # A last packet may be short; only a full one (or k > 0) tells the packet size.
            if index > 0 or offset + count < self.size:
                self.packet = packet
            return True
        self.packet = packet
        return True

    def _learn_packet(self, ahead: int, count: int, index: int, offset: int) -> int:
        """Return the packet size that the first packet proves, or 0 if it cannot be right."""
        if index == 0:
            return count or self.asked
        if ahead <= 0 or ahead % index:
            return 0
        packet = ahead // index
        if packet > 239 or (count != packet and offset + count != self.size):
            return 0
        return packet

    def _touch(self, now: float) -> None:
        if self.packets:
            self.interval += (now - self.last_at - self.interval) * 0.1
        else:
            self.first_at = now
        self.last_at = now
