"""PX4's bursts, packet by packet. Layer: sim; pure. Source: mavlink_ftp.cpp (send), servers.md 4."""

from __future__ import annotations

import random
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode
from mavftpfs.sim.profiles import Profile
from mavftpfs.sim.storage import OpenFile
from mavftpfs.sim.wire import ACK, NAK, REPLY


@dataclass(slots=True)
class Stream:
    """A running burst. sent: bytes."""

    target: Address
    offset: int
    seq: int
    sent: int = 0

    def read(
        self, opened: OpenFile, *, last: bool, alone: bool, profile: Profile, rng: random.Random
    ) -> bytes:
        """Return the next packet; `complete` tells whether it ends the burst.

        last, alone: it is a tick's last packet, its only one.

        Raises:
            OSError: reading failed.
        """
        data = opened.read(self.offset, MAX_DATA)
        self.sent += len(data)
        over = last and self.sent > profile.burst_bytes
        # The field is not written on a tick's last packet; only then is it the stack's garbage.
        garbage = last and alone and not over and rng.random() < profile.garbage_complete
        packed = self._pack(ACK, int(over or garbage), data)
        self.offset += len(data)
        return packed

    def is_over(self, last: bool, profile: Profile) -> bool:
        """Whether the packet before was the last one."""
        return last and self.sent > profile.burst_bytes

    def end(self, code: int, number: int) -> bytes:
        """Return the NAK that ends it; number: errno."""
        return self._pack(NAK, 0, bytes([code, number & 0xFF] if code == NakCode.FAIL_ERRNO else [code]))

    def _pack(self, opcode: int, complete: int, data: bytes) -> bytes:
        seq = self.seq & 0xFFFF
        self.seq += 1
        return REPLY.pack(seq, 0, opcode, len(data), Opcode.BURST_READ_FILE, complete, self.offset, data)
