"""Reading an open file by bursts (`read_mode=burst`). Layer: protocol; pure.

One BurstReadFile brings many packets of data, which saves the uplink of a half-duplex radio. `BurstTransfer`
never asks for anything else meanwhile, because a ReadFile during a burst moves MAVSDK's stream. A burst
cannot be stopped: ArduPilot sends 500 to 2000 packets, and answers nothing else until then.

| the first of these that holds | asks for | ends |
|---|---|---|
| a burst is running | nothing | with the burst |
| `by_requests`: others wait for answers | what is wanted, by ReadFile | when its owner says so |
| full chunks are lost, and short ones may pass | what is wanted, by ReadFile | when full ones pass |
| a burst was refused, or two in a row brought no data | what is wanted, by ReadFile | never |
| the last burst left gaps below `_covered` | what is wanted there, by ReadFile | when all of it arrived |
| otherwise | a burst from the first wanted byte on | at once |

`Burst` follows one stream. A packet belongs when seq and offset agree: offset == start + k * packet size and
seq == request seq + 1 + k (mod 2^16). The packet size is what the server sends, not what was asked (PX4
ignores that). The end is an EOF NAK, the end of the file, `burst_complete` followed by quiet, or quiet alone
(servers.md 14.15): the flag may be garbage, the NAK's offset may be wrong, and MAVSDK sends no NAK.
"""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.reading import DataSink, ReadTransfer, Wants
from mavftpfs.protocol.requests import READ_POLICY, RETRY_POLICIES, Request
from mavftpfs.shared.errors import SessionLost

_MOST_PACKETS = 40_000
_MIN_QUIET = 1.0
_SLOW_PACKET = 0.03
_SLOW_QUIET = 2.0
_INTERVALS = 8
_SESSION_CODES = (NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND)
"""Refusals of a burst that mean "no file is open" (servers.md 1). After another one, ReadFile tells."""

_BARREN_BURSTS = 2
"""After so many bursts without data the rest is read by requests."""


class Burst:
    """A running burst. start: offset asked for. size: of the file. asked: bytes per packet."""

    def __init__(self, seq: int, start: int, size: int, asked: int, now: float, rto: float) -> None:
        self.seq = seq
        self.start = start
        self.size = size
        self.asked = asked
        self.rto = rto
        self.packet = 0  # bytes per packet, as the server sends them, once known
        self.highest = start  # one past the highest byte that came
        self.last_at = now  # the last packet, or the request
        self.interval = 0.0  # seconds between two packets, smoothed
        self.ending = False  # burst_complete or a NAK came
        self.nak: int | None = None  # the last one
        self.barren = 0  # packets without data since the last with some

    @property
    def empty(self) -> bool:
        """Whether no data came so far."""
        return self.highest == self.start

    @property
    def over(self) -> bool:
        """Whether it is certain that no more data comes. After a NAK behind data, ArduPilot stops after one
        more packet, MAVSDK never: quiet, or the next packet, will tell."""
        ended = self.nak is not None and (self.nak == NakCode.EOF or self.empty)
        return ended or self.highest == self.size

    @property
    def endless(self) -> bool:
        """Whether the server repeats itself for ever and must be stopped by Terminate (servers.md 14.19)."""
        return self.barren >= 2

    def quiet_deadline(self) -> float:
        """Return when silence means that the burst is over.

        Never early: ArduPilot queues each new request as another full burst (servers.md 14.16).
        """
        if self.highest == self.start:
            return self.last_at + max(_MIN_QUIET, 3 * self.rto)
        if self.ending:
            return self.last_at + max(self.rto, 4 * self.interval)
        least = _SLOW_QUIET if self.interval > _SLOW_PACKET else _MIN_QUIET
        return self.last_at + max(least, _INTERVALS * self.interval)

    def take(self, reply: Payload, now: float) -> bytes | None:
        """Take a packet; return its data (b"" for a control packet), or None if it does not belong."""
        index = (reply.seq - self.seq - 1) & 0xFFFF
        if reply.opcode == Opcode.ACK and reply.data:
            return self._take_data(reply, index, now)
        # Neither a NAK's offset nor that of an empty packet can be relied on: the seq must do.
        packets = (self.size - self.start) // (self.packet or self.asked) + 2
        if index > min(packets, _MOST_PACKETS) or reply.opcode not in (Opcode.ACK, Opcode.NAK):
            return None
        self._touch(now)
        self.barren += 1
        if reply.opcode == Opcode.NAK:
            self.ending = True
            self.nak = reply.data[0] if reply.data else int(NakCode.NONE)
        return b""

    def _take_data(self, reply: Payload, index: int, now: float) -> bytes | None:
        offset, data = reply.offset, reply.data
        stop = offset + len(data)
        if not self._fits(offset - self.start, len(data), index, at_end=stop >= self.size):
            return None
        self._touch(now)
        self.barren = 0
        if reply.burst_complete:
            self.ending = True
        if stop > self.size:
            stop, data = self.size, data[: max(0, self.size - offset)]
        self.highest = max(self.highest, stop)
        return data

    def _fits(self, ahead: int, count: int, index: int, *, at_end: bool) -> bool:
        packet = self.packet
        if packet:
            steps, odd = divmod(ahead, packet)
            return not odd and ahead >= 0 and steps & 0xFFFF == index and count <= packet
        if index == 0:
            if ahead == 0 and not at_end:  # a last packet may be short, so it tells no size
                self.packet = count
            return ahead == 0
        packet, odd = divmod(ahead, index)
        if odd or not count <= packet <= MAX_DATA or (count < packet and not at_end):
            return False
        self.packet = packet
        return True

    def _touch(self, now: float) -> None:
        if self.barren or self.highest > self.start:  # otherwise it is the first packet
            self.interval += (now - self.last_at - self.interval) * 0.1
        self.last_at = now


class BurstTransfer(ReadTransfer):
    """A ReadTransfer that reads by bursts.

    Attributes:
        by_requests: read by ReadFile requests from the next safe point on, which is the end of a running
        burst.
    """

    def __init__(
        self,
        session: int,
        size: int,
        sink: DataSink,
        chunks: ChunkSize | None = None,
        wants: Wants | None = None,
    ) -> None:
        super().__init__(session, size, sink, chunks, wants)
        self.by_requests = False
        self._burst: Burst | None = None
        self._covered = 0  # where the last burst ended, while its gaps are read
        self._barren_bursts = 0  # one after the other

    @property
    def idle(self) -> bool:
        """Whether no range is pending, and no burst is running."""
        return self._burst is None and super().idle

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the BurstReadFile that is due, or ReadFiles, as the module's table says."""
        if self._burst is not None:
            return []
        only_short = self.chunks.trying or self.chunks.size < self.chunks.most
        by_requests = self.by_requests or only_short or self._barren_bursts >= _BARREN_BURSTS
        requests = self._requests_below(self.size if by_requests else self._covered, most, now)
        if requests or by_requests or self.wants.in_flight:
            return requests
        self._covered = 0
        first = self.wants.demand.todo.first() or self.wants.ahead.todo.first()
        if first is None:
            return []
        opcode = Opcode.BURST_READ_FILE
        return [Request(self, opcode, RETRY_POLICIES[opcode], self.session, first[0], self.chunks.size)]

    def on_burst_sent(self, request: Request, now: float) -> int:
        """Begin to follow the burst; return how many packets it may bring (MAVSDK: all the rest)."""
        rto = self.port.timeout(READ_POLICY)
        self._burst = burst = Burst(request.seq, request.offset, self.size, request.size, now, rto)
        self.timer = burst.quiet_deadline()
        return (self.size - request.offset) // request.size + 2

    def on_burst(self, reply: Payload, now: float) -> bool:
        """Place a packet of the running burst."""
        burst = self._burst
        data = None if burst is None else burst.take(reply, now)
        if burst is None or data is None:
            return False
        if data:
            self._place(reply.offset, [data], now)
        if burst.endless:
            self.fail(SessionLost("the vehicle repeats itself in a burst", by_server=True))
        elif burst.over:
            self._end_burst(burst)
        else:
            self.timer = burst.quiet_deadline()
        return True

    def on_timer(self, now: float) -> None:
        """End a burst that went quiet."""
        if self._burst is not None:
            self._end_burst(self._burst)

    def finish(self) -> None:
        """End; ranges in flight lose their requests and stay pending."""
        self._burst = None
        super().finish()

    def _end_burst(self, burst: Burst) -> None:
        self._burst, self.timer, self._covered = None, inf, burst.highest
        if not burst.empty:
            self._barren_bursts = 0
        elif burst.nak in _SESSION_CODES:
            self.fail(SessionLost(f"a burst was refused with NAK {burst.nak}", by_server=True))
        else:  # after a refusal ReadFile answers more clearly
            self._barren_bursts += 1 if burst.nak is None else _BARREN_BURSTS
