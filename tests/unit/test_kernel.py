"""mount.kernel: reads of /dev/fuse, where what was there may be gone before it is read."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import suppress

import pyfuse3
import pytest
import trio
import trio.testing

from mavftpfs.mount.kernel import never_blocking

pytestmark = pytest.mark.real_time


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends, of which the first blocks, as /dev/fuse does."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


class Thief(trio.abc.Instrument):
    """Takes what is there once the event loop has seen it, and before anybody is told."""

    def __init__(self, victim: socket.socket) -> None:
        self.victim = victim
        self.took = b""

    def after_io_wait(self, timeout: float) -> None:
        if not self.took:
            with suppress(BlockingIOError):
                self.took = self.victim.recv(1, socket.MSG_DONTWAIT)


@pytest.mark.holds("promise 4")
async def test_a_request_that_was_taken_back_is_not_read(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    told = trio.Event()

    async def wait() -> None:
        await pyfuse3.trio.lowlevel.wait_readable(ours.fileno())  # type: ignore[attr-defined]
        told.set()

    thief = Thief(ours)
    with never_blocking():
        async with trio.open_nursery() as nursery:
            nursery.start_soon(wait)
            await trio.testing.wait_all_tasks_blocked()
            trio.lowlevel.add_instrument(thief)
            theirs.send(b"1")
            await trio.testing.wait_all_tasks_blocked(0.05)
            assert thief.took
            assert not told.is_set()
            theirs.send(b"2")
            await told.wait()
            trio.lowlevel.remove_instrument(thief)
    assert not os.get_blocking(ours.fileno())


@pytest.mark.holds("promise 4")
async def test_a_worker_that_found_nothing_begins_anew() -> None:
    begun: list[tuple[object, ...]] = []

    async def worker(*args: object) -> None:
        await trio.lowlevel.checkpoint()
        begun.append(args)
        if len(begun) < 3:
            raise BlockingIOError(11, "nothing there")

    with never_blocking():
        async with pyfuse3.trio.open_nursery() as nursery:  # type: ignore[attr-defined]
            nursery.start_soon(worker, nursery, 1, 2, name="reader")
    assert begun == [(nursery, 1, 2)] * 3


async def test_other_errors_end_it_and_all_is_as_before() -> None:
    async def worker() -> None:
        await trio.lowlevel.checkpoint()
        raise OSError(5, "aborted")

    with pytest.RaisesGroup(OSError), never_blocking():
        async with pyfuse3.trio.open_nursery() as nursery:  # type: ignore[attr-defined]
            nursery.start_soon(worker)
    assert pyfuse3.trio is trio  # type: ignore[attr-defined]
