"""How late a path is seen to deliver what it doubled or held back."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.lateness import LONGEST, MEMORY, Lateness
from mavftpfs.protocol.ledger import Ghost, Ledger
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.requests import READ_MANNER, Request
from tests.support.replies import ack, sent


def exchange(lateness: Lateness, answer: int, sent: float, answered: float) -> None:
    """One request and its answer."""
    lateness.on_sent(answer, sent)
    lateness.on_answered(sent, answered)


def after_exchanges(count: int) -> Lateness:
    """Return what saw so many exchanges, one every 0.2 s; each took 0.1 s."""
    lateness = Lateness()
    for number in range(count):
        exchange(lateness, 1 + number, 0.2 * number, 0.2 * number + 0.1)
    return lateness


def test_a_copy_is_late_since_it_was_overtaken() -> None:
    lateness = after_exchanges(3)
    lateness.on_stray(1, 3.3)
    assert lateness.seen(3.3) == pytest.approx(3.0)


def test_what_nothing_overtook_is_not_late() -> None:
    """A queue, or a card that makes a pause, keeps everybody waiting."""
    lateness = Lateness()
    exchange(lateness, 1, 0.0, 8.0)
    lateness.on_stray(1, 8.1)
    lateness.on_sent(1, 9.0)  # repeated, so that nobody knows which of both this answers
    lateness.on_stray(1, 9.5)
    assert lateness.seen(10.0) == 0.0


def test_the_longest_counts_and_is_forgotten() -> None:
    lateness = after_exchanges(3)
    lateness.on_stray(1, 2.3)
    lateness.on_stray(2, 1.0)
    assert lateness.seen(3.0) == pytest.approx(2.0)
    assert lateness.seen(2.3 + MEMORY + 1) == 0.0


def test_answers_of_others_tell_nothing() -> None:
    lateness = after_exchanges(2)
    lateness.on_stray(77, 1.0)
    lateness.on_stray(1, 0.3 + LONGEST + 1)
    assert lateness.seen(12.0) == 0.0


def test_little_is_remembered() -> None:
    lateness = Lateness()
    for number in range(10_000):
        exchange(lateness, number, float(number), number + 0.5)
    lateness.on_stray(1, 10_000.0)
    assert lateness.seen(10_000.0) == 0.0
    lateness.on_stray(9_995, 10_000.0)
    assert lateness.seen(10_000.0) == pytest.approx(3.5)


def test_a_seq_that_was_used_again_tells_nothing() -> None:
    """Of a row of requests the first is remembered only: a fast transfer comes round in less than 10 s."""
    lateness = after_exchanges(3)
    lateness.on_passed(65_535)
    lateness.on_stray(1, 3.3)
    assert lateness.seen(3.3) == 0.0


def burst(ledger: Ledger) -> None:
    for _ in range(16):
        ledger.jump(4096)


def singly(ledger: Ledger) -> None:
    for _ in range(65_535):
        ledger.take_seq()


def in_rows(ledger: Ledger) -> None:
    for _ in range(33):
        row = [Request(Ghost(), Opcode.READ_FILE, READ_MANNER, 0, 0, 239) for _ in range(2000)]
        ledger.launch(row, 0.5, 1.0)
        for request in row:
            ledger.forget(request)


@pytest.mark.parametrize("use", [burst, singly, in_rows])
def test_the_engine_counts_its_seqs(use: Callable[[Ledger], None]) -> None:
    engine = Engine(random.Random(1), Flow())
    first = ack(ask(engine, Opcode.CREATE_DIRECTORY, 0.0))
    engine.receive(first, 0.1)
    use(engine._ledger)
    engine.receive(ack(ask(engine, Opcode.REMOVE_DIRECTORY, 1.0)), 1.1)
    engine.receive(first, 4.1)
    assert engine.stats.lateness.seen(4.1) == 0.0


def ask(engine: Engine, opcode: Opcode, now: float) -> Payload:
    """Send a request of a kind, and return it."""
    engine.start(Simple(opcode, b"/d"), now)
    (request,) = sent(engine, now)
    return request


def test_the_engine_sees_copies_of_answers() -> None:
    engine = Engine(random.Random(1), Flow())
    first = ack(ask(engine, Opcode.CREATE_DIRECTORY, 0.0))
    engine.receive(first, 0.1)
    engine.receive(first, 0.2)
    assert engine.stats.lateness.seen(0.2) == 0.0
    engine.receive(ack(ask(engine, Opcode.REMOVE_DIRECTORY, 1.0)), 1.1)
    engine.receive(first, 4.1)
    assert engine.stats.lateness.seen(4.1) == pytest.approx(3.0)


def test_work_that_takes_long_is_not_late() -> None:
    """A checksum that was asked for twice is worked out twice, while others are answered."""
    engine = Engine(random.Random(1), Flow())
    slow = ack(ask(engine, Opcode.CALC_FILE_CRC32, 0.0), bytes(4))
    for number in range(5):
        engine.receive(ack(ask(engine, Opcode.CREATE_DIRECTORY, number + 1.0)), number + 1.1)
    engine.receive(slow, 6.0)
    engine.receive(slow, 9.0)
    assert engine.stats.unknown == 1
    assert engine.stats.lateness.seen(9.0) == 0.0


def test_a_long_way_is_not_late() -> None:
    """What was repeated before anything could be answered is answered as often, in order."""
    engine = Engine(random.Random(1), Flow())
    answers = []
    for start, opcode in ((0.0, Opcode.CREATE_DIRECTORY), (0.5, Opcode.REMOVE_DIRECTORY)):
        request = ask(engine, opcode, start)
        answers.append((start + 5.0, ack(request)))
        for now in (start + 1.0, start + 2.0, start + 4.0):
            engine.on_deadline(now + 0.01)
            answers += [(now + 5.01, ack(again)) for again in sent(engine, now + 0.01)]
    assert len(answers) > 4
    for now, answer in sorted(answers, key=lambda item: item[0]):
        engine.receive(answer, now)
    assert engine.stats.unknown
    assert engine.stats.lateness.seen(12.0) == 0.0
