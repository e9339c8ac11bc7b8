"""mount.kernel: our end before fusermount3 hears of it, and reads of /dev/fuse, where what was there may be
gone before it is read."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import suppress

import pyfuse3
import pytest
import trio
import trio.testing

from mavftpfs.mount.kernel import never_blocking, watcher_told_last

pytestmark = pytest.mark.real_time


def test_the_socket_by_which_fusermount3_hears_of_our_end_lies_below_the_device() -> None:
    """Linux lets go of the highest descriptor first. Opened in the order of libfuse's."""
    with watcher_told_last():
        theirs, ours = socket.socketpair()
        number = ours.detach()
        theirs.close()
        device = os.open(os.devnull, os.O_RDONLY)
    try:
        assert device < number
        moved = [n for n in range(device) if stat.S_ISSOCK(mode_of(n)) and peer_is_gone(n)]
        assert len(moved) == 1
        assert mode_of(number) == 0
        os.close(moved[0])
    finally:
        os.close(device)


def mode_of(descriptor: int) -> int:
    """Return what kind of file a descriptor is, 0 if it is not open."""
    try:
        return os.fstat(descriptor).st_mode
    except OSError:
        return 0


def peer_is_gone(descriptor: int) -> bool:
    """Return whether the other end of a socket was closed."""
    with socket.socket(fileno=os.dup(descriptor)) as own:
        try:
            return own.recv(1, socket.MSG_DONTWAIT | socket.MSG_PEEK) == b""
        except OSError:
            return False


def test_a_mount_that_failed_leaves_no_descriptor() -> None:
    before = os.listdir("/proc/self/fd")
    with pytest.raises(RuntimeError), watcher_told_last():
        raise RuntimeError
    with watcher_told_last():
        pass
    assert os.listdir("/proc/self/fd") == before


# --- reads of /dev/fuse


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
