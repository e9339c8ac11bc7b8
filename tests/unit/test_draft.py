"""Drafts against a plain model: content, where each byte is, and what is still to be sent."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from mavftpfs.cache.draft import Draft, State, Where
from mavftpfs.cache.spool import Spool, SpoolContent
from mavftpfs.shared.errors import LocalProtocolError
from mavftpfs.shared.sameness import Known
from mavftpfs.shared.sending import AHEAD, SendBuffer

SPOOL = Spool()


def draft_over(base: bytes | None) -> Draft:
    return Draft(SpoolContent(SPOOL), None if base is None else Known(len(base)))


def sending_of(data: bytes) -> tuple[Draft, SendBuffer]:
    draft = draft_over(None)
    draft.write(0, data)
    return draft, draft.begin(in_place=False)


def content(draft: Draft, base: bytes) -> bytes:
    parts = []
    for where, start, stop in draft.segments(0, draft.size):
        parts.append(base[start:stop] if where is Where.BASE else draft.local_bytes(start, stop))
    return b"".join(parts)


def sent(sending: SendBuffer, limit: int = 7) -> list[tuple[int, bytes]]:
    chunks = []
    while (chunk := sending.next_chunk(limit)) is not None:
        chunks.append(chunk)
    return chunks


# --- states


def test_after_a_comparison_that_failed_no_base_counts_any_more() -> None:
    draft = draft_over(b"old")
    draft.fill(0, b"old")
    draft.write(0, b"X")
    draft.begin(in_place=False)
    draft.end_attempt()
    draft.not_confirmed()
    assert draft.state is State.DIRTY
    draft.lose_base()
    draft.write(0, b"Y")
    assert draft.local_bytes(0, 3) == b"Yld"


def test_a_base_that_others_replaced() -> None:
    clean = draft_over(b"old")
    clean.lose_base()
    assert [clean.state] == [State.STALE]
    cut = draft_over(b"old")
    cut.truncate(2)
    cut.lose_base()
    assert [cut.state] == [State.STALE]
    with pytest.raises(LocalProtocolError):
        cut.write(0, b"x")
    cut.truncate(0)
    assert cut.state is State.DIRTY, "nothing of the base is to stay"
    cut.lose_base()
    assert cut.state is State.DIRTY


# --- sending


@pytest.mark.parametrize(
    "change",
    [
        lambda draft: draft.write(2, b"XX"),
        lambda draft: draft.truncate(2),
        lambda draft: draft.truncate(0),
    ],
)
def test_what_was_handed_out_may_not_change(change: Callable[[Draft], None]) -> None:
    draft, sending = sending_of(b"abcdef")
    sending.next_chunk(3)
    draft.write(3, b"XX")
    draft.truncate(7)
    assert not sending.overtaken
    change(draft)
    assert sending.overtaken
    assert sending.next_chunk(9) is None, "two copies under way could land in the wrong order"


def test_bytes_fetched_ahead_are_not_stale() -> None:
    draft, sending = sending_of(bytes(AHEAD * 2))
    sending.next_chunk(10)
    draft.write(10, b"new")
    assert sending.next_chunk(5) == (10, b"new\0\0")
    draft.truncate(16)
    assert sent(sending, 99) == [(15, b"\0")]


class DraftMachine(RuleBasedStateMachine):
    """A draft, a model of the file, and a model of the file that an upload makes."""

    @initialize(base=st.none() | st.binary(max_size=40))
    def start(self, base: bytes | None) -> None:
        self.base = base or b""
        self.draft = draft_over(base)
        self.model = bytearray(self.base)
        self.remote = bytearray()
        self.flight: list[tuple[int, bytes]] = []

    @rule(offset=st.integers(0, 60), data=st.binary(max_size=20))
    def write(self, offset: int, data: bytes) -> None:
        self.draft.write(offset, data)
        if data:
            self.model.extend(bytes(max(0, offset - len(self.model))))
            self.model[offset : offset + len(data)] = data
        self.give_up_if_overtaken()

    @rule(size=st.integers(0, 70))
    def truncate(self, size: int) -> None:
        self.draft.truncate(size)
        del self.model[size:]
        self.model.extend(bytes(size - len(self.model)))
        self.give_up_if_overtaken()

    @precondition(lambda self: self.draft.state is State.DIRTY)
    @rule()
    def begin(self) -> None:
        self.draft.fill(0, self.base)
        self.remote.clear()
        self.draft.begin(in_place=False)

    @rule(limit=st.integers(1, 12))
    def send(self, limit: int) -> None:
        chunk = self.draft.sending.next_chunk(limit) if self.draft.sending else None
        if chunk is not None:
            offset, data = chunk
            assert 0 < len(data) <= limit
            assert not any(o < offset + len(data) and offset < o + len(d) for o, d in self.flight)
            self.flight.append(chunk)

    @rule(index=st.integers(0, 5), keep=st.integers(0, 12))
    def answer(self, index: int, keep: int) -> None:
        """One request comes back, perhaps written only in part."""
        sending = self.draft.sending
        if sending is None or not self.flight:
            return
        offset, data = self.flight.pop(index % len(self.flight))
        count = min(keep, len(data))
        self.remote.extend(bytes(max(0, offset + count - len(self.remote))))
        self.remote[offset : offset + count] = data[:count]
        sending.on_acked(offset, offset + count)
        sending.ranges.on_lost(offset + count, offset + len(data))

    @rule(everything=st.booleans())
    def lose_session(self, everything: bool) -> None:
        if self.draft.sending is None:
            return
        self.flight.clear()
        if everything:
            self.draft.sending.start_over()
            self.remote.clear()
        else:
            self.draft.sending.roll_back()

    @rule()
    def terminate(self) -> None:
        if self.draft.sending is not None:
            self.draft.sending.check_point()

    @rule(end=st.sampled_from(["placed", "not placed", "not confirmed, and placed", "not confirmed"]))
    def finish(self, end: str) -> None:
        """Everything is sent: the remote file is the model."""
        sending = self.draft.sending
        if sending is None:
            return
        while self.flight:
            self.answer(0, 12)
        while sending.unacked:
            self.send(12)
            assert self.flight
            self.answer(0, 12)
        assert self.remote == self.model
        self.draft.end_attempt()
        if end.startswith("not confirmed"):
            self.draft.not_confirmed()
        if end in ("placed", "not confirmed, and placed"):
            self.draft.delivered()
            self.base = bytes(self.model)
        assert (self.draft.state is State.CLEAN) == (end in ("placed", "not confirmed, and placed"))

    def give_up_if_overtaken(self) -> None:
        if self.draft.sending is None or self.draft.sending.overtaken:
            self.give_up()

    @rule()
    def give_up(self) -> None:
        self.flight.clear()
        self.draft.end_attempt()

    @invariant()
    def content_is_the_models(self) -> None:
        if hasattr(self, "draft"):
            self.draft.check_invariants()
            assert content(self.draft, self.base) == self.model
            assert self.draft.size == len(self.model)


TestDraft = DraftMachine.TestCase
TestDraft.settings = settings(max_examples=80, stateful_step_count=40)
