"""The least that a client can do: a window of ReadFile or WriteFile requests over UDP, coded by hand.

    python -m tests.bench.bare PORT read|write REMOTE LOCAL TIMEOUT --window 64

What the machine and a server can do, as a yardstick: one file, no mount, no cache, no event loop, nothing of
the product's. A reply is taken if its sequence number was asked for; nothing else is checked, and a refusal
ends it. Started and timed as the peers are (`tests.bench.peer`).

A request is repeated when four later ones were answered, or after a time-out.
"""

from __future__ import annotations

import argparse
import select
import socket
import struct
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Iterator
from pathlib import Path

from fastcrc import crc16

from tests.bench.peer import timed

CHUNK = 239
HEARTBEAT_ID, FTP_ID = 0, 110
HEARTBEAT_EXTRA, FTP_EXTRA = 50, 84
TERMINATE, OPEN_RO, READ, CREATE, WRITE, ACK = 1, 4, 5, 6, 7, 128
SYSTEM, COMPONENT = 254, 192

PACK = 5
"""Frames per datagram: 5 * 277 bytes stay below 1400."""
DRAIN = 256
OVERTAKEN = 4
"""Answers to later requests after which one counts as lost."""
BEAT = 1.0

_ftp = struct.Struct("<HBBBBBxI")
_crc = crc16.mcrf4xx

Piece = tuple[int, int, bytes]
"""offset, value of the size field, data"""


def frame(message: int, extra: int, payload: bytes, seq: int = 0) -> bytes:
    """Return a MAVLink 2 frame, trailing zeros trimmed."""
    payload = payload.rstrip(b"\0") or b"\0"
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, seq & 255, SYSTEM, COMPONENT, message, 0) + payload
    return b"\xfd" + body + struct.pack("<H", _crc(body + bytes((extra,))))


class Bare:
    """One client on one UDP port, for one file. patience: seconds until a request is repeated.

    Raises:
        OSError: the vehicle refused something.
    """

    def __init__(self, port: int, window: int, patience: float) -> None:
        self.window = window
        self.patience = patience
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._sock.setblocking(False)
        self._sock.bind(("127.0.0.1", port))
        self._peer: tuple[str, int] | None = None
        self._target = (1, 1)
        self._seq = 0
        self._session = 0
        self._beat_at = 0.0

    def connect(self) -> None:
        """Wait for the vehicle's heartbeat."""
        while True:
            select.select([self._sock], [], [])
            data, self._peer = self._sock.recvfrom(65535)
            if data[:1] == b"\xfd" and data[7:10] == b"\0\0\0":
                self._target = (data[5], data[6])
                return

    def read(self, path: bytes) -> bytearray:
        """Return a file."""
        size = int.from_bytes(self._ask(OPEN_RO, path)[:4], "little")
        content = bytearray(size)
        pieces = ((at, min(CHUNK, size - at), b"") for at in range(0, size, CHUNK))
        for offset, data in self._exchange(READ, pieces):
            content[offset : offset + len(data)] = data
        self._ask(TERMINATE, b"")
        return content

    def write(self, path: bytes, content: bytes) -> None:
        """Make a file."""
        self._ask(CREATE, path)
        pieces = (
            (at, min(CHUNK, len(content) - at), content[at : at + CHUNK])
            for at in range(0, len(content), CHUNK)
        )
        for _ in self._exchange(WRITE, pieces):
            pass
        self._ask(TERMINATE, b"")

    def _ask(self, opcode: int, data: bytes) -> bytes:
        """Return the data of the answer to one request, repeated under the same number."""
        self._seq = seq = (self._seq + 1) & 0xFFFF
        request = self._frame(seq, opcode, (0, len(data), data))
        while True:
            self._send([request], time.monotonic())
            until = time.monotonic() + self.patience
            while (left := until - time.monotonic()) > 0:
                select.select([self._sock], [], [], left)
                for answered, answer in self._answers():
                    if answered == (seq + 1) & 0xFFFF:
                        return answer

    def _frame(self, seq: int, opcode: int, piece: Piece) -> bytes:
        offset, size, data = piece
        body = _ftp.pack(seq, self._session, opcode, size, 0, 0, offset) + data
        return frame(FTP_ID, FTP_EXTRA, bytes((0, *self._target)) + body, seq)

    def _exchange(self, opcode: int, pieces: Iterator[Piece]) -> Iterator[tuple[int, bytes]]:
        """Ask for all pieces, at most `window` at a time; yield (offset, data) of each answer."""
        flying: OrderedDict[int, tuple[Piece, float]] = OrderedDict()
        again: deque[Piece] = deque()
        while True:
            now = time.monotonic()
            self._send(self._fill(opcode, pieces, flying, again, now), now)
            if not flying:
                return
            oldest = next(iter(flying.values()))[1]
            select.select([self._sock], [], [], max(0.0, oldest + self.patience - now))
            now = time.monotonic()
            for seq, answer in self._answers():
                known = flying.pop(seq, None)
                if known is not None:
                    yield known[0][0], answer
                    self._give_up_before(seq, flying, again)
            while flying and next(iter(flying.values()))[1] + self.patience <= now:
                again.append(flying.popitem(last=False)[1][0])

    def _fill(
        self,
        opcode: int,
        pieces: Iterator[Piece],
        flying: OrderedDict[int, tuple[Piece, float]],
        again: deque[Piece],
        now: float,
    ) -> list[bytes]:
        """Return the frames that fill the window."""
        frames: list[bytes] = []
        while len(flying) < self.window:
            if again:
                piece = again.popleft()
            else:
                following = next(pieces, None)
                if following is None:
                    break
                piece = following
            self._seq = seq = (self._seq + 1) & 0xFFFF
            flying[(seq + 1) & 0xFFFF] = (piece, now)
            frames.append(self._frame(seq, opcode, piece))
        return frames

    @staticmethod
    def _give_up_before(seq: int, flying: OrderedDict[int, tuple[Piece, float]], again: deque[Piece]) -> None:
        """Repeat what was sent well before something that is answered: servers answer in order."""
        while flying:
            first = next(iter(flying))
            if not OVERTAKEN < (seq - first) & 0xFFFF < 0x8000:
                return
            again.append(flying.pop(first)[0])

    def _answers(self) -> Iterator[tuple[int, bytes]]:
        """Yield sequence number and data of the replies that are there."""
        for _ in range(DRAIN):
            try:
                data = self._sock.recv(65535)
            except BlockingIOError:
                return
            start = 0
            while start + 12 <= len(data) and data[start] == 0xFD:
                stop = start + data[start + 1] + 12
                if data[start + 7] == FTP_ID:
                    wire = data[start + 13 : stop - 2].ljust(251, b"\0")
                    seq, session, opcode, size, asked, _, _ = _ftp.unpack_from(wire)
                    if opcode != ACK and asked != TERMINATE:  # a repeated one finds the session closed
                        raise OSError(f"opcode {asked} was refused with {wire[12]}")
                    if asked in (OPEN_RO, CREATE):
                        self._session = session
                    yield seq, wire[12 : 12 + size]
                start = stop

    def _send(self, frames: list[bytes], now: float) -> None:
        assert self._peer is not None
        if now - self._beat_at > BEAT:
            self._beat_at = now
            beat = struct.pack("<IBBBBB", 0, 18, 8, 0, 4, 3)
            frames.append(frame(HEARTBEAT_ID, HEARTBEAT_EXTRA, beat))
        for start in range(0, len(frames), PACK):
            self._sock.sendto(b"".join(frames[start : start + PACK]), self._peer)


def main() -> int:
    """Move one file as the bench asks."""
    parser = argparse.ArgumentParser(prog="tests.bench.bare")
    parser.add_argument("port", type=int)
    parser.add_argument("direction", choices=["read", "write"])
    parser.add_argument("remote")
    parser.add_argument("local", type=Path)
    parser.add_argument("timeout", type=float)
    parser.add_argument("--window", type=int, default=64)
    parser.add_argument("--patience", type=float, default=0.25, help="seconds until a request is repeated")
    args = parser.parse_args()
    bare, remote = Bare(args.port, args.window, args.patience), args.remote.encode()
    bare.connect()
    if args.direction == "read":
        timed(args.timeout, lambda: args.local.write_bytes(bare.read(remote)))
    else:
        timed(args.timeout, lambda: bare.write(remote, args.local.read_bytes()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
