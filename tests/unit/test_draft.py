"""Drafts against a plain model: content, who has a byte, and what is still to be sent."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from mavftpfs.cache.draft import Draft, Where
from mavftpfs.cache.sending import AHEAD, Sending
from mavftpfs.protocol.crc import crc32
from mavftpfs.shared.errors import SpoolFailed


class Bytes:
    """A Content in a bytearray; bytes that were never put, or were cut, are poison."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, offset: int, data: bytes | memoryview) -> None:
        self.data.extend(b"\xee" * (offset + len(data) - len(self.data)))
        self.data[offset : offset + len(data)] = data

    def get(self, start: int, stop: int) -> bytes:
        return bytes(self.data[start:stop])

    def cut(self, size: int) -> None:
        self.data[size:] = b"\xee" * max(0, len(self.data) - size)

    def settle(self) -> None:
        pass


def draft_over(base: bytes | None) -> Draft:
    return Draft(Bytes(), None if base is None else len(base))


def content(draft: Draft, base: bytes) -> bytes:
    parts = []
    for where, start, stop in draft.segments(0, draft.size):
        parts.append(base[start:stop] if where is Where.BASE else draft.local_bytes(start, stop))
    return b"".join(parts)


def sent(sending: Sending, limit: int = 7) -> list[tuple[int, bytes]]:
    chunks = []
    while (chunk := sending.next_chunk(limit)) is not None:
        chunks.append(chunk)
    return chunks


def test_a_new_file_is_dirty_even_if_empty() -> None:
    draft = draft_over(None)
    assert not draft.clean
    assert draft.fresh
    assert draft.whole
    draft.delivered()
    assert draft.clean


def test_a_cut_that_fails_changes_nothing() -> None:
    class Failing(Bytes):
        def cut(self, size: int) -> None:
            raise SpoolFailed("bad sector")

    draft = Draft(Failing(), None)
    draft.write(0, b"abcdef")
    with pytest.raises(SpoolFailed):
        draft.truncate(2)
    assert content(draft, b"") == b"abcdef"
    assert sent(draft.begin(whole=True)) == [(0, b"abcdef")]


def test_a_gap_beyond_the_end_is_zeros_and_is_sent() -> None:
    draft = draft_over(None)
    draft.write(5, b"x")
    assert draft.local_bytes(0, 6) == b"\0\0\0\0\0x"
    assert sent(draft.begin(whole=True)) == [(0, b"\0\0\0\0\0x")]


def test_a_hole_of_the_base_is_never_zeros() -> None:
    draft = draft_over(b"abcdef")
    draft.write(2, b"X")
    assert draft.segments(0, 9) == [(Where.BASE, 0, 2), (Where.HELD, 2, 3), (Where.BASE, 3, 6)]
    assert not draft.whole
    assert sent(draft.begin(whole=False)) == [(2, b"X")]


def test_what_was_cut_off_the_base_does_not_come_back() -> None:
    draft = draft_over(b"abcdef")
    draft.truncate(2)
    draft.truncate(5)
    assert content(draft, b"abcdef") == b"ab\0\0\0"
    draft.truncate(0)
    draft.write(1, b"z")
    assert draft.fresh
    assert content(draft, b"abcdef") == b"\0z"


def test_filling_never_overwrites_what_is_newer() -> None:
    draft = draft_over(b"abcdef")
    draft.write(2, b"X")
    draft.truncate(5)
    draft.fill(0, b"abcdef")
    assert draft.whole
    assert draft.local_bytes(0, 5) == b"abXde"
    assert draft.crc32() == crc32(b"abXde")


def test_a_byte_written_again_in_flight_goes_again_but_not_before_the_first_is_accounted_for() -> None:
    draft = draft_over(None)
    draft.write(0, b"first")
    sending = draft.begin(whole=True)
    assert sending.next_chunk(9) == (0, b"first")
    draft.write(1, b"XX")
    assert sending.next_chunk(9) is None, "two copies under way could land in the wrong order"
    assert sending.unacked == 5
    sending.on_acked(0, 5)
    assert sending.unacked == 2
    assert sending.next_chunk(9) == (1, b"XX")
    sending.on_acked(1, 2)
    assert sending.unacked == 0


def test_a_part_that_was_not_written_goes_again() -> None:
    draft = draft_over(None)
    draft.write(0, b"abcdef")
    sending = draft.begin(whole=True)
    assert sending.next_chunk(6) == (0, b"abcdef")
    sending.on_acked(0, 4)
    sending.on_unsent(4, 2)
    assert sent(sending) == [(4, b"ef")]


def test_rollbacks() -> None:
    draft = draft_over(None)
    draft.write(0, b"abcdef")
    sending = draft.begin(whole=True)
    sending.next_chunk(2)
    sending.on_acked(0, 2)
    sending.on_checkpoint()
    sending.next_chunk(2)
    sending.on_acked(2, 2)
    sending.next_chunk(2)
    sending.on_rollback(False)
    assert sending.unacked == 4
    assert sending.next_chunk(9) == (2, b"cdef")
    sending.on_rollback(True)
    assert sending.next_chunk(9) == (0, b"abcdef")
    assert not sending.emptied


def test_emptying_a_file_that_was_to_be_changed_in_place_is_noticed() -> None:
    draft = draft_over(b"abcdef")
    draft.write(0, b"X")
    sending = draft.begin(whole=False)
    sending.on_rollback(True)
    assert sending.emptied


def test_a_late_upload_of_an_earlier_attempt_changes_nothing() -> None:
    draft = draft_over(None)
    draft.write(0, b"abc")
    early = draft.begin(whole=True)
    early.next_chunk(9)
    late = draft.begin(whole=True)
    early.on_acked(0, 3)
    assert late.unacked == 3


def test_an_ack_of_bytes_that_are_not_under_way_is_not_one_of_the_copy_that_goes_next() -> None:
    draft = draft_over(None)
    draft.write(0, bytes(40))
    sending = draft.begin(whole=True)
    sending.next_chunk(10)
    sending.on_acked(10, 10)
    assert sending.next_chunk(10) == (10, bytes(10))
    assert sending.unacked == 40


def test_bytes_fetched_ahead_are_not_stale() -> None:
    draft = draft_over(None)
    draft.write(0, bytes(AHEAD * 2))
    sending = draft.begin(whole=True)
    sending.next_chunk(10)
    draft.write(10, b"new")
    assert sending.next_chunk(5) == (10, b"new\0\0")
    draft.truncate(16)
    assert sent(sending, 99) == [(15, b"\0")]


def test_growth_in_place_is_remembered_when_the_attempt_is_given_up() -> None:
    draft = draft_over(b"abc")
    draft.write(3, b"defg")
    sending = draft.begin(whole=False)
    sending.next_chunk(9)
    draft.truncate(3)
    assert not draft.clean, "the vehicle's file may be longer now"
    draft.begin_again()
    assert draft.remote_size == 7
    assert not draft.clean


class DraftMachine(RuleBasedStateMachine):
    """A draft, a model of the file, and a model of the vehicle's file under an upload."""

    @initialize(base=st.none() | st.binary(max_size=40), whole=st.booleans())
    def start(self, base: bytes | None, whole: bool) -> None:
        self.base = base or b""
        self.draft = draft_over(base)
        self.model = bytearray(self.base)
        self.remote = bytearray(self.base)
        self.sending: Sending | None = None
        self.whole = whole or base is None
        self.flight: list[tuple[int, bytes]] = []

    @rule(offset=st.integers(0, 60), data=st.binary(max_size=20))
    def write(self, offset: int, data: bytes) -> None:
        self.draft.write(offset, data)
        if data:
            self.model.extend(bytes(max(0, offset - len(self.model))))
            self.model[offset : offset + len(data)] = data

    @rule(size=st.integers(0, 70))
    def truncate(self, size: int) -> None:
        if self.sending is not None and size < self.sending.reached:
            self.give_up()  # as delivery does when more was sent than the file is long
        self.draft.truncate(size)
        del self.model[size:]
        self.model.extend(bytes(size - len(self.model)))

    @rule()
    def begin(self) -> None:
        self.give_up()
        if self.whole:
            self.draft.fill(0, self.base)
            self.remote.clear()
        self.sending = self.draft.begin(whole=self.whole)

    @rule(limit=st.integers(1, 12))
    def send(self, limit: int) -> None:
        chunk = self.sending.next_chunk(limit) if self.sending else None
        if chunk is not None:
            offset, data = chunk
            assert 0 < len(data) <= limit
            assert not any(o < offset + len(data) and offset < o + len(d) for o, d in self.flight)
            self.flight.append(chunk)

    @rule(index=st.integers(0, 5), keep=st.integers(0, 12))
    def answer(self, index: int, keep: int) -> None:
        """One request comes back, perhaps written only in part."""
        if self.sending is None or not self.flight:
            return
        offset, data = self.flight.pop(index % len(self.flight))
        count = min(keep, len(data))
        self.remote.extend(bytes(max(0, offset + count - len(self.remote))))
        self.remote[offset : offset + count] = data[:count]
        self.sending.on_acked(offset, count)
        self.sending.on_unsent(offset + count, len(data) - count)

    @rule(everything=st.booleans())
    def lose_session(self, everything: bool) -> None:
        if self.sending is None:
            return
        everything = everything and self.whole
        self.flight.clear()
        self.sending.on_rollback(everything)
        if everything:
            self.remote.clear()

    @rule()
    def terminate(self) -> None:
        if self.sending is not None:
            self.sending.on_checkpoint()

    @rule()
    def finish(self) -> None:
        """Everything is sent: the vehicle's file is the model."""
        if self.sending is None:
            return
        while self.flight:
            self.answer(0, 12)
        while self.sending.unacked:
            self.send(12)
            assert self.flight
            self.answer(0, 12)
        too_long = len(self.remote) > len(self.model)
        assert self.whole or too_long == (self.draft.remote_end != len(self.model))
        assert self.remote[: len(self.model)] == self.model
        if not too_long:
            self.base = bytes(self.model)
            self.draft.delivered()
            assert self.draft.clean
            self.sending = None

    def give_up(self) -> None:
        self.flight.clear()
        self.draft.begin_again()
        self.sending = None
        if self.whole:
            self.remote = bytearray(self.base)

    @invariant()
    def content_is_the_models(self) -> None:
        if hasattr(self, "draft"):
            self.draft.check_invariants()
            assert content(self.draft, self.base) == self.model
            assert self.draft.size == len(self.model)


TestDraft = DraftMachine.TestCase
TestDraft.settings = settings(max_examples=150, stateful_step_count=40)
