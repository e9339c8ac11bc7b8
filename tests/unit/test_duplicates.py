"""Answers that prove that the network doubles requests, and answers to our own retransmissions.

For the first, ACKs are distrusted for ten minutes (`ServerSession.distrust`): a card that pauses must not do
that.
"""

from __future__ import annotations

import random

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.reading import ReadTransfer
from tests.support.replies import ack, chunk, sent
from tests.support.transfers import MemorySink

SIZE = 4 * 239
CONTENT = bytes(SIZE)


class Unexplained(Engine):
    """An engine that notes the answers that no request explains."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, float | None]] = []
        super().__init__(random.Random(1), Flow(limit=8))
        self.on_unexplained = lambda reply, lateness: self.heard.append((reply.req_opcode, lateness))


def reading(engine: Engine, kind: type[ReadTransfer] = ReadTransfer) -> ReadTransfer:
    """Begin to read a file of four chunks."""
    transfer = kind(0, SIZE, MemorySink(SIZE))
    engine.start(transfer, 0.0)
    transfer.want(0, SIZE, True)
    return transfer


def ask(engine: Engine, opcode: Opcode, now: float) -> Payload:
    """Send a request of a kind, and return it."""
    engine.start(Simple(opcode, b"/d"), now)
    (request,) = sent(engine, now)
    return request


def again(engine: Engine, now: float) -> list[Payload]:
    """Let timers run out, and return what goes out once more."""
    engine.on_deadline(now)
    return sent(engine, now)


def asked_twice(engine: Engine) -> Payload:
    """Ask at 0 and at 1 s for something that has the same seq again."""
    first = ask(engine, Opcode.CREATE_DIRECTORY, 0.0)
    assert again(engine, 1.0) == [first]
    return first


def test_a_card_that_pauses_is_no_bad_path_though_nobody_wants_its_answers_any_more() -> None:
    engine = Unexplained()
    transfer = reading(engine)
    asked = sent(engine, 0.0)
    asked += again(engine, 1.0)
    engine.on_deadline(2.0)  # lost, and not sent again before it is forgotten
    engine.remove(transfer)
    for request in asked:
        engine.receive(chunk(request, CONTENT), 3.0)
    assert not engine.heard


def test_two_answers_to_two_requests() -> None:
    engine = Unexplained()
    request = asked_twice(engine)
    engine.receive(ack(request), 1.1)
    engine.receive(ack(request), 1.2)
    assert not engine.heard
    engine.receive(ack(request), 1.3)
    assert len(engine.heard) == 1


def test_how_late_a_copy_was_is_told() -> None:
    engine = Unexplained()
    request = ask(engine, Opcode.CREATE_DIRECTORY, 1.0)
    engine.receive(ack(request), 1.1)
    engine.receive(ack(request), 4.0)
    assert engine.heard == [(Opcode.CREATE_DIRECTORY, 3.0)]
    engine.heard.clear()
    stray = ack(request)._replace(seq=request.seq + 500)
    engine.receive(stray, 4.0)
    reading(engine)
    read = sent(engine, 5.0)
    engine.receive(chunk(read[1], CONTENT), 5.1)
    engine.receive(chunk(read[1], CONTENT), 5.25)
    assert engine.heard == [(Opcode.CREATE_DIRECTORY, None), (Opcode.READ_FILE, 0.25)]


def read_twice(engine: Engine) -> tuple[Payload, Payload]:
    """Ask at 0 and at 1 s for the first chunk of a file; each time the seq is another."""
    reading(engine)
    first = sent(engine, 0.0)[0]
    second = again(engine, 1.0)[0]
    assert second.offset == first.offset
    return first, second


def test_two_answers_to_one_of_two_requests() -> None:
    engine = Unexplained()
    _, second = read_twice(engine)
    engine.receive(chunk(second, CONTENT), 1.1)
    assert not engine.heard
    engine.receive(chunk(second, CONTENT), 1.1)
    assert len(engine.heard) == 1


def test_little_is_remembered() -> None:
    engine = Unexplained()
    request = asked_twice(engine)
    engine.receive(ack(request), 1.1)
    for number in range(1100):
        now = 10.0 * (number + 1)
        other = ask(engine, Opcode.CREATE_DIRECTORY, now)
        again(engine, now + 5.0)
        engine.receive(ack(other), now + 5.1)
    assert len(engine._ledger._table) == 1024
    assert len(engine._ledger._sent) == 1024
