"""The kernel's side of a mount: mount, answer its requests, unmount. Layer: mount.

While mounted, no code in the event loop may make a system call on the mountpoint, because it would wait for
itself.
"""

from __future__ import annotations

import logging
import os
import select
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from types import SimpleNamespace

import pyfuse3
import trio

from mavftpfs.client.mountpoint import is_dead, mounts, stderr_of, unmount, why_not_mounted
from mavftpfs.mount.handles import Presentation
from mavftpfs.mount.options import permissions
from mavftpfs.shared.errors import MountFailed
from mavftpfs.shared.options import Options

log = logging.getLogger("mavftpfs.mount")

MIN_TASKS = 10
MAX_TASKS = 2000
"""The most requests at once. With pyfuse3's default of 99, 120 blocked opens freeze even `df`."""


GRACE = 2.0
"""Seconds for running requests to finish once no new ones are taken. A read may wait for a lost vehicle as
long as op_deadline."""


class FuseLoop:
    """Answers the kernel's requests."""

    def __init__(self) -> None:
        self._scope = trio.CancelScope()

    async def run(self) -> None:
        """Answer until the kernel's mount is gone, or `stop` is called; then let the running requests
        finish."""
        try:
            with self._scope, never_blocking(on_gone=self.stop):
                await pyfuse3.main(min_tasks=MIN_TASKS, max_tasks=MAX_TASKS)
        except* OSError as group:
            # Reading from /dev/fuse fails when the connection was aborted (`umount -f`, fusectl).
            log.warning("the kernel ended the mount: %s", group.exceptions[0])

    def stop(self) -> None:
        """Take no more requests. May be called before `run`, and again."""
        pyfuse3.terminate()
        self._scope.deadline = min(self._scope.deadline, trio.current_time() + GRACE)


@contextmanager
def kernel_mount(
    operations: pyfuse3.Operations,
    mountpoint: str,
    words: set[str],
    *,
    busy: Callable[[], bool] = lambda: False,
) -> Iterator[None]:
    """Have the kernel show `operations` at the mountpoint for the length of the body.

    words: options for FUSE. busy: returns whether a thread is inside a call of the library.

    Raises:
        MountFailed: the text is libfuse's or fusermount3's.
    """
    with stderr_of() as said:
        try:
            pyfuse3.init(operations, mountpoint, words)
        except RuntimeError as exc:
            raise MountFailed(why_not_mounted(mountpoint, said() or str(exc))) from exc
    number = _number_at(mountpoint)
    try:
        yield
    finally:
        # libfuse unmounts what is at the place: another mount, if this one was taken away by `umount -l`.
        is_there = _number_at(mountpoint) == number
        if busy():
            # Freeing the library's session would pull it away from that thread.
            if is_there:
                unmount(mountpoint, lazy=True)
        else:
            pyfuse3.close(unmount=is_there)
            if is_there and is_dead(mountpoint):  # libfuse leaves it if the kernel aborted it: `umount -f`
                unmount(mountpoint, lazy=True)


def _number_at(mountpoint: str) -> str | None:
    mounted = mounts().get(mountpoint)
    return None if mounted is None else mounted.number


def presentation(options: Options) -> Presentation:
    """Return the presentation for these options, with this process's user and umask as defaults."""
    umask = os.umask(0o022)
    os.umask(umask)
    return Presentation(
        uid=os.getuid() if options.uid is None else options.uid,
        gid=os.getgid() if options.gid is None else options.gid,
        file_mode=permissions(options, 0o666, options.fmask, umask),
        directory_mode=permissions(options, 0o777, options.dmask, umask),
        op_deadline=options.op_deadline,
    )


# -- reading /dev/fuse without blocking -------------------------------------------------------------


@contextmanager
def never_blocking(on_gone: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Have pyfuse3.main read /dev/fuse without blocking for the length of the body.

    pyfuse3 waits until there is a request, and then reads it with a call that blocks, in the event loop's
    thread. In between the request may vanish, because the kernel withdraws it when its caller is killed. Then
    the whole program would stop, the link included, until the next request. So the descriptor is made
    non-blocking and checked once more right before each read, and a worker without a request starts again.
    (The worker then loses its buffer: 1 MiB of addresses, of which little was touched.)

    The seam is the one that pyfuse3's own asyncio support uses: its variable for the module `trio`.
    """

    async def wait_readable(fd: int) -> None:
        os.set_blocking(fd, False)
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        await trio.lowlevel.wait_readable(fd)
        while not (found := poll.poll(0)):
            await trio.lowlevel.wait_readable(fd)
        if any(events & select.POLLERR for _, events in found):  # on Linux: the kernel's mount is gone
            on_gone()

    lowlevel = SimpleNamespace(**{**vars(trio.lowlevel), "wait_readable": wait_readable})
    seam = SimpleNamespace(**{**vars(trio), "lowlevel": lowlevel, "open_nursery": _workers})
    setattr(pyfuse3, "trio", seam)  # noqa: B010 (which its types do not tell)
    try:
        yield
    finally:
        setattr(pyfuse3, "trio", trio)  # noqa: B010


@asynccontextmanager
async def _workers() -> AsyncIterator[SimpleNamespace]:
    """Open the nursery of pyfuse3's workers, which survive a read without a request."""
    async with trio.open_nursery() as nursery:

        def start_soon(worker: Callable[..., Awaitable[None]], *args: object, name: object = None) -> None:
            nursery.start_soon(_work, worker, args, name=name)

        yield SimpleNamespace(start_soon=start_soon)


async def _work(worker: Callable[..., Awaitable[None]], args: tuple[object, ...]) -> None:
    while True:
        try:
            await worker(*args)
        except BlockingIOError:
            continue  # it counts as running still
        return
