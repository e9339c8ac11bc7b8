"""The least a client can do: one file over UDP by a pipelined loop, without mount, cache or event loop.

What `tests.bench.cost` compares the mount with. It asks with the product's own codec (pymavlink's would be
the bottleneck), keeps a fixed window, and repeats what is not answered for a while. It knows no errors: any
refusal ends it.
"""

from __future__ import annotations

import select
import socket
import struct
from collections import deque
from collections.abc import Iterator

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpFrame, Heartbeat
from mavftpfs.protocol.payload import MAX_DATA, PAYLOAD_SIZE, Opcode, request

WINDOW = 64
BATCH = 256
PATIENCE = 0.3
GIVE_UP = 30.0

_header = struct.Struct("<HBBBBBxI")
_reply_fields = _header.unpack_from


class BareLoop:
    """A client of the vehicle that sends its heartbeats to `port`.

    window: requests in flight. Raises AssertionError for whatever it does not expect.
    """

    def __init__(self, port: int, window: int = WINDOW) -> None:
        self.window = window
        self.framer = Framer(Address(254, 192), stream=False)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._sock.setblocking(False)
        self._sock.bind(("127.0.0.1", port))
        self._seq = 0
        self._vehicle = Address(1, 1)
        self._peer: tuple[str, int] | None = None

    def close(self) -> None:
        """Free the port."""
        self._sock.close()

    def wait(self) -> None:
        """Wait for the vehicle's first heartbeat."""
        while True:
            assert select.select([self._sock], [], [], GIVE_UP)[0], "no heartbeat"
            data, peer = self._sock.recvfrom(65535)
            for message in self.framer.feed(data):
                if isinstance(message, Heartbeat):
                    self._vehicle, self._peer = message.source, peer
                    return

    def read(self, path: bytes) -> bytes:
        """Return a file."""
        session, size = self._open(Opcode.OPEN_FILE_RO, path)
        content = bytearray(size)
        wanted = ((at, min(MAX_DATA, size - at), b"") for at in range(0, size, MAX_DATA))
        for offset, data in self._exchange(Opcode.READ_FILE, session, wanted):
            content[offset : offset + len(data)] = data
        self._ask(Opcode.TERMINATE_SESSION, session, b"")
        return bytes(content)

    def write(self, path: bytes, content: bytes) -> None:
        """Make a file."""
        session, _ = self._open(Opcode.CREATE_FILE, path)
        pieces = ((at, 0, content[at : at + MAX_DATA]) for at in range(0, len(content), MAX_DATA))
        for _ in self._exchange(Opcode.WRITE_FILE, session, pieces):
            pass
        self._ask(Opcode.TERMINATE_SESSION, session, b"")

    def _open(self, opcode: Opcode, path: bytes) -> tuple[int, int]:
        session, data = self._ask(opcode, 0, path)
        return session, int.from_bytes(data[:4], "little")

    def _ask(self, opcode: Opcode, session: int, data: bytes) -> tuple[int, bytes]:
        self._seq = (self._seq + 1) % 65535
        wire = request(self._seq, opcode, session=session, data=data).encode()
        for _ in range(int(GIVE_UP / PATIENCE)):
            self._send([self.framer.encode_ftp(self._vehicle, wire)])
            for seq, session_id, kind, content in self._replies():
                if seq == self._seq + 1:
                    assert kind == Opcode.ACK, f"{opcode.name} was refused: {content[:2]!r}"
                    return session_id, content
        raise AssertionError(f"{opcode.name} is not answered")

    def _replies(self) -> Iterator[tuple[int, int, int, bytes]]:
        select.select([self._sock], [], [], PATIENCE)
        for wire in self._drain():
            seq, session, opcode, size, _, _, _ = _reply_fields(wire)
            yield seq, session, opcode, wire[12 : 12 + size]

    def _exchange(
        self, opcode: Opcode, session: int, pieces: Iterator[tuple[int, int, bytes]]
    ) -> Iterator[tuple[int, bytes]]:
        """Ask for all pieces (offset, size to ask for, data); yield (offset, data) of the answers."""
        unanswered: dict[int, tuple[int, bytes]] = {}
        again: deque[tuple[int, bytes]] = deque()
        encode, vehicle = self.framer.encode_ftp, self._vehicle
        while True:
            frames = []
            while len(unanswered) < self.window:
                if again:
                    seq, wire = again.popleft()
                else:
                    piece = next(pieces, None)
                    if piece is None:
                        break
                    self._seq = seq = (self._seq + 1) % 65535
                    offset, size, data = piece
                    head = _header.pack(seq, session, opcode, size or len(data), 0, 0, offset)
                    wire = (head + data).ljust(PAYLOAD_SIZE, b"\0")
                    unanswered[seq + 1] = (offset, wire)
                frames.append(encode(vehicle, wire))
            self._send(frames)
            if not unanswered:
                return
            ready = select.select([self._sock], [], [], PATIENCE)[0]
            if not ready:
                self._send([encode(vehicle, wire) for _, wire in unanswered.values()])
            for wire in self._drain():
                seq, _, kind, size, _, _, _ = _reply_fields(wire)
                known = unanswered.pop(seq, None)
                if known is not None:
                    assert kind == Opcode.ACK, f"{opcode.name} was refused: {wire[12:14]!r}"
                    yield known[0], wire[12 : 12 + size]

    def _drain(self) -> list[bytes]:
        wires: list[bytes] = []
        feed, receive = self.framer.feed, self._sock.recv
        for _ in range(BATCH):
            try:
                data = receive(65535)
            except BlockingIOError:
                break
            wires += [message.payload for message in feed(data) if type(message) is FtpFrame]
        return wires

    def _send(self, frames: list[bytes]) -> None:
        assert self._peer is not None
        for start in range(0, len(frames), 5):
            self._sock.sendto(b"".join(frames[start : start + 5]), self._peer)
