"""Checks MAVLink 2 signatures of incoming frames. Layer: link; pure (the clock is passed in).

Rules of the MAVLink guide ("Message Signing"): a stream is (link id, system, component); its timestamps,
in units of 10 µs since 2015-01-01, only grow; a new stream may be at most one minute old. Other
than in pymavlink's check, a frame leaves a trace only after its signature proved right, because a forged
timestamp must neither lock out the true sender nor grow the table.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable

from mavftpfs.link.messages import Address

SIGNATURE_BLOCK = 13  # link id, 48-bit timestamp, 48-bit signature

_ONE_MINUTE = 6_000_000
_MAX_STREAMS = 256


class SignatureCheck:
    """Judges the signatures of one connection.

    Args:
        key: 32 bytes.
        clock: present time as a signing timestamp; None: the newest timestamp of the accepted frames.

    Attributes:
        bad_times: number of frames with the right key and too old a time.
    """

    def __init__(self, key: bytes, clock: Callable[[], int] | None = None) -> None:
        self.bad_times = 0
        self._key = key
        self._clock = clock
        self._newest = 0
        self._streams: dict[tuple[int, Address], int] = {}

    @property
    def now(self) -> int:
        """The newest known time: the clock's, or the latest accepted timestamp if that is ahead."""
        return max(self._newest, self._clock() if self._clock is not None else 0)

    def accept(self, frame: bytes, source: Address) -> bool:
        """Return whether the signature of a whole frame (with incompat flag 1) is right, and is no replay."""
        digest = hashlib.sha256(self._key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            return False
        stream = (frame[-SIGNATURE_BLOCK], source)
        timestamp = int.from_bytes(frame[-12:-6], "little")
        if timestamp <= self._streams.get(stream, self.now - _ONE_MINUTE - 1):
            self.bad_times += 1
            return False
        if stream not in self._streams and len(self._streams) >= _MAX_STREAMS:
            return False
        self._streams[stream] = timestamp
        self._newest = max(self._newest, timestamp)
        return True
