"""A lost request for a long chunk goes out in pieces once shorter ones are to be asked for."""

from __future__ import annotations

import random

from mavftpfs.protocol.chunks import Chunks
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.transfers import ReadTransfer
from mavftpfs.protocol.writing import WriteTransfer
from tests.support.replies import ack, chunk, sent
from tests.support.sources import MemorySource
from tests.support.virtual import MemorySink

CONTENT = random.Random(8).randbytes(239 * 8)
WINDOW = 4


def ranges(requests: list[Payload]) -> list[tuple[int, int]]:
    return [(request.offset, request.size) for request in requests]


def lose_all(engine: Engine) -> float:
    """Let the timers of what is on its way run out; return when that is."""
    now = 0.0
    while any(request.flying for request in engine._ledger.flying()):
        deadline = engine.next_deadline()
        assert deadline is not None
        now = deadline
        engine.on_deadline(now)
    return now


class Reads:
    """A transfer whose first requests were lost."""

    def __init__(self, size: int | None) -> None:
        self.engine = Engine(random.Random(1), Flow(limit=WINDOW))
        self.sink = MemorySink(len(CONTENT))
        self.transfer = ReadTransfer(0, len(CONTENT), self.sink)
        self.transfer.chunks = chunks = Chunks()
        self.transfer.want(0, len(CONTENT), True)
        self.engine.start(self.transfer, 0.0)
        self.lost = sent(self.engine, 0.0)
        if size is not None:
            chunks.size, chunks._again_at = size, 1e9
        self.now = lose_all(self.engine)

    def finish(self) -> list[Payload]:
        asked: list[Payload] = []
        while out := sent(self.engine, self.now):
            for request in out:
                self.now += 0.01
                self.engine.receive(chunk(request, CONTENT), self.now)
            asked += out
        return asked


def test_lost_reads_of_the_usual_size_are_repeated() -> None:
    reads = Reads(None)
    assert ranges(reads.lost) == [(at, 239) for at in range(0, 239 * WINDOW, 239)]
    again = sent(reads.engine, reads.now)
    assert ranges(again) == ranges(reads.lost)[: len(again)]


def test_lost_reads_that_are_too_long_are_split() -> None:
    reads = Reads(100)
    asked = reads.finish()
    assert all(request.size <= 100 for request in asked)
    assert reads.sink.data == CONTENT
    assert len(asked) == len(CONTENT) // 100 + 1
    assert reads.engine.in_flight == 0


def test_a_late_answer_to_a_long_read_changes_nothing() -> None:
    reads = Reads(100)
    sent(reads.engine, reads.now)
    for request in reads.lost:
        reads.engine.receive(chunk(request, CONTENT), reads.now)
    assert reads.engine.stats.unknown == WINDOW
    assert reads.sink.held.empty
    reads.now = lose_all(reads.engine)
    reads.finish()
    assert reads.sink.data == CONTENT


class Writes:
    """The same of writes."""

    def __init__(self, size: int) -> None:
        self.engine = Engine(random.Random(1), Flow(limit=WINDOW))
        self.source = MemorySource(CONTENT)
        self.transfer = WriteTransfer(0, self.source)
        self.transfer.chunks = chunks = Chunks()
        self.engine.start(self.transfer, 0.0)
        self.lost = sent(self.engine, 0.0)
        chunks.size, chunks._again_at = size, 1e9
        self.now = lose_all(self.engine)
        self.file = bytearray(len(CONTENT))

    def write(self, request: Payload) -> None:
        self.now += 0.01
        self.file[request.offset : request.offset + request.size] = request.data
        count = request.size.to_bytes(4, "little")
        self.engine.receive(ack(request, count), self.now)

    def finish(self) -> list[Payload]:
        asked: list[Payload] = []
        while out := sent(self.engine, self.now):
            assert self.engine.in_flight <= WINDOW
            for request in out:
                self.write(request)
            asked += out
        return asked


def test_lost_writes_that_are_too_long_are_split_and_stay_in_order() -> None:
    writes = Writes(100)
    asked = writes.finish()
    assert all(request.size <= 100 for request in asked)
    assert [request.offset for request in asked] == sorted(request.offset for request in asked)
    assert writes.file == CONTENT
    assert writes.source.acked.covers(0, len(CONTENT))
    assert writes.source.in_flight.empty


def test_a_late_ack_of_a_long_write_proves_nothing() -> None:
    writes = Writes(100)
    sent(writes.engine, writes.now)
    for request in writes.lost:
        writes.write(request)
    assert writes.source.acked.empty
    writes.now = lose_all(writes.engine)
    writes.finish()
    assert writes.source.acked.covers(0, len(CONTENT))


def test_what_was_split_goes_back_to_the_source_when_it_ends() -> None:
    writes = Writes(100)
    sent(writes.engine, writes.now)
    writes.transfer.stop()
    assert list(writes.source.dirty) == [(0, len(CONTENT))]
    assert writes.source.in_flight.empty


def test_short_acks_are_of_the_size_that_went_out() -> None:
    """An ACK that counts what a full chunk would have is no answer to a shorter one."""
    writes = Writes(100)
    (first, *_) = sent(writes.engine, writes.now)
    assert first.size == 100
    writes.engine.receive(ack(first, (239).to_bytes(4, "little")), writes.now)
    assert writes.source.acked.empty
    assert first.opcode == Opcode.WRITE_FILE
