"""The session's reader: what is wanted, and when it is not any more."""

from __future__ import annotations

import random
from math import inf
from types import SimpleNamespace
from typing import cast

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.session.driver import Driver
from mavftpfs.session.reader import FileStream
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.vehicle import Vehicle
from tests.support.worlds import MemorySink


class NoLink:
    """Stands in for the driver: nobody reads."""

    engine = Engine(random.Random(1), Flow())
    vehicle = Vehicle(0, 0, Address(254, 191))


def make(size: int = 1000) -> tuple[FileStream, MemorySink]:
    sink = MemorySink(size)
    return FileStream(b"/f", sink, size, Scheduler(cast(Driver, NoLink()), clock=lambda: 0.0)), sink


def test_what_was_delivered_is_not_wanted_again_when_the_cache_drops_it() -> None:
    stream, sink = make()
    stream.want(0, 600, demand=True)
    stream.want(600, 900, demand=False)
    for offset, size in ((0, 600), (600, 300)):
        assert stream.prefetches()
        sink.on_data(offset, bytes(size))
        transfer = SimpleNamespace(received_bytes=offset + size, idle=False, done=False)
        stream._transfer = cast(ReadTransfer, transfer)
        stream._on_batch(0.0)
        sink.have.clear()  # evicted
        assert stream.due_at() == inf
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
