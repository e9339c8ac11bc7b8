"""What each part of the hot path costs for a chunk, by replaying a transfer through one part at a time.

One thread, no waiting, the best of several rounds: so the figures vary little from run to run, and their
shares hardly at all. Batches are as long as WINDOW; what the loop around them costs is measured elsewhere.
"""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import trio
from pymavlink.dialects.v20 import ardupilotmega as dialect
from trio.testing import MockClock

from mavftpfs.cache.blocks import BlockCache, FileBlocks
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.spool import Spool
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from mavftpfs.link.udp import UdpLink
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import MAX_DATA, Opcode, Payload, decode_request
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.upload import Feed

WINDOW = 64
CHUNKS = 8192
ROUNDS = 5
US = 1e6
_SIZE = CHUNKS * MAX_DATA
_CLIENT, _VEHICLE = Address(254, 191), Address(1, 1)
_PER_DATAGRAM = 5
_ROW = WINDOW // 2 * MAX_DATA
"""Bytes that come or go together."""


class Meter:
    """Sums the CPU time of what runs inside `on`."""

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextmanager
    def on(self) -> Iterator[None]:
        """Count the body."""
        began = time.thread_time()
        yield
        self.seconds += time.thread_time() - began


Part = Callable[[Meter], None]


def cost(part: Part) -> float:
    """Return the microseconds per chunk of a part, which handles CHUNKS of them; the best of ROUNDS."""
    best = float("inf")
    for _ in range(ROUNDS):
        meter = Meter()
        part(meter)
        best = min(best, meter.seconds)
    return best / CHUNKS * US


def read_parts() -> dict[str, float]:
    """Return the microseconds per chunk of each part of reading."""
    return _costs(_read_request, _read_reply, _engine_reading, "placing in the cache", _placing)


def write_parts() -> dict[str, float]:
    """Return the microseconds per chunk of each part of writing."""
    return _costs(_write_request, _write_reply, _engine_writing, "taking from the spool", _drafting)


def codec_costs() -> dict[str, tuple[float, float]]:
    """Return the microseconds that one frame takes us, and pymavlink, whose bytes are compared with ours."""
    found = {}
    for name, make in (("build a ReadFile", _read_request), ("build a WriteFile", _write_request)):
        payloads = [make(n, n * MAX_DATA) for n in range(CHUNKS)]
        assert _packed_by_pymavlink(payloads) == _frames(payloads, _CLIENT, _VEHICLE)
        found[name] = cost(_encoding(payloads)), cost(_timed(_packed_by_pymavlink, payloads))
    for name, make in (("parse a chunk", _read_reply), ("parse an ACK", _write_reply)):
        payloads = [make(n, n * MAX_DATA) for n in range(CHUNKS)]
        datagrams = _datagrams(payloads)
        assert _parsed_by_pymavlink(datagrams) == payloads
        found[name] = cost(_decoding(payloads)), cost(_timed(_parsed_by_pymavlink, datagrams))
    return found


def _costs(
    request: Callable[[int, int], bytes],
    reply: Callable[[int, int], bytes],
    engine: Part,
    keeping: str,
    keep: Part,
) -> dict[str, float]:
    """request, reply: of a seq and an offset. keep: what is done with the bytes here, called `keeping`."""
    replies = [reply(n, n * MAX_DATA) for n in range(CHUNKS)]
    requests = [request(n, n * MAX_DATA) for n in range(CHUNKS)]
    return {
        "receive (system call)": cost(_receiving(replies)),
        "find and check frames": cost(_decoding(replies)),
        "engine and transfer": cost(engine),
        keeping: cost(keep),
        "build frames": cost(_encoding(requests)),
        "send (system call)": cost(_sending(requests)),
    }


# --- payloads

_DATA = random.Random(1).randbytes(MAX_DATA)
_CONTENT = _DATA * CHUNKS


def _read_request(seq: int, offset: int) -> bytes:
    return Payload(seq, 0, Opcode.READ_FILE, MAX_DATA, offset=offset).encode()


def _read_reply(seq: int, offset: int) -> bytes:
    return Payload(seq + 1, 0, Opcode.ACK, MAX_DATA, Opcode.READ_FILE, 0, offset, _DATA).encode()


def _write_request(seq: int, offset: int) -> bytes:
    return Payload(seq, 0, Opcode.WRITE_FILE, MAX_DATA, offset=offset, data=_DATA).encode()


def _write_reply(seq: int, offset: int) -> bytes:
    count = MAX_DATA.to_bytes(4, "little")
    return Payload(seq + 1, 0, Opcode.ACK, 4, Opcode.WRITE_FILE, 0, offset, count).encode()


# --- the wire


def _frames(payloads: list[bytes], source: Address, target: Address) -> list[bytes]:
    framer = Framer(source, stream=False)
    return [framer.encode_ftp(target, payload) for payload in payloads]


def _datagrams(payloads: list[bytes]) -> list[bytes]:
    frames = _frames(payloads, _VEHICLE, _CLIENT)
    return [b"".join(frames[at : at + _PER_DATAGRAM]) for at in range(0, len(frames), _PER_DATAGRAM)]


def _decoding(payloads: list[bytes]) -> Part:
    datagrams = _datagrams(payloads)

    def run(meter: Meter) -> None:
        framer = Framer(_CLIENT, stream=False)
        with meter.on():
            for datagram in datagrams:
                framer.feed_runs(datagram)

    return run


def _encoding(payloads: list[bytes]) -> Part:
    def run(meter: Meter) -> None:
        framer = Framer(_CLIENT, stream=False)
        with meter.on():
            for at in range(0, CHUNKS, WINDOW):
                framer.encode_ftp_run(_VEHICLE, payloads[at : at + WINDOW])

    return run


def _timed(work: Callable[[list[bytes]], object], data: list[bytes]) -> Part:
    def run(meter: Meter) -> None:
        with meter.on():
            work(data)

    return run


def _packed_by_pymavlink(payloads: list[bytes]) -> list[bytes]:
    mav = dialect.MAVLink(None, *_CLIENT)
    frames = []
    for payload in payloads:
        frames.append(mav.file_transfer_protocol_encode(0, *_VEHICLE, list(payload)).pack(mav))
        mav.seq = (mav.seq + 1) & 0xFF
    return frames


def _parsed_by_pymavlink(datagrams: list[bytes]) -> list[bytes]:
    mav = dialect.MAVLink(None, *_CLIENT)
    return [bytes(message.payload) for datagram in datagrams for message in mav.parse_buffer(datagram)]


@contextmanager
def _sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    with (
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as near,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as far,
    ):
        for sock in (near, far):
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            sock.bind(("127.0.0.1", 0))
        yield near, far


def _sending(payloads: list[bytes]) -> Part:
    frames = _frames(payloads, _CLIENT, _VEHICLE)

    def run(meter: Meter) -> None:
        with _sockets() as (near, far):
            link = UdpLink(near, "bench", far.getsockname())
            for at in range(0, CHUNKS, WINDOW):
                with meter.on():
                    link.send_nowait(frames[at : at + WINDOW])
                _empty(far)

    return run


def _receiving(payloads: list[bytes]) -> Part:
    datagrams = _datagrams(payloads)

    def run(meter: Meter) -> None:
        with _sockets() as (near, far):
            link = UdpLink(near, "bench", far.getsockname())
            for at in range(0, len(datagrams), WINDOW // _PER_DATAGRAM):
                for datagram in datagrams[at : at + WINDOW // _PER_DATAGRAM]:
                    far.sendto(datagram, near.getsockname())
                with meter.on():
                    link._drain()

    return run


def _empty(sock: socket.socket) -> None:
    try:
        while True:
            sock.recv(65535)
    except BlockingIOError:
        return


# --- engine and caches


class _NullSink:
    """Wants everything and keeps nothing."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        return [(start, stop)]

    def on_data(self, offset: int, data: bytes) -> None:
        return


class _EndlessSource:
    """Has a file's worth of the same chunk, in memory."""

    def __init__(self) -> None:
        self._next = 0

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        at = self._next
        if at >= _SIZE:
            return None
        self._next = stop = min(_SIZE, at + limit)
        return at, _CONTENT[at:stop]

    def on_acked(self, offset: int, count: int) -> None:
        return

    def on_unsent(self, offset: int, count: int) -> None:
        raise AssertionError("nothing fails here")


def _engine_reading(meter: Meter) -> None:
    transfer = ReadTransfer(0, _SIZE, _NullSink())
    transfer.want(0, _SIZE, True)
    _run_engine(meter, transfer, _DATA)
    assert transfer.received_bytes == _SIZE


def _engine_writing(meter: Meter) -> None:
    transfer = WriteTransfer(0, _EndlessSource())
    _run_engine(meter, transfer, MAX_DATA.to_bytes(4, "little"))
    assert transfer.acked_bytes == _SIZE


def _run_engine(meter: Meter, transfer: ReadTransfer | WriteTransfer, data: bytes) -> None:
    engine = Engine(random.Random(1), Flow(limit=WINDOW))
    engine.start(transfer, 0.0)
    now = 0.0
    while not transfer.idle:
        now += 0.001
        with meter.on():
            wires = engine.outgoing(now)
        replies = [_answer(decode_request(wire), data) for wire in wires]
        with meter.on():
            engine.receive_run(replies, now)
            engine.take_finished()


def _answer(request: Payload, data: bytes) -> bytes:
    return Payload(
        request.seq + 1 & 0xFFFF, 0, Opcode.ACK, len(data), request.opcode, 0, request.offset, data
    ).encode()


def _placing(meter: Meter) -> None:
    cache = BlockCache(2 * _SIZE, clock=lambda: 0.0, patience=1.0)
    blocks = FileBlocks(cache, _SIZE)
    with meter.on():
        for at in range(0, _SIZE, _ROW):
            blocks.on_data(at, _CONTENT[at : at + _ROW])


def _drafting(meter: Meter) -> None:
    async def run() -> None:
        spool = Spool(memory_max=lambda: 2 * _SIZE, spool_max=0)
        draft = Draft(spool.content(), None)
        draft.write(0, bytes(_SIZE))
        feed = Feed(draft.begin(whole=True), MAX_DATA)
        with meter.on():
            for _ in range(0, _SIZE, _ROW):
                piece = feed.next_chunk(_ROW)
                assert piece is not None
                feed.on_acked(piece[0], len(piece[1]))

    trio.run(run, clock=MockClock())


if __name__ == "__main__":
    for name, parts in (("read", read_parts()), ("write", write_parts())):
        print(name, round(sum(parts.values()), 2))
        for k, v in parts.items():
            print(f"   {v:6.2f}  {k}")
