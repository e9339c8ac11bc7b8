"""Bytes of a transfer are to be done, on their way or done, whatever is lost, late or answered in part."""

from __future__ import annotations

import random
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.reading import ReadTransfer, Wants
from mavftpfs.protocol.writing import Pieces, WriteTransfer
from mavftpfs.shared.errors import MavftpfsError
from tests.support.replies import ack, chunk, nak, sent
from tests.support.transfers import MemorySink, MemorySource

END = 40
OFFSETS = st.integers(0, END)


class Model:
    """The expected state of each byte in `Wants`: whether a request is out, and whether a program waits."""

    def __init__(self) -> None:
        self.wanted: dict[int, tuple[bool, bool]] = {}  # (out, demand)

    def add(self, start: int, stop: int, demand: bool) -> None:
        for byte in range(start, stop):
            out, demanded = self.wanted.get(byte, (False, False))
            self.wanted[byte] = out, demanded or demand

    def take(self, start: int, stop: int) -> None:
        for byte in range(start, stop):
            assert not self.wanted[byte][0], "asked for while it is on its way"
            self.wanted[byte] = True, self.wanted[byte][1]

    def done(self, start: int, stop: int) -> None:
        for byte in range(start, stop):
            self.wanted.pop(byte, None)

    def lost(self, start: int, stop: int) -> None:
        for byte in range(start, stop):
            if byte in self.wanted:
                self.wanted[byte] = False, self.wanted[byte][1]

    def drop(self, demand: bool) -> None:
        for byte, (out, demanded) in list(self.wanted.items()):
            if out:
                self.wanted[byte] = out, demanded and not demand
            elif demand or not demanded:
                del self.wanted[byte]

    def check(self, wants: Wants) -> None:
        for out, demand in product((False, True), repeat=2):
            found = wants.demand if demand else wants.ahead
            bytes_ = {byte for part in (found.out if out else found.todo) for byte in range(*part)}
            assert bytes_ == {byte for byte, state in self.wanted.items() if state == (out, demand)}


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(["add", "take", "done", "lost", "drop"]), OFFSETS, OFFSETS, st.booleans()),
        max_size=40,
    )
)
def test_what_is_lost_is_wanted_again_and_what_came_is_not(steps: list[tuple[str, int, int, bool]]) -> None:
    wants, model = Wants(), Model()
    rows: list[tuple[int, int]] = []
    for step, start, stop, flag in steps:
        match step:
            case "add":
                wants.add([(start, stop)], demand=flag)
                model.add(start, stop, flag)
            case "take":
                row = wants.take(max(1, start), stop)
                if row is not None:
                    assert row[0] < row[1] <= min(row[0] + max(1, start), stop)
                    model.take(*row)
                    rows.append(row)
            case "done" | "lost" if rows:
                row = rows[start % len(rows)]
                if step == "done":
                    wants.on_done(*row)
                    model.done(*row)
                else:
                    wants.on_lost(*row)
                    model.lost(*row)
            case "drop":
                wants.drop(demand=flag)
                model.drop(flag)
        model.check(wants)
        assert wants.idle == (not model.wanted)
    wants.give_back()
    model.lost(0, END)
    model.check(wants)


# --- a transfer and replies in any order, in part, twice, late or never

CONTENT = random.Random(5).randbytes(239 * 12 + 11)
REPLIES = st.lists(
    st.tuples(
        st.integers(0, 30),
        st.sampled_from(["right"] * 4 + ["again", "in part", "nothing", "refused", "lost"]),
        st.sampled_from([0.0, 0.01, 0.1, 1.5]),
    ),
    max_size=60,
)


def answer(request: Payload, kind: str, content: bytes) -> Payload:
    """Return an answer to a read or a write."""
    if request.opcode == Opcode.LIST_DIRECTORY:
        return nak(request, NakCode.EOF)
    if kind == "refused":
        return nak(request, NakCode.FILE_PROTECTED)
    share = {"in part": 0.4, "nothing": 0.0}.get(kind, 1.0)
    if request.opcode == Opcode.READ_FILE:
        right = chunk(request, content)
        return ack(request, right.data[: int(share * len(right.data))])
    return ack(request, int(share * request.size).to_bytes(4, "little"))


class Exchange:
    """An engine with one transfer, whose requests are answered in an order that the test chooses."""

    def __init__(self, transfer: ReadTransfer | WriteTransfer) -> None:
        self.engine = Engine(random.Random(1), Flow(limit=6))
        self.transfer = transfer
        self.engine.start(transfer, 0.0)
        self.now = 0.0
        self.out: list[Payload] = []
        self.card: dict[int, int] = {}

    def send(self) -> None:
        for request in sent(self.engine, self.now):
            self.out.append(request)
            if request.opcode == Opcode.WRITE_FILE:
                self.card |= dict(enumerate(request.data, request.offset))

    def run(self, replies: list[tuple[int, str, float]]) -> None:
        """Answer as chosen, and then everything in order."""
        for which, kind, pause in replies:
            self.send()
            self.now += pause
            self.engine.on_deadline(self.now)
            if self.out:
                request = self.out[which % len(self.out)]
                if kind != "again":
                    self.out.remove(request)
                if kind != "lost":
                    self.engine.receive(answer(request, kind, CONTENT), self.now)
        while not (self.transfer.done or self.transfer.idle):
            self.send()
            self.now += 0.05
            for request in self.out:
                self.engine.receive(answer(request, "right", CONTENT), self.now)
            self.out.clear()
            self.engine.on_deadline(self.now)
            assert self.now < 1000.0


@pytest.mark.holds("fault lost", "fault duplicate")
@settings(max_examples=200, deadline=None)
@given(REPLIES)
def test_all_of_an_upload_is_acked_in_the_end_and_each_byte_is_in_one_state(
    replies: list[tuple[int, str, float]],
) -> None:
    source = MemorySource(CONTENT)  # which checks that
    exchange = Exchange(WriteTransfer(0, source, root=b"/fs/"))
    exchange.run(replies)
    assert source.ranges.out.empty
    if exchange.transfer.error is None:
        assert source.acked.covers(0, len(CONTENT))
        assert bytes(exchange.card[byte] for byte in range(len(CONTENT))) == CONTENT
    else:
        assert isinstance(exchange.transfer.error, MavftpfsError)
        assert source.todo.total + source.acked.total == len(CONTENT)


@settings(max_examples=100, deadline=None)
@given(REPLIES.map(lambda replies: [one for one in replies if one[1] != "refused"]))
def test_pieces_go_out_one_by_one_and_in_order(replies: list[tuple[int, str, float]]) -> None:
    source = Pieces([CONTENT[at : at + 70] for at in range(0, len(CONTENT), 70)])
    exchange = Exchange(WriteTransfer(0, source, in_flight=1))
    exchange.run(replies)
    if exchange.transfer.error is None:
        assert source.ranges.empty
        assert bytes(exchange.card[byte] for byte in range(len(CONTENT))) == CONTENT


@pytest.mark.holds("promise 1", "fault lost", "fault duplicate")
@settings(max_examples=200, deadline=None)
@given(REPLIES.map(lambda replies: [one for one in replies if one[1] not in ("refused", "nothing")]))
def test_all_that_is_read_is_right(replies: list[tuple[int, str, float]]) -> None:
    sink = MemorySink(len(CONTENT))
    transfer = ReadTransfer(0, len(CONTENT), sink)
    exchange = Exchange(transfer)
    transfer.want(500, 1700, True)
    transfer.want(0, len(CONTENT), False)
    exchange.run(replies)
    for start, stop in sink.have:
        assert bytes(sink.data[start:stop]) == CONTENT[start:stop]
    if transfer.error is None:
        assert sink.have.covers(0, len(CONTENT))
    else:
        assert transfer.wants.demand.todo.total + transfer.wants.ahead.todo.total + sink.have.total == len(
            CONTENT
        )
