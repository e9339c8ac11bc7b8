"""Writes and requests with a path take turns where paths block writes: hand-driven time."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.pathgate import LEAST
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.shared.errors import FtpNak
from tests.support.replies import ack, nak, sent
from tests.support.transfers import MemorySource

pytestmark = pytest.mark.holds("rule 14.24")

CHUNK = 239
FULL = CHUNK.to_bytes(4, "little")
ROOT = b"/fs/microsd/"


class Card:
    """An engine with an upload, of which two requests are on their way at once, on such a server."""

    def __init__(self, *, known: bool = True, chunk: int = CHUNK) -> None:
        self.engine = Engine(random.Random(3), Flow(limit=2))
        self.engine.traits.paths_block_writes = known
        self.transfer = WriteTransfer(0, MemorySource(bytes(CHUNK * 100)), ChunkSize(chunk), root=ROOT)
        self.engine.start(self.transfer, 0.0)

    def ask(self, opcode: Opcode, now: float) -> Simple:
        operation = Simple(opcode, b"/etc")
        self.engine.start(operation, now)
        return operation

    def sends(self, now: float) -> list[Opcode]:
        """Return what goes out now; nothing of it is answered yet."""
        self.out = sent(self.engine, now)
        return [Opcode(request.opcode) for request in self.out]

    def answer(self, now: float, requests: list[Payload] | None = None) -> list[Opcode]:
        """ACK what went out last, and return what goes out then."""
        for request in self.out if requests is None else requests:
            data = FULL if request.opcode == Opcode.WRITE_FILE else b""
            self.engine.receive(ack(request, data), now)
        return self.sends(now)


def test_a_path_waits_for_the_writes_on_their_way_and_the_next_writes_for_a_listing_of_the_root() -> None:
    card = Card()
    writes = [Opcode.WRITE_FILE] * 2
    assert card.sends(0.0) == writes
    card.ask(Opcode.CREATE_DIRECTORY, 0.1)
    assert card.answer(0.1) == writes, "a turn lasts for a while"
    on_their_way = card.out
    assert card.sends(LEAST) == []
    assert card.answer(LEAST + 0.1, on_their_way) == [Opcode.CREATE_DIRECTORY]
    path = card.out
    assert card.sends(LEAST + 0.2) == [], "nothing beside it"
    assert card.answer(LEAST + 0.3, path) == [Opcode.LIST_DIRECTORY]
    assert card.out[0].data == ROOT
    assert card.answer(LEAST + 0.4) == writes


def test_a_turn_begins_when_the_other_kind_is_answered() -> None:
    card = Card()
    card.sends(0.0)
    writes = card.out
    card.ask(Opcode.RENAME, 0.0)
    for now in (1.1, 2.2):
        assert card.sends(now * LEAST) == [], "the writes are still on their way"
    assert card.answer(2.3 * LEAST, writes) == [Opcode.RENAME]


def test_a_checksum_and_a_terminate_wait_for_nothing() -> None:
    card = Card()
    card.sends(0.0)
    card.ask(Opcode.CALC_FILE_CRC32, 0.0)
    card.ask(Opcode.TERMINATE_SESSION, 0.0)
    assert card.sends(0.0) == [Opcode.CALC_FILE_CRC32]


def test_one_path_after_another_leaves_the_writes_their_turn() -> None:
    card = Card()
    now, seen = 0.0, {Opcode.WRITE_FILE: 0, Opcode.RENAME: 0}
    card.ask(Opcode.RENAME, now)
    card.sends(now)
    for _ in range(200):
        now += 0.05
        for opcode in card.answer(now):
            if opcode in seen:
                seen[opcode] += 1
            if opcode == Opcode.RENAME:
                card.ask(Opcode.RENAME, now)
    assert seen[Opcode.WRITE_FILE] > 50
    assert seen[Opcode.RENAME] > 25


def test_waiting_for_its_turn_is_no_silence() -> None:
    card = Card()
    card.sends(0.0)
    path = card.ask(Opcode.RENAME, 0.0)
    now = 0.0
    while now < LEAST:
        card.answer(now)
        now += 0.01
    assert path.progress_at >= LEAST - 0.02


def test_a_refused_write_is_sent_again_behind_a_listing_of_the_root() -> None:
    card = Card(known=False)
    card.sends(0.0)
    for now in (1.0, 2.0):
        first, second = card.out
        card.engine.receive(nak(first, NakCode.FILE_PROTECTED), now)
        assert card.engine.traits.paths_block_writes
        assert card.sends(now) == [], "the other one is not answered yet"
        card.engine.receive(nak(second, NakCode.FILE_PROTECTED), now)
        assert card.sends(now) == [Opcode.LIST_DIRECTORY]
        assert Opcode.WRITE_FILE in card.answer(now + 0.1)
        assert {request.offset for request in card.out} == {first.offset, second.offset}
        card.answer(now + 0.2)
    for now in (3.0, 4.0, 5.0):
        for request in card.out:
            card.engine.receive(nak(request, NakCode.FILE_PROTECTED), now)
        assert card.sends(now) == [Opcode.LIST_DIRECTORY]
        card.answer(now + 0.1)
    card.engine.receive(nak(card.out[0], NakCode.FILE_PROTECTED), 6.0)
    assert isinstance(card.transfer.error, FtpNak), "listings do not help"


def test_a_listing_of_the_root_that_is_answered_late_does_not_hide_a_path() -> None:
    """The two answers arrive together, and the turn of paths is over at that moment."""
    card = Card(known=False)
    card.sends(0.0)
    for request in card.out:
        card.engine.receive(nak(request, NakCode.FILE_PROTECTED), 0.01)
    assert card.sends(0.01) == [Opcode.LIST_DIRECTORY]
    (listing,) = card.out
    card.ask(Opcode.RENAME, 0.02)
    due = card.engine.next_deadline()
    assert due is not None
    due = max(due, 2 * LEAST)
    card.engine.on_deadline(due)
    assert card.sends(due) == [Opcode.RENAME]
    (path,) = card.out
    for request in (listing, path):
        card.engine.receive(ack(request), 4 * LEAST)
    assert card.sends(4 * LEAST) == [Opcode.LIST_DIRECTORY]


def test_a_lost_listing_of_the_root_goes_out_again() -> None:
    card = Card(known=False, chunk=1)
    card.sends(0.0)
    for request in card.out:
        card.engine.receive(nak(request, NakCode.FILE_PROTECTED), 0.1)
    assert card.sends(0.1) == [Opcode.LIST_DIRECTORY]
    due = card.engine.next_deadline()
    assert due is not None
    card.engine.on_deadline(due)
    assert card.sends(due) == [Opcode.LIST_DIRECTORY]


def test_a_lost_write_goes_out_again_behind_a_listing_of_the_root() -> None:
    """Otherwise PX4 refuses it, and a second refusal without an ACK between them would end the upload."""
    card = Card(known=False)
    card.sends(0.0)
    for request in card.out:
        card.engine.receive(nak(request, NakCode.FILE_PROTECTED), 0.01)
    card.sends(0.01)
    assert card.answer(0.02) == [Opcode.WRITE_FILE] * 2
    card.ask(Opcode.RENAME, 0.02)
    went_out: list[Opcode] = []
    for now in range(1, 6):
        card.engine.on_deadline(now)
        went_out += card.sends(now)
        if went_out[-1:] == [Opcode.RENAME]:
            card.engine.receive(ack(card.out[0]), now)
    assert went_out[:2] == [Opcode.RENAME, Opcode.LIST_DIRECTORY]
    assert Opcode.WRITE_FILE in card.answer(6.0)


def test_nothing_goes_out_behind_an_exclusive_request() -> None:
    engine = Engine(random.Random(3), Flow(limit=4))
    engine.start(Simple(Opcode.READ_FILE, session=1), 0.0)
    (read,) = sent(engine, 0.0)
    engine.start(Simple(Opcode.RENAME, b"/fs/a", exclusive=True), 0.1)
    engine.start(Simple(Opcode.READ_FILE, session=1), 0.1)
    (rename,) = sent(engine, 0.1)
    assert rename.opcode == Opcode.RENAME
    engine.receive(ack(read), 0.2)
    assert sent(engine, 0.2) == []
    engine.receive(ack(rename), 0.3)
    assert [request.opcode for request in sent(engine, 0.3)] == [Opcode.READ_FILE]


def test_after_a_restart_nothing_waits() -> None:
    card = Card()
    card.sends(0.0)
    card.engine.remove(card.transfer)
    card.engine.forget_server()
    card.ask(Opcode.RENAME, 0.1)
    assert card.sends(0.1) == [Opcode.RENAME]
