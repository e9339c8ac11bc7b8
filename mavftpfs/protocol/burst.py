"""One BurstReadFile stream: which packets belong to it, and when it is over. Layer: protocol; pure.

A packet belongs when seq and offset agree: offset == start + k * packet size and seq == request seq + 1
+ k (mod 2^16). The packet size is what the server sends, not what was asked (PX4 ignores that). The end
is an EOF NAK, the end of the file, `burst_complete` followed by quiet, or quiet alone (servers.md 14.15):
the flag may be garbage, the NAK's offset may be wrong, and MAVSDK sends no NAK.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload

_MOST_PACKETS = 40_000
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
        if reply.opcode == Opcode.ACK and reply.data:
            return self._take_data(reply, index, now)
        # Neither a NAK's offset nor that of an empty packet can be relied on: the seq must do.
        if index > self._most_packets():
            return None
        if reply.opcode == Opcode.ACK:
            self.empties += 1
        elif reply.opcode == Opcode.NAK:
            self._take_nak(reply)
        else:
            return None
        self._touch(now)
        return b""

    def _most_packets(self) -> int:
        packet = self.packet or self.asked
        return min((self.size - self.start) // packet + 2, _MOST_PACKETS)

    def _take_nak(self, reply: Payload) -> None:
        self.nak = reply.data[0] if reply.data else int(NakCode.NONE)
        if self.nak == NakCode.EOF or not self.packets:
            self.over = True
        else:
            # ArduPilot stops after one, MAVSDK never does: quiet, or the next one, will tell.
            self.complete_seen = True
            self.failures += 1

    def _take_data(self, reply: Payload, index: int, now: float) -> bytes | None:
        data = reply.data
        offset = reply.offset
        stop = offset + len(data)
        if not self._fits(offset - self.start, len(data), index, at_end=stop >= self.size):
            return None
        self._touch(now)
        self.packets += 1
        self.empties = self.failures = 0
        if reply.burst_complete:
            self.complete_seen = True
        if stop >= self.size:
            self.over = True
            data = data[: max(0, self.size - offset)]
            stop = self.size
        self.highest = max(self.highest, stop)
        self.received += len(data)
        return data

    def _fits(self, ahead: int, count: int, index: int, *, at_end: bool) -> bool:
        packet = self.packet
        if packet:
            steps, odd = divmod(ahead, packet)
            return not odd and ahead >= 0 and steps & 0xFFFF == index and count <= packet
        if index == 0:
            if ahead == 0 and not at_end:  # a last packet may be short and tells no size
                self.packet = count
            return ahead == 0
        packet, odd = divmod(ahead, index)
        if odd or not count <= packet <= MAX_DATA or (count < packet and not at_end):
            return False
        self.packet = packet
        return True

    def _touch(self, now: float) -> None:
        if self.first_at < inf:
            self.interval += (now - self.last_at - self.interval) * 0.1
        else:
            self.first_at = now
        self.last_at = now
