"""The content of a file against a plain model, and the states of a file."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import trio
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from mavftpfs.cache.blocks import BlockCache, Blocks
from mavftpfs.cache.content import Content
from mavftpfs.cache.file import TRANSITIONS, Event, File, State
from mavftpfs.cache.items import Folder
from mavftpfs.cache.spool import Spool
from mavftpfs.shared.errors import FileChanged, LocalProtocolError, WriteFailed
from mavftpfs.shared.sending import AHEAD, SendBuffer

SPOOL = Spool()
CACHE = BlockCache(1 << 20, clock=lambda: 0.0, patience=1.0)


def content_over(base: bytes | None) -> Content:
    content = Content(Blocks(CACHE))
    content.on_opened(len(base or b""))
    content.spool(SPOOL, b"/f")
    return content


def shown(content: Content, base: bytes) -> bytes:
    parts = []
    at = 0
    for start, stop in [*content.missing(0, content.size), (content.size, content.size)]:
        if at < start:
            parts.append(content.get(at, start))
        parts.append(base[start:stop])
        at = stop
    return b"".join(parts)


# --- a file's states


def make_file() -> File:
    root = Folder()
    file = root.children[b"f"] = File(root, b"f", CACHE)
    return file


def test_every_event_has_its_place_in_the_table() -> None:
    assert {event for events in TRANSITIONS.values() for event in events} == set(Event)
    assert not TRANSITIONS[State.BROKEN], "nothing mends a broken file"
    assert not TRANSITIONS[State.DEAD]
    for state in State:
        for event in set(Event) - TRANSITIONS[state].keys():
            file = make_file()
            file.state = state
            with pytest.raises(LocalProtocolError):
                file.on(event)
            assert file.state is state


def test_what_may_be_read_of_a_file_that_lost_something() -> None:
    stale, dead = make_file(), make_file()
    stale.on(Event.CHANGED)
    for replaced in (stale, dead):
        replaced.on(Event.REPLACED)
    stale.require_alive()  # its pending changes are shown
    for require in (stale.require_base, stale.require_not_stale, dead.require_alive, dead.require_base):
        with pytest.raises(FileChanged):
            require()
    removed = make_file()
    removed.leave_tree()
    removed.require_alive()  # what is here
    with pytest.raises(FileChanged):
        removed.require_base()
    broken = make_file()
    broken.on(Event.CHANGED)
    broken.require_not_broken()
    broken.on(Event.FAILED)
    with pytest.raises(WriteFailed):
        broken.require_not_broken()


async def test_a_claim_goes_before_the_delivery_that_it_cancels() -> None:
    file, order = make_file(), []

    async def deliver() -> None:
        async with file.lock:
            with trio.CancelScope() as file.delivery:
                await trio.sleep_forever()
        order.append("cancelled")

    async with trio.open_nursery() as nursery:
        nursery.start_soon(deliver)
        await trio.sleep(0.1)
        async with file.preempt(1.0):
            order.append("preempted")
    assert order == ["cancelled", "preempted"]


# --- entries


def test_a_rename_of_a_directory_moves_what_is_below_it() -> None:
    root = Folder()
    folder, name = root.home(b"/a/b/f")
    file = folder.children[name] = File(folder, name, CACHE)
    other = root.need(b"/a/b").children
    moved = root.find(b"/a/b")
    assert moved is not None
    moved.move(root.need(b"/c"), b"d")
    assert file.path == b"/c/d/f"
    assert root.find(b"/c/d/f") is file is other[b"f"]
    assert root.find(b"/a/b/f") is None
    file.leave_tree()
    assert not file.has_name
    assert file.path == b"/c/d/f", "for messages"
    root.need(b"/c/d").prune()
    assert root.find(b"/c") is None
    root.need(b"/a").prune()
    assert not root.children


# --- sending


def sending_of(data: bytes) -> tuple[Content, SendBuffer]:
    content = content_over(None)
    content.write(0, data)
    return content, SendBuffer(content.get, content.size)


@pytest.mark.parametrize(
    ("change", "at"),
    [
        (lambda content: content.write(2, b"XX"), 2),
        (lambda content: content.truncate(2), 2),
        (lambda content: content.truncate(0), 0),
    ],
)
def test_what_was_handed_out_may_not_change(change: Callable[[Content], None], at: int) -> None:
    content, sending = sending_of(b"abcdef")
    sending.next_chunk(3)
    content.write(3, b"XX")
    sending.on_changed(3, content.size)
    assert not sending.invalidated
    change(content)
    sending.on_changed(at, content.size)
    assert sending.invalidated
    assert sending.next_chunk(9) is None, "two copies under way could land in the wrong order"


def test_bytes_fetched_ahead_are_not_stale() -> None:
    content, sending = sending_of(bytes(AHEAD * 2))
    sending.next_chunk(10)
    content.write(10, b"new")
    sending.on_changed(10, content.size)
    assert sending.next_chunk(5) == (10, b"new\0\0")


class ContentMachine(RuleBasedStateMachine):
    """Content, and a model of the file."""

    @initialize(base=st.none() | st.binary(max_size=40))
    def start(self, base: bytes | None) -> None:
        self.base = base or b""
        self.content = content_over(base)
        self.model = bytearray(self.base)

    @rule(offset=st.integers(0, 60), data=st.binary(min_size=1, max_size=20))
    def write(self, offset: int, data: bytes) -> None:
        self.content.write(offset, data)
        self.model.extend(bytes(max(0, offset - len(self.model))))
        self.model[offset : offset + len(data)] = data

    @rule(size=st.integers(0, 70))
    def truncate(self, size: int) -> None:
        self.content.truncate(size)
        del self.model[size:]
        self.model.extend(bytes(size - len(self.model)))

    @rule(start=st.integers(0, 40), size=st.integers(0, 40))
    def fetch(self, start: int, size: int) -> None:
        self.content.fill(start, self.base[start : start + size])

    @precondition(lambda self: self.content.whole)
    @rule()
    def deliver(self) -> None:
        assert self.content.missing(0, self.content.size) == []
        assert self.content.get(0, self.content.size) == self.model
        self.content.on_delivered()
        self.base = bytes(self.model)

    @invariant()
    def content_is_the_models(self) -> None:
        if hasattr(self, "content"):
            self.content.check_invariants()
            assert shown(self.content, self.base) == self.model
            assert self.content.size == len(self.model)

    def teardown(self) -> None:
        if hasattr(self, "content"):
            self.content.forget()


TestContent = ContentMachine.TestCase
TestContent.settings = settings(max_examples=80, stateful_step_count=40)
