"""client.wire: messages arrive whole however their bytes are cut, and errors as they were raised."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.cache.attributes import Stat
from mavftpfs.client import wire
from mavftpfs.shared import errors
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, ListingIncomplete, MavftpfsError, NotFound, RemoteProtocolError
from mavftpfs.shared.model import EntryKind

FACTS = st.dictionaries(st.text(max_size=5), st.integers() | st.text() | st.booleans() | st.none())
STAT = Stat(EntryKind.FILE, 7, 1_700_000_000 * 10**9, 1.5)


@given(st.lists(st.tuples(FACTS, st.binary(max_size=2000)), max_size=5), st.data())
def test_messages_arrive_however_they_are_cut(
    messages: list[tuple[dict[str, Any], bytes]], data: Any
) -> None:
    received, taken = wire.replies(), []
    stream = b"".join(wire.encoded(*message) for message in messages)
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        received.feed(stream[:size])
        stream = stream[size:]
        while (message := received.next()) is not None:
            taken.append(tuple(message))
    assert taken == messages


@given(st.binary(max_size=200))
def test_garbage_is_refused_or_waits_for_more(garbage: bytes) -> None:
    received = wire.requests()
    received.feed(garbage)
    try:
        while received.next() is not None:
            pass
    except RemoteProtocolError:
        pass


@pytest.mark.parametrize("lengths", [(1 << 30, 0), (2, 1 << 30)])
def test_lengths_that_no_request_has_are_refused_at_once(lengths: tuple[int, int]) -> None:
    received = wire.requests()
    received.feed(b"".join(length.to_bytes(4, "big") for length in lengths))
    with pytest.raises(RemoteProtocolError):
        received.next()


KINDS = [
    kind
    for kind in vars(errors).values()
    if inspect.isclass(kind) and issubclass(kind, MavftpfsError) and kind is not FtpNak
]


def made(kind: type[MavftpfsError]) -> MavftpfsError:
    if kind is ListingIncomplete:
        return ListingIncomplete("'/d' was not listed to its end", [(b"\xff\n", STAT)])
    return kind("'/x' has another reason")


@pytest.mark.parametrize("error", [*map(made, KINDS), FtpNak(13, 2, 28, retransmitted=True)], ids=repr)
def test_an_error_arrives_as_it_was_raised(error: MavftpfsError) -> None:
    received = wire.replies()
    received.feed(wire.encoded(*wire.told_error(error)))
    reply = received.next()
    assert reply is not None
    arrived = wire.error_from(reply)
    assert (type(arrived), str(arrived), vars(arrived)) == (type(error), str(error), vars(error))
    assert errno_for(arrived) == errno_for(error)


def test_an_error_of_one_module_arrives_as_the_kind_that_all_know() -> None:
    class OfOneModule(NotFound): ...

    assert type(wire.error_from(wire.told_error(OfOneModule("x")))) is NotFound


def test_a_directory_arrives_with_all_names() -> None:
    entries = [(b"a b", STAT), (b"\xff\xfe", Stat(EntryKind.DIRECTORY, 0, 0, 0.0)), ("ä".encode(), STAT)]
    assert wire.entries_from(wire.told_entries(entries)) == entries
