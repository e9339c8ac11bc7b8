"""Replies that come together are taken in runs: what is believed and sent is the same as one by one."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import MAX_DATA, Opcode, Payload
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.protocol.requests import Operation
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.shared.errors import RemoteProtocolError
from mavftpfs.shared.model import Traits
from tests.support.replies import ack, chunk, decode_reply, sent
from tests.support.transfers import MemorySink, MemorySource

CONTENT = random.Random(8).randbytes(MAX_DATA * 300 + 17)
WINDOW = 24

Answer = Callable[[Payload], Payload]
Make = Callable[[], tuple[Operation, Answer, Callable[[], object]]]


class Steady(Flow):
    """A flow whose window does not depend on the order of answers that arrive at one moment."""

    def room(self, in_flight: int, now: float, *, paced: bool, urgent: bool = False) -> int:
        return WINDOW - in_flight


def reader() -> tuple[Operation, Answer, Callable[[], object]]:
    sink = MemorySink(len(CONTENT))
    transfer = ReadTransfer(0, len(CONTENT), sink)
    transfer.want(0, len(CONTENT), True)
    return transfer, lambda request: chunk(request, CONTENT), lambda: (sink.data, transfer.received_bytes)


def writer() -> tuple[Operation, Answer, Callable[[], object]]:
    source = MemorySource(CONTENT)
    transfer = WriteTransfer(0, source)
    return (
        transfer,
        lambda request: ack(request, request.size.to_bytes(4, "little")),
        lambda: (source.acked, list(source.in_flight), list(source.todo)),
    )


def spoil(reply: Payload, rng: random.Random) -> list[bytes]:
    """Return what a bad server or network makes of a reply; mostly the reply itself."""
    wire = bytearray(reply.encode())
    match rng.randrange(40):
        case 0:
            return []
        case 1:
            return [bytes(wire), bytes(wire)]
        case 2:
            wire[4] = 240  # says it holds more than fits
        case 3:
            wire[8] ^= 1  # the offset
        case 4:
            wire[2] ^= 1  # the session
        case 5:
            wire[5] = Opcode.LIST_DIRECTORY  # an answer to something else
        case 6:
            wire[0] ^= 0x80  # of a seq that is not out
        case 7:
            wire[4] = rng.randrange(1, 4)  # less than was asked for
        case 8:
            if rng.random() < 0.02:
                wire[3], wire[4], wire[12:14] = Opcode.NAK, 2, b"\x02\x05"
    return [bytes(wire)]


def take_singly(engine: Engine, wires: list[bytes], now: float) -> int:
    malformed = 0
    for wire in wires:
        try:
            engine.receive(decode_reply(wire), now)
        except RemoteProtocolError:
            malformed += 1
    return malformed


@pytest.mark.holds("rule 14.2", "rule 14.5")
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("make", [reader, writer])
def test_runs_are_believed_as_single_replies_are(make: Make, seed: int) -> None:
    rng = random.Random(seed)
    traits = [Traits(ack_carries_own_session=seed % 2 == 1) for _ in range(2)]
    engines = [Engine(random.Random(1), Steady()) for _ in range(2)]
    for engine, known in zip(engines, traits, strict=True):
        engine.traits = known
    (first, answer, state), (second, _, twin_state) = make(), make()
    for engine, op in zip(engines, (first, second), strict=True):
        engine.start(op, 0.0)
    now, waiting = 0.0, []
    for _ in range(400):
        asked, twin_asked = (sent(engine, now) for engine in engines)
        assert asked == twin_asked
        waiting += [wire for request in asked for wire in spoil(answer(request), rng)]
        now += rng.choice((0.0, 0.01, 0.06))
        count = rng.randrange(WINDOW)
        batch, waiting = waiting[:count], waiting[count:]
        assert engines[0].receive_run(batch, now) == take_singly(engines[1], batch, now)
        for engine in engines:
            engine.on_deadline(now)
        assert state() == twin_state()
        assert engines[0].stats == engines[1].stats
        assert engines[0].in_flight == engines[1].in_flight
        assert (first.done, str(first.error)) == (second.done, str(second.error))


def test_a_run_is_told_to_the_transfer_at_once() -> None:
    """Runs are cheap because the sink gets chunks in a row as one."""

    class Counting(MemorySink):
        calls = 0

        def on_data(self, offset: int, data: bytes) -> None:
            self.calls += 1
            super().on_data(offset, data)

    sink = Counting(len(CONTENT))
    transfer = ReadTransfer(0, len(CONTENT), sink)
    transfer.want(0, len(CONTENT), True)
    engine = Engine(random.Random(1), Flow(limit=WINDOW))
    engine.start(transfer, 0.0)
    replies = [chunk(request, CONTENT).encode() for request in sent(engine, 0.0)]
    assert engine.receive_run(replies, 0.1) == 0
    assert len(replies) > 4
    assert sink.calls == 1
