"""WriteTransfer, step by step."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.writing import MAX_OFFSET, WriteTransfer
from mavftpfs.shared.errors import (
    FtpNak,
    LocalProtocolError,
    RequestTimeout,
    SessionLost,
)
from tests.support.replies import ack, nak, sent
from tests.support.transfers import MemorySource

CONTENT = random.Random(5).randbytes(239 * 6 + 11)


def make(limit: int | None = None) -> Engine:
    return Engine(random.Random(3), Flow(limit=limit))


def writing(
    engine: Engine, content: bytes = CONTENT, *, in_flight: int | None = None
) -> tuple[WriteTransfer, MemorySource]:
    source = MemorySource(content)
    transfer = WriteTransfer(0, source, in_flight=in_flight)
    engine.start(transfer, 0.0)
    return transfer, source


def count(number: int) -> bytes:
    return number.to_bytes(4, "little")


@pytest.mark.holds("rule 14.24")
def test_chunks_go_out_ascending_and_full() -> None:
    engine = make()
    transfer, source = writing(engine)
    requests = sent(engine, 0.0)
    assert [(one.opcode, one.offset, one.size) for one in requests] == [
        (Opcode.WRITE_FILE, offset, min(239, len(CONTENT) - offset)) for offset in range(0, 1445, 239)
    ]
    assert b"".join(one.data for one in requests) == CONTENT
    for one in requests:
        engine.receive(ack(one), 0.1)
    assert sent(engine, 0.1) == []
    assert transfer.drained
    assert transfer.idle
    assert not transfer.done
    assert source.acked.covers(0, len(CONTENT))
    assert engine.next_deadline() is None


@pytest.mark.holds("rule 14.23")
def test_a_short_write_sends_the_rest() -> None:
    engine = make()
    transfer, source = writing(engine, CONTENT[:239])
    [first] = sent(engine, 0.0)
    engine.receive(ack(first, count(100)), 0.1)
    assert source.acked.total == 100
    assert not transfer.drained
    [rest] = sent(engine, 0.1)
    assert (rest.offset, rest.data) == (100, CONTENT[100:239])
    engine.receive(ack(rest, count(139)), 0.2)
    assert source.acked.covers(0, 239)


@pytest.mark.holds("rule 14.23")
def test_an_ack_without_a_count_is_for_all() -> None:
    engine = make()
    _, source = writing(engine, b"hello")
    [first] = sent(engine, 0.0)
    engine.receive(ack(first), 0.1)
    assert source.acked.covers(0, 5)


def test_an_ack_of_another_place_is_not_believed_where_acks_tell_the_place() -> None:
    """PX4 replays its last reply to any request with that seq (servers.md 2)."""
    engine = make(limit=1)
    _, source = writing(engine)
    for _ in range(2):
        (request,) = sent(engine, 0.0)
        engine.receive(ack(request, count(239)), 0.1)
    (request,) = sent(engine, 0.2)
    engine.receive(ack(request, count(239))._replace(offset=239), 0.3)
    assert not source.acked.covers(478, 479)
    assert engine.in_flight == 1
    engine.receive(ack(request, count(239)), 0.4)
    assert source.acked.covers(0, 717)


@pytest.mark.parametrize("number", [0, 240, 2**32 - 1])
def test_acks_that_prove_nothing_are_no_progress(number: int) -> None:
    engine = make()
    transfer, source = writing(engine, CONTENT[:239])
    now = 0.0
    while not transfer.done:
        [again] = sent(engine, now)
        assert again.offset == 0
        now += 0.1
        engine.receive(ack(again, count(number)), now)
        engine.on_deadline(now)
    assert isinstance(transfer.error, RequestTimeout)
    assert now == pytest.approx(30.0, abs=0.2)
    assert source.todo.covers(0, 239)


@pytest.mark.parametrize("codes", [(1,), (4,), (10,), (2, 9)])
def test_a_lost_session_gives_everything_back(codes: tuple[int, ...]) -> None:
    engine = make()
    transfer, source = writing(engine)
    requests = sent(engine, 0.0)
    engine.receive(ack(requests[0]), 0.1)
    engine.receive(nak(requests[2], *codes), 0.1)
    assert isinstance(transfer.error, SessionLost)
    assert transfer.error.by_server
    assert isinstance(transfer.error.__cause__, FtpNak) is (codes == (1,))  # which may be a full card
    assert source.in_flight.empty
    assert list(source.todo) == [(239, len(CONTENT))]
    engine.receive(ack(requests[1]), 0.2)  # too late to count for this file
    assert source.acked.total == 239


@pytest.mark.parametrize("codes", [(2, 28), (2, 5), (9,), (8,), (3,)])
def test_other_refusals_are_the_callers(codes: tuple[int, ...]) -> None:
    engine = make()
    transfer, source = writing(engine)
    requests = sent(engine, 0.0)
    engine.receive(nak(requests[0], *codes), 0.1)
    assert isinstance(transfer.error, FtpNak)
    assert (transfer.error.opcode, transfer.error.code) == (Opcode.WRITE_FILE, codes[0])
    assert source.todo.covers(0, len(CONTENT))


def test_pause_drains_and_resume_goes_on() -> None:
    engine = make()
    transfer, _ = writing(engine, in_flight=4)
    requests = sent(engine, 0.0)
    transfer.paused = True
    for one in requests:
        assert not transfer.idle
        engine.receive(ack(one), 0.1)
    assert transfer.idle
    assert transfer.idle
    assert sent(engine, 0.1) == []
    assert engine.next_deadline() is None
    transfer.paused = False
    assert len(sent(engine, 40.0)) == 3
    engine.on_deadline(45.0)
    assert not transfer.done  # the pause was no silence


@pytest.mark.holds("rule 14.26")
@pytest.mark.parametrize("piece", [(0, b""), (0, bytes(1 << 20)), (-1, b"x"), (MAX_OFFSET - 1, b"xy")])
def test_a_chunk_that_does_not_fit_is_refused_without_a_raise(piece: tuple[int, bytes]) -> None:
    class Broken(MemorySource):
        def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
            return piece

    engine = make()
    transfer = WriteTransfer(0, Broken(b"x"))
    engine.start(transfer, 0.0)
    assert sent(engine, 0.0) == []
    assert isinstance(transfer.error, LocalProtocolError)
