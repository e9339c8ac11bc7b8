"""The engine, step by step: hand-driven time, replies written by hand."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import ListDirectory, Simple
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.shared.errors import FtpNak, RequestTimeout
from mavftpfs.shared.model import Traits
from tests.support.replies import ack, chunk, nak, packet, sent
from tests.support.transfers import MemorySink

SIZE = 239 * 40


class StuckRandom(random.Random):
    """Starts every counter at a given number."""

    def __init__(self, first: int) -> None:
        super().__init__(0)
        self.first = first

    def randrange(self, *args: int, **kwargs: int) -> int:  # type: ignore[override]
        return args[0] if len(args) > 1 else self.first


def make(first_seq: int = 1000, *, limit: int | None = None) -> Engine:
    return Engine(StuckRandom(first_seq), Flow(limit=limit))


def reading(
    engine: Engine, size: int = SIZE, kind: type[ReadTransfer] = ReadTransfer
) -> tuple[ReadTransfer, MemorySink]:
    sink = MemorySink(size)
    transfer = kind(0, size, sink)
    engine.start(transfer, 0.0)
    transfer.want(0, size, True)
    return transfer, sink


def mkdir(session: int | None = None) -> Simple:
    return Simple(Opcode.CREATE_DIRECTORY, b"/d", session=session)


def asked(engine: Engine) -> tuple[Simple, Payload]:
    """Return an operation and the request that went out for it."""
    op = mkdir()
    engine.start(op, 0.0)
    (request,) = sent(engine, 0.0)
    return op, request


# --- sequence numbers


@pytest.mark.holds("fault replay", "rule 14.1")
def test_starts_at_a_random_seq_and_counts_on_for_life() -> None:
    seqs = set()
    for seed in range(20):
        engine = Engine(random.Random(seed), Flow())
        engine.start(mkdir(), 0.0)
        seqs.add(sent(engine, 0.0)[0].seq)
    assert len(seqs) == 20
    engine = make(7)
    for expected in (7, 8, 9):
        engine.start(mkdir(), 0.0)
        assert sent(engine, 0.0)[0].seq == expected


@pytest.mark.holds("fault replay", "rule 14.4")
def test_neither_65535_nor_what_is_still_out_is_used() -> None:
    engine = make(1)
    _, out = asked(engine)
    engine._ledger._seq = 65533
    seqs = []
    for _ in range(4):
        _, request = asked(engine)
        engine.receive(ack(request), 0.1)
        seqs.append(request.seq)
    assert out.seq == 1
    assert seqs == [65533, 65534, 0, 2]


@pytest.mark.holds("rule 14.3")
def test_the_rest_of_an_abandoned_burst_does_not_repeat_a_side_effect() -> None:
    """A server that sends the whole file, whatever is asked meanwhile (MAVSDK before 2022). Timers stand."""
    engine = make(10)
    transfer, _ = reading(engine, 239 * 20_000, BurstTransfer)
    (burst,) = sent(engine, 0.0)
    engine.receive(packet(burst, 0, bytes(239)), 0.0)
    engine.remove(transfer)
    op, request = asked(engine)
    for index in range(1, 20_000):
        now = 0.0002 * index
        engine.receive(packet(burst, index, bytes(239)), now)
        engine.on_deadline(now)
        assert sent(engine, now) == []
    engine.receive(ack(request), 4.0)
    assert op.done


# --- what is believed


@pytest.mark.holds("promise 1", "rule 14.2")
@pytest.mark.parametrize(
    "change",
    [
        {"seq": 1003},
        {"seq": 999},
        {"offset": 1},
        {"session": 9},
        {"opcode": 5},
        {"req_opcode": Opcode.BURST_READ_FILE},
        {"req_opcode": Opcode.LIST_DIRECTORY},
    ],
)
def test_a_reply_that_does_not_fit_changes_nothing(change: dict[str, int]) -> None:
    engine = make(limit=1)
    engine.learn_session_echo(True)
    transfer, sink = reading(engine)
    (request,) = sent(engine, 0.0)
    engine.receive(chunk(request, bytes(SIZE))._replace(**change), 0.1)  # type: ignore[arg-type]
    assert sink.have.empty
    assert not transfer.done
    assert engine.in_flight == 1


def test_a_short_queue_is_forgotten_with_its_server() -> None:
    engine = make()
    engine.learn_session_echo(True)
    assert engine.flow.cap == 4
    engine.forget_server()
    assert engine.flow.cap > 4
    assert engine.traits == Traits()


@pytest.mark.holds("fault replay", "rule 14.4")
@pytest.mark.parametrize("opcode", [Opcode.CREATE_DIRECTORY, Opcode.LIST_DIRECTORY])
def test_after_a_stale_replay_a_new_seq_is_tried_once_an_answer_is_due(opcode: int) -> None:
    """A server might execute a request that changes it once for each new seq."""
    engine = make()
    op = Simple(opcode, b"/d")
    engine.start(op, 0.0)
    (request,) = sent(engine, 0.0)
    seqs = [request.seq]
    for _ in range(4):
        for _ in range(5):
            engine.receive(nak(request, NakCode.EOF)._replace(req_opcode=Opcode.BURST_READ_FILE), 0.1)
        due = engine.next_deadline()
        assert due is not None
        now = due
        assert sent(engine, now) == []
        engine.on_deadline(now)
        (request,) = sent(engine, now)
        seqs.append(request.seq)
    assert len(seqs) == len(set(seqs)) == 5
    assert not op.done
    engine.receive(ack(request), now)
    assert op.done
    assert op.retransmitted


# --- sessions of session-agnostic requests


@pytest.mark.holds("rule 14.8")
def test_requests_carry_the_engines_session_and_are_repeated_when_it_changed() -> None:
    engine = make()
    engine.session = 5
    op, request = asked(engine)
    assert request.session == 5
    engine.session = 6
    engine.receive(nak(request, NakCode.INVALID_SESSION), 0.1)
    (again,) = sent(engine, 0.1)
    assert again.session == 6
    assert again.seq != request.seq
    engine.receive(nak(again, NakCode.INVALID_SESSION), 0.2)
    assert isinstance(op.error, FtpNak)
    assert op.error.code == NakCode.INVALID_SESSION


def test_a_session_that_changes_all_the_time_ends_somewhere() -> None:
    engine = make()
    op = mkdir()
    engine.start(op, 0.0)
    now = 0.0
    while not op.done:
        (out,) = sent(engine, now)
        engine.session = engine.session % 255 + 1
        now += 1.0
        engine.receive(nak(out, NakCode.INVALID_SESSION), now)
        engine.on_deadline(now)
    assert isinstance(op.error, RequestTimeout)
    assert now == 30.0


# --- retransmission


@pytest.mark.holds("fault lost")
def test_a_side_effect_goes_out_again_under_the_same_seq_with_growing_waits() -> None:
    engine = make()
    op, request = asked(engine)
    now, times = 0.0, []
    while not op.done:
        deadline = engine.next_deadline()
        assert deadline is not None
        assert deadline > now
        now = deadline
        engine.on_deadline(now)
        for again in sent(engine, now):
            assert again == request
            times.append(now)
    assert isinstance(op.error, RequestTimeout)
    assert op.sent
    assert now == pytest.approx(30.0)
    assert times[:4] == pytest.approx([1.0, 2.0, 4.0, 7.0])
    assert len(times) <= 12
    engine.on_deadline(40.0)  # the last transmission is a ghost for a while
    assert engine.next_deadline() is None


@pytest.mark.holds("fault duplicate")
def test_reads_go_out_again_under_new_seqs_and_old_answers_still_count() -> None:
    engine = make(limit=1)
    transfer, sink = reading(engine, 100)
    (first,) = sent(engine, 0.0)
    engine.on_deadline(1.0)
    (second,) = sent(engine, 1.0)
    assert second.seq != first.seq
    assert (second.offset, second.size) == (first.offset, first.size)
    engine.receive(chunk(first, b"a" * 100), 1.1)
    assert bytes(sink.data) == b"a" * 100
    engine.receive(chunk(second, b"b" * 100), 1.2)
    assert bytes(sink.data) == b"a" * 100
    assert transfer.idle
    assert engine.rtt == pytest.approx(1.1 - 0.9 / 8)


def test_later_answers_prove_a_loss_a_moment_after_a_round_trip() -> None:
    engine = make(limit=8)
    _, sink = reading(engine)
    engine.flow.window = 8
    out = sent(engine, 0.0)
    assert len(out) == 8
    engine.receive(chunk(out[1], bytes(SIZE)), 0.1)
    instead = sent(engine, 0.1)
    assert len(instead) == 2  # one for the answered request, one for the passed one
    assert out[0].offset not in [request.offset for request in instead]
    assert engine.next_deadline() == pytest.approx(0.1125)
    engine.receive(chunk(out[2], bytes(SIZE)), 0.11)
    engine.on_deadline(0.1238)
    again = sent(engine, 0.1238)
    assert again[0].offset == out[0].offset
    assert again[0].seq != out[0].seq
    assert engine.stats.lost == 1
    assert not sink.have.covers(0, 1)


def test_a_repetition_makes_room_when_the_first_request_is_answered_late() -> None:
    """After a pause of 0.2 s repetitions that the card's buffer had lost kept the window full for 0.4 s."""
    engine = make(limit=2)
    reading(engine)
    out = sent(engine, 0.0)
    engine.on_deadline(1.0)
    assert [request.offset for request in sent(engine, 1.0)] == [request.offset for request in out]
    engine.receive(chunk(out[0], bytes(SIZE)), 1.1)
    engine.receive(chunk(out[1], bytes(SIZE)), 1.1)
    assert [request.offset for request in sent(engine, 1.1)] == [478, 717]


def test_what_was_lost_often_does_not_wait_for_its_timer() -> None:
    """A card that pauses half of the time loses every second write: the last ones went out every 5 s."""
    engine = make(limit=8)
    reading(engine, 239 * 1000)
    now, tries = 0.0, []
    while now < 1.5:
        for request in sent(engine, now):
            if request.offset == 0:
                tries.append(now)
            else:
                engine.receive(ack(request, bytes(request.size)), now)
        now += 0.1
        engine.on_deadline(now)
    assert len(tries) >= 14


@pytest.mark.holds("fault duplicate")
@pytest.mark.parametrize("late", [0.115, 0.3])
def test_a_late_answer_to_a_lost_request_counts_and_the_next_ones_are_waited_for(late: float) -> None:
    unexplained: list[Payload] = []
    engine = make(limit=2)
    engine.on_unexplained = lambda reply, lateness: unexplained.append(reply)
    transfer, sink = reading(engine, 478)
    first, second = sent(engine, 0.0)
    engine.receive(chunk(second, b"b" * 478), 0.1)
    engine.on_deadline(0.114)
    (again,) = sent(engine, 0.114)
    assert (again.offset, again.seq != first.seq) == (0, True)
    engine.receive(chunk(first, b"a" * 478), late)
    assert sink.have.covers(0, 478)
    assert transfer.idle
    assert engine._timers.reordering.share(late) == 0.25
    engine.receive(chunk(again, b"c" * 478), late)
    assert not unexplained


def test_slow_progress_is_progress() -> None:
    engine = make(limit=1)
    op = ListDirectory(b"/")
    engine.start(op, 0.0)
    for page in range(8):
        now = 20.0 * page
        (request,) = sent(engine, now)
        engine.receive(ack(request, b"F%d\0" % page), now + 20.0)
        engine.on_deadline(now + 20.0)
    sent(engine, 160.0)
    assert not op.done
    engine.on_deadline(189.0)
    assert not op.done
    engine.on_deadline(190.0)
    assert isinstance(op.error, RequestTimeout)


def test_who_begins_to_want_something_while_nothing_may_go_out_does_not_wait_for_ever() -> None:
    engine = make()
    transfer = ReadTransfer(0, SIZE, MemorySink(SIZE))
    engine.start(transfer, 0.0)
    engine.hold(0.0)
    assert engine.next_deadline() is None
    transfer.want(0, SIZE, True)
    engine.hold(100.0)
    assert engine.next_deadline() == 130.0
    engine.on_deadline(130.0)
    assert isinstance(transfer.error, RequestTimeout)


@pytest.mark.holds("promise 4")
@pytest.mark.parametrize("bwlimit", [100.0, 300.0, 5000.0])
def test_a_low_limit_does_not_hide_that_the_vehicle_is_silent(bwlimit: float) -> None:
    engine = Engine(StuckRandom(1), Flow(bwlimit=bwlimit))
    transfer, _ = reading(engine)
    now = 0.0
    while not transfer.done:
        sent(engine, now)
        due = engine.next_deadline()
        assert due is not None
        now = max(now + 1e-3, due)
        engine.on_deadline(now)
    assert isinstance(transfer.error, RequestTimeout)
    assert now == pytest.approx(30.0)


def test_who_waits_for_one_answer_is_not_woken_before_its_timer() -> None:
    """With room for more requests than the bucket ever holds, the engine was once woken every few us."""
    engine = make()
    engine.flow._bucket.rate = 1e8
    asked(engine)
    for now in (0.0, 0.1, 0.9):
        assert sent(engine, now) == []
        assert engine.next_deadline() == pytest.approx(1.0)


# --- window and priority


@pytest.mark.holds("promise 7")
def test_metadata_goes_first_and_has_a_slot_of_its_own() -> None:
    engine = make(limit=4)
    reading(engine)
    assert len(sent(engine, 0.0)) == 4
    engine.start(mkdir(), 0.0)
    engine.start(mkdir(), 0.0)
    assert [request.opcode for request in sent(engine, 0.0)] == [Opcode.CREATE_DIRECTORY]
    assert engine.in_flight == 5


def test_cancelled_requests_keep_their_place_until_they_are_answered() -> None:
    engine = make(limit=4)
    transfer, sink = reading(engine)
    out = sent(engine, 0.0)
    engine.remove(transfer)
    engine.remove(transfer)
    other, _ = reading(engine)
    assert sent(engine, 0.0) == []
    engine.receive(chunk(out[0], bytes(SIZE)), 0.1)
    assert sink.have.empty
    assert len(sent(engine, 0.1)) == 1
    engine.on_deadline(1.2)
    assert len(sent(engine, 1.2)) >= 1
    engine.remove(other)
    engine.on_deadline(50.0)
    assert engine.in_flight == 0
    assert engine.next_deadline() is None


# --- pauses of the server


@pytest.mark.parametrize(("others", "patient"), [(8, True), (2, False)])
def test_silence_proves_nothing_while_the_server_pauses_but_a_lone_requests_does(
    others: int, patient: bool
) -> None:
    """The server would execute a request that waits in its buffer twice."""
    engine = make(limit=1 + others)
    reading(engine)
    first = sent(engine, 0.0)
    for request in first:
        engine.receive(chunk(request, bytes(SIZE)), 0.05)
    engine.flow.window = 1 + others
    engine.flow.path.pauses.length = 0.3
    waiting = sent(engine, 0.05)
    assert len(waiting) == 1 + others
    engine.receive(chunk(waiting[0], bytes(SIZE)), 0.1)
    engine.flow.path.pauses.length = 0.3
    sent(engine, 0.1)
    engine.on_deadline(0.35)
    assert (engine.stats.lost == 0) is patient
    engine.on_deadline(0.45)
    assert engine.stats.lost
