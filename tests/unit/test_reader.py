"""The session's reader: what is wanted, and when it is not any more."""

from __future__ import annotations

from math import inf
from typing import cast

from mavftpfs.session.reader import FileStream, Reading
from tests.support.worlds import MemorySink


class Silent:
    """Stands in for Reading: it is told of wants, and does nothing about them."""

    def on_want(self, stream: FileStream) -> None:
        pass

    def on_closed(self, stream: FileStream) -> None:
        pass


def make(size: int = 1000) -> tuple[FileStream, MemorySink]:
    sink = MemorySink(size)
    return FileStream(b"/f", sink, size, cast(Reading, Silent())), sink


def test_what_was_delivered_is_not_wanted_again_when_the_cache_drops_it() -> None:
    stream, sink = make()
    stream.want(0, 600, demand=True)
    stream.want(600, 900, demand=False)
    sink.on_data(0, bytes(600))
    stream.on_batch()
    sink.have.clear()  # evicted
    assert stream.due_at() == inf
    assert stream.prefetches()
    sink.on_data(600, bytes(300))
    stream.on_batch()
    sink.have.clear()
    assert not stream.prefetches()


def test_only_what_the_cache_lacks_is_wanted() -> None:
    stream, sink = make()
    sink.on_data(100, bytes(100))
    stream.want(100, 200, demand=True)
    assert stream.due_at() == inf
    stream.want(0, 300, demand=True)
    assert list(stream._demand) == [(0, 100), (200, 300)]


def test_a_closed_stream_wants_nothing() -> None:
    stream, _ = make()
    stream.want(0, 100, demand=True)
    stream.close()
    stream.want(0, 100, demand=True)
    assert stream.due_at() == inf
