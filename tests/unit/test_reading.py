"""Reading wanted ranges of a file, step by step."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.shared.errors import FtpNak, SessionLost
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.model import Traits
from tests.support.replies import ack, burst_nak, chunk, nak, packet, sent
from tests.support.transfers import MemorySink

CONTENT = random.Random(8).randbytes(239 * 40 + 17)
SIZE = len(CONTENT)


class Reader:
    """An engine with one transfer over CONTENT."""

    def __init__(
        self,
        *,
        bursts: bool = False,
        traits: Traits | None = None,
        limit: int = 4,
    ) -> None:
        self.engine = Engine(random.Random(1), Flow(limit=limit))
        self.engine.traits = traits or Traits()
        self.sink = MemorySink(SIZE)
        kind = BurstTransfer if bursts else ReadTransfer
        self.transfer = kind(0, SIZE, self.sink)
        self.engine.start(self.transfer, 0.0)
        self.now = 0.0

    def sent(self) -> list[Payload]:
        return sent(self.engine, self.now)

    def answer(self, request: Payload) -> None:
        self.engine.receive(chunk(request, CONTENT), self.now)

    def finish(self) -> list[Payload]:
        """Answer everything, in order; return what was asked."""
        asked: list[Payload] = []
        while out := self.sent():
            for request in out:
                self.now += 0.01
                self.answer(request)
            asked += out
        return asked

    def pass_quiet(self) -> None:
        deadline = self.engine.next_deadline()
        assert deadline is not None
        self.now = deadline
        self.engine.on_deadline(self.now)


def bursting() -> tuple[Reader, Payload]:
    """Return a reader that reads all of the file in a burst, and its request."""
    reader = Reader(bursts=True)
    reader.transfer.want(0, SIZE, True)
    (request,) = reader.sent()
    return reader, request


def burst_runs(reader: Reader) -> bool:
    assert isinstance(reader.transfer, BurstTransfer)
    return reader.transfer._burst is not None


def ranges(requests: list[Payload]) -> list[tuple[int, int]]:
    return [(request.offset, request.offset + request.size) for request in requests]


# --- wants


def test_nothing_is_asked_beyond_the_end_or_twice() -> None:
    reader = Reader()
    reader.transfer.want(SIZE, SIZE + 100, True)
    assert reader.transfer.idle
    reader.transfer.want(0, 478, True)
    out = reader.sent()
    reader.transfer.want(0, 478, True)
    assert reader.sent() == []
    for request in out:
        reader.answer(request)
    reader.sink.have = ExtentSet()  # the cache dropped it again
    assert reader.sent() == []
    assert reader.transfer.idle


def test_demand_goes_before_readahead_and_promotes_it() -> None:
    reader = Reader(limit=1)
    reader.transfer.want(0, 1000, False)
    reader.transfer.want(700, 900, True)
    reader.transfer.want(600, 950, False)
    assert ranges(reader.finish()) == [(700, 900), (0, 239), (239, 478), (478, 700), (900, 1000)]
    assert reader.sink.repeats == 0


@pytest.mark.parametrize(("demand", "left"), [(True, []), (False, [(0, 100)])])
def test_for_what_was_dropped_on_its_way_no_program_waits(demand: bool, left: list[tuple[int, int]]) -> None:
    reader = Reader(limit=2)
    reader.transfer.want(0, 478, False)
    assert len(reader.sent()) == 2
    reader.transfer.want(0, 100, True)
    reader.transfer.wants.drop(demand=demand)
    assert reader.transfer.demanded is not demand
    reader.transfer.finish()
    assert list(reader.transfer.wants.demand.todo) == left


# --- replies to ReadFile


@pytest.mark.holds("fault chunk size", "rule 14.5")
def test_an_over_long_reply_is_clipped() -> None:
    reader = Reader(limit=1)
    reader.transfer.want(0, 100, True)
    (request,) = reader.sent()
    reader.engine.receive(ack(request, CONTENT[:239]), 0.1)
    assert reader.sink.have == ExtentSet([(0, 100)])
    assert reader.transfer.idle


@pytest.mark.holds("fault growing file")
@pytest.mark.parametrize("eof", [False, True])
def test_where_the_file_ends_early_it_is_to_be_opened_again(eof: bool) -> None:
    """The file may have become shorter, which its new size tells. EOF says nothing about other files."""
    reader = Reader(traits=Traits(ack_carries_own_session=True))
    reader.transfer.want(0, 1000, True)
    request = reader.sent()[0]
    reader.engine.receive(nak(request, NakCode.EOF) if eof else ack(request), 0.1)
    assert isinstance(reader.transfer.error, SessionLost)
    assert not reader.transfer.error.by_server
    assert reader.transfer.wants.demand.todo == ExtentSet([(0, 1000)])
    assert reader.transfer.done


@pytest.mark.holds("fault idle close", "rule 14.9")
@pytest.mark.parametrize("codes", [(4,), (10,), (1,), (8,), (2, 9), (6,)])
def test_a_lost_session_leaves_the_wants(codes: tuple[int, ...]) -> None:
    reader = Reader()
    reader.transfer.want(0, 1000, True)
    out = reader.sent()
    reader.answer(out[0])
    reader.engine.receive(nak(out[1], *codes), 0.1)
    error = reader.transfer.error
    assert isinstance(error, SessionLost)
    assert error.by_server
    assert reader.transfer.wants.demand.todo == ExtentSet([(239, 1000)])


def test_other_refusals_are_the_callers() -> None:
    reader = Reader(limit=1)
    reader.transfer.want(0, 100, True)
    reader.engine.receive(nak(reader.sent()[0], 2, 5), 0.1)
    error = reader.transfer.error
    assert isinstance(error, FtpNak)
    assert error.server_errno == 5
    assert reader.transfer.wants.demand.todo == ExtentSet([(0, 100)])


# --- bursts


def stream(reader: Reader, request: Payload, indices: list[int], *, complete: int | None = None) -> None:
    for index in indices:
        start = request.offset + index * 239
        reader.now += 0.001
        data = CONTENT[start : start + 239]
        reader.engine.receive(packet(request, index, data, complete=int(index == complete)), reader.now)


@pytest.mark.holds("fault burst tail", "rule 14.17")
def test_gaps_are_filled_by_reads_when_the_burst_is_over() -> None:
    reader, request = bursting()
    stream(reader, request, [0, 1, 4, 5, 6, 9])
    assert reader.sent() == []
    reader.engine.receive(burst_nak(request, 10, NakCode.EOF), reader.now)
    out = reader.sent()
    assert {item.opcode for item in out} == {Opcode.READ_FILE}
    assert ranges(out) == [(478, 717), (717, 956), (1673, 1912), (1912, 2151)]
    for item in out:
        reader.answer(item)
    (again,) = reader.sent()
    assert (again.opcode, again.offset) == (Opcode.BURST_READ_FILE, 2390)
    assert again.seq - request.seq > 4096
    stream(reader, again, list(range(31)))
    assert bytes(reader.sink.data) == CONTENT


def test_a_gap_that_comes_short_begins_no_burst() -> None:
    reader, request = bursting()
    stream(reader, request, [0, *range(2, 41)])
    (gap,) = reader.sent()
    assert reader.sent() == []
    reader.engine.receive(ack(gap, CONTENT[239:339]), reader.now)
    (rest,) = reader.sent()
    assert (rest.opcode, *ranges([rest])) == (Opcode.READ_FILE, (339, 478))
    assert reader.sink.repeats == 0


@pytest.mark.holds("fault burst tail", "rule 14.16")
def test_a_burst_that_goes_quiet_is_over_but_not_early() -> None:
    reader, request = bursting()
    stream(reader, request, [0, 1, 2])
    heard = reader.now
    while burst_runs(reader):
        assert reader.sent() == []
        reader.pass_quiet()
    assert reader.now == pytest.approx(heard + 1.0)
    (again,) = reader.sent()
    assert again.offset == 717


@pytest.mark.holds("fault burst end")
def test_the_flag_and_a_short_quiet_end_it() -> None:
    reader = Reader(bursts=True)
    reader.engine._timers.bulk.sample(0.05)
    reader.transfer.want(0, SIZE, True)
    (request,) = reader.sent()
    stream(reader, request, [0, 1, 2], complete=2)
    assert burst_runs(reader)
    reader.pass_quiet()
    assert not burst_runs(reader)
    assert reader.now < 0.3


@pytest.mark.holds("rule 14.17")
def test_a_burst_waits_for_reads_and_reads_for_the_burst() -> None:
    reader = Reader(bursts=True)
    assert isinstance(reader.transfer, BurstTransfer)
    reader.transfer.by_requests = True
    reader.transfer.want(0, SIZE, True)
    out = reader.sent()
    reader.transfer.by_requests = False
    for item in out[:-1]:
        reader.answer(item)
        assert reader.sent() == []
    reader.answer(out[-1])
    (burst,) = reader.sent()
    assert (burst.opcode, burst.offset) == (Opcode.BURST_READ_FILE, 956)
    reader.transfer.by_requests = True
    assert reader.sent() == []
    reader.engine.receive(burst_nak(burst, 0, NakCode.EOF), 0.2)
    assert {item.opcode for item in reader.sent()} == {Opcode.READ_FILE}


@pytest.mark.parametrize("code", [1, 2, 3, 6, 7])
def test_a_refused_burst_gives_way_to_reads(code: int) -> None:
    reader, request = bursting()
    reader.engine.receive(burst_nak(request, 0, code), 0.1)
    reader.finish()
    assert bytes(reader.sink.data) == CONTENT


@pytest.mark.parametrize("code", [4, 10])
def test_a_burst_without_session(code: int) -> None:
    reader = Reader(bursts=True)
    reader.transfer.want(0, SIZE, True)
    reader.engine.receive(burst_nak(reader.sent()[0], 0, code), 0.1)
    assert isinstance(reader.transfer.error, SessionLost)
    assert reader.transfer.wants.demand.todo == ExtentSet([(0, SIZE)])
    assert not burst_runs(reader)
