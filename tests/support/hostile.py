"""A vehicle that means harm, or is badly broken, as its own process.

    python -m tests.support.hostile MODE PORT      # speaks from a free port to 127.0.0.1:PORT until SIGTERM

MODE `files` serves the listings and files below; `mute` sends heartbeats and never answers FTP; `noise`
serves like `files` and surrounds every answer with garbage, forged and foreign replies.
"""

from __future__ import annotations

import random
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpFrame
from mavftpfs.protocol.crc import crc32
from mavftpfs.protocol.payload import NakCode, Opcode, Payload, decode_request

HOST = "127.0.0.1"
US = Address(1, 1)
TYPE_QUADROTOR = 2
AUTOPILOT_GENERIC = 0

GOOD = b"good"
GOOD_NAMES = {"good.txt", "no_size", "caf\udce9"}
"""What of the directory /names may appear, as os.listdir shows it; all hold GOOD."""

NAMES = (
    b"F../../etc/passwd\t4",
    b"F/etc/shadow\t4",
    b"D..",
    b"D.",
    b"F\t4",
    b"D",
    b"S",
    b"Xunknown\t4",
    b"Fgood.txt\t4",
    b"Fgood.txt\t4",
    b"Dgood.txt",
    b"Fno_size",
    b"Fcaf\xe9\t4",
    b"Fsub/dir\t4",
)

NAKED = (2, 4, 8, 9, 12)
"""Codes that opening /nak/open<code> and reading /nak/read<code> is refused with, known and unknown."""

BROKEN = ("short.bin", "empty_acks.bin", "shifted.bin", "silent.bin", "other_opcode.bin")
"""Files of /broken: 1000 bytes by listing and open, but never fully readable."""
BROKEN_SIZE = 1000

DIRECTORIES: dict[bytes, tuple[bytes, ...]] = {
    b"/": (b"Dnames", b"Dnak", b"Dbroken", b"Dendless", b"Dsame", b"Drefused", b"Ffine.bin\t5000"),
    b"/names": NAMES,
    b"/nak": tuple(b"F%s%d\t4" % (kind, code) for code in NAKED for kind in (b"open", b"read")),
    b"/broken": tuple(b"F%s\t%d" % (name.encode(), BROKEN_SIZE) for name in BROKEN),
}
FINE = random.Random("fine").randbytes(5000)


class Server:
    """Answers requests; one file may be open, its session id is 0."""

    def __init__(self) -> None:
        self.path = b""

    def answer(self, request: Payload) -> Payload | None:
        """Return the answer to a request, or None for silence."""
        path = request.data[: request.size].rstrip(b"\0")
        if request.opcode == Opcode.LIST_DIRECTORY:
            return self.list(request, path)
        if request.opcode == Opcode.OPEN_FILE_RO:
            return self.open(request, path)
        if request.opcode == Opcode.READ_FILE:
            return self.read(request)
        if request.opcode == Opcode.CALC_FILE_CRC32:
            return ack(request, crc32(content(path)).to_bytes(4, "little"))
        if request.opcode in (Opcode.NONE, Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS):
            return ack(request, b"")
        return nak(request, NakCode.UNKNOWN_COMMAND)

    def list(self, request: Payload, path: bytes) -> Payload:
        """Serve a listing page."""
        path = path.rstrip(b"/") or b"/"
        if path == b"/endless":
            names = [b"Fendless%09d\t4" % (request.offset + step) for step in range(8)]
            return ack(request, b"\0".join(names) + b"\0")
        if path == b"/same":
            return ack(request, b"Fsame_for_ever\t4\0")
        entries = DIRECTORIES.get(path)
        if entries is None:
            return nak(request, NakCode.FILE_NOT_FOUND)
        page = entries[request.offset : request.offset + 5]
        if not page:
            return nak(request, NakCode.EOF)
        return ack(request, b"\0".join(page) + b"\0")

    def open(self, request: Payload, path: bytes) -> Payload:
        """Open whatever is asked for; the size is what the listing said."""
        self.path = path
        if path.startswith(b"/nak/open"):
            return nak(request, int(path[len(b"/nak/open") :]))
        return ack(request, len(content(path)).to_bytes(4, "little"))

    def read(self, request: Payload) -> Payload | None:
        """Serve a chunk, as broken as the file's name says."""
        if self.path.startswith(b"/nak/read"):
            return nak(request, int(self.path[len(b"/nak/read") :]))
        chunk = content(self.path)[request.offset : request.offset + request.size]
        name = self.path.rpartition(b"/")[2].decode(errors="replace")
        if name == "silent.bin":
            return None
        if name == "shifted.bin":
            return ack(request, chunk)._replace(offset=request.offset + 1)
        if name == "other_opcode.bin":
            return ack(request, chunk)._replace(req_opcode=Opcode.LIST_DIRECTORY)
        if name == "empty_acks.bin" and request.offset >= 239:
            return ack(request, b"")
        if not chunk or (name == "short.bin" and request.offset >= 500):
            return nak(request, NakCode.EOF)
        return ack(request, chunk)


def content(path: bytes) -> bytes:
    """Return what a file would hold."""
    if path == b"/fine.bin":
        return FINE
    return bytes(BROKEN_SIZE) if path.startswith(b"/broken/") else GOOD


def ack(request: Payload, data: bytes) -> Payload:
    """Return an ACK."""
    return Payload(
        (request.seq + 1) & 0xFFFF, 0, Opcode.ACK, len(data), request.opcode, 0, request.offset, data
    )


def nak(request: Payload, code: int) -> Payload:
    """Return a NAK; FailErrno carries EIO of some other operating system."""
    data = bytes([code, 205]) if code == NakCode.FAIL_ERRNO else bytes([code])
    return ack(request, data)._replace(opcode=Opcode.NAK)


def noise(rng: random.Random, frame: FtpFrame, framer: Framer, answer: bytes) -> Iterator[bytes]:
    """Yield datagrams that must change nothing: garbage, cut frames, forged replies and another vehicle's."""
    request = decode_request(frame.payload)
    forged = ack(request, b"evil" * 50)
    stranger = Framer(Address(9, 1), stream=False)
    yield rng.randbytes(rng.randrange(1, 300))
    yield answer[: rng.randrange(1, len(answer))]
    yield bytes([answer[0]]) + rng.randbytes(60)
    yield stranger.encode_ftp(frame.source, forged.encode())
    yield framer.encode_ftp(frame.source, forged._replace(seq=(request.seq + 77) & 0xFFFF).encode())
    if rng.random() < 0.2:  # looks like a replay, which costs the client a new seq: not every time
        yield framer.encode_ftp(frame.source, forged._replace(req_opcode=Opcode.RENAME).encode())
    yield framer.encode_ftp(frame.source, rng.randbytes(251))


def serve(sock: socket.socket, framer: Framer, react: Callable[[FtpFrame], Iterator[bytes]]) -> None:
    """Beat every half second and react to requests, for ever."""
    next_beat = 0.0
    while True:
        if time.monotonic() >= next_beat:
            sock.send(framer.encode_heartbeat(TYPE_QUADROTOR, AUTOPILOT_GENERIC))
            next_beat = time.monotonic() + 0.5
        if not select.select([sock], [], [], 0.1)[0]:
            continue
        try:
            datagram = sock.recv(65536)
        except ConnectionRefusedError:  # nobody mounts us at the moment
            continue
        for message in framer.feed(datagram):
            if isinstance(message, FtpFrame):
                for out in react(message):
                    sock.send(out)


def main() -> int:
    """Run as a process until SIGTERM."""
    mode, port = sys.argv[1], int(sys.argv[2])
    server, rng, framer = Server(), random.Random(3), Framer(US, stream=False)

    def react(frame: FtpFrame) -> Iterator[bytes]:
        answer = None if mode == "mute" else server.answer(decode_request(frame.payload))
        if answer is None:
            return
        wire = framer.encode_ftp(frame.source, answer.encode())
        if mode == "noise":
            yield from noise(rng, frame, framer, wire)
        yield wire

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((HOST, port))
        print("ready", flush=True)
        serve(sock, framer, react)
    return 0


if __name__ == "__main__":
    sys.exit(main())
