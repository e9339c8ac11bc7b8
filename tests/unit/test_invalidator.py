"""mount.invalidator: what the kernel is told from a thread."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable

import pytest
import trio

from mavftpfs.mount.handles import InodeTable
from mavftpfs.mount.invalidator import Invalidator

pytestmark = pytest.mark.real_time


class Kernel:
    """Records calls; may refuse or hang."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, bool]] = []
        self.threads: set[int] = set()
        self.error: OSError | None = None
        self.gate: threading.Event | None = None

    def notify(self, ino: int, attr_only: bool) -> None:
        self.calls.append((ino, attr_only))
        self.threads.add(threading.get_ident())
        if self.gate is not None:
            self.gate.wait(90)
        if self.error is not None:
            raise self.error


async def idle(condition: Callable[[], bool]) -> None:
    """Wait for something that threads do."""
    with trio.fail_after(90):
        while not condition():  # noqa: ASYNC110 (threads set no trio.Event)
            await trio.sleep(0.001)


@pytest.mark.parametrize(("number", "logged"), [(errno.ENOENT, False), (errno.EPERM, True)])
async def test_a_refusal_is_logged_unless_the_kernel_had_forgotten(
    number: int, logged: bool, caplog: pytest.LogCaptureFixture
) -> None:
    kernel = Kernel()
    kernel.error = OSError(number, "no")
    await Invalidator(InodeTable(), kernel.notify).forget_attributes(7)
    assert bool(caplog.records) == logged


async def test_busy_while_a_thread_is_in_the_kernel_even_if_nobody_waits() -> None:
    kernel = Kernel()
    kernel.gate = threading.Event()
    invalidator = Invalidator(InodeTable(), kernel.notify)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(invalidator.forget_attributes, 7)
        await idle(lambda: bool(kernel.calls))
        nursery.cancel_scope.cancel()
    assert invalidator.busy
    kernel.gate.set()
    await idle(lambda: not invalidator.busy)


async def test_a_kernel_that_is_about_to_go_is_told_nothing_more() -> None:
    inodes, kernel = InodeTable(), Kernel()
    inodes.lookup(b"/f")
    invalidator = Invalidator(inodes, kernel.notify)
    await invalidator.forget_pages(b"/f")
    told = len(kernel.calls)
    invalidator.end()
    await invalidator.forget_pages(b"/f")
    await invalidator.forget_attributes(7)
    assert len(kernel.calls) == told == 1


async def test_a_file_of_which_a_page_is_being_read_delays_no_other_file() -> None:
    inodes, kernel, gate = InodeTable(), Kernel(), threading.Event()
    slow, other = inodes.lookup(b"/slow").ino, inodes.lookup(b"/other").ino

    def notify(ino: int, attr_only: bool) -> None:
        kernel.notify(ino, attr_only)
        if ino == slow:
            gate.wait(90)

    invalidator = Invalidator(inodes, notify)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(invalidator.run)
        invalidator.on_changed(b"/slow")
        await idle(lambda: bool(kernel.calls))
        invalidator.on_changed(b"/other")
        with trio.move_on_after(5):
            await idle(lambda: len(kernel.calls) == 2)
        gate.set()
        nursery.cancel_scope.cancel()
    assert kernel.calls == [(slow, False), (other, False)]
