"""Reads of /dev/fuse that never block. Layer: fuse.

pyfuse3 waits until there is a request, and then reads it with a call that blocks, in the event loop's thread.
In between the request may be gone: the kernel takes it back when its caller is killed, and an interruption
when what it was to interrupt is answered. Then nothing at all goes on, the link included, until somebody asks
for something else; and who waits for an answer does not. So the descriptor is made non-blocking, it is looked
at once more right before each read, and a worker that found nothing after all begins anew.

The seam is the one that pyfuse3's own asyncio support uses: what it takes for the module `trio`. A worker
that begins anew loses its buffer, which pyfuse3 would have freed: 1 MiB of addresses, of which little was
touched, in some 25 kills of programs that do nothing but ask. Looking once more keeps that rare.
"""

from __future__ import annotations

import os
import select
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import pyfuse3
import trio


@contextmanager
def never_blocking() -> Iterator[None]:
    """Have pyfuse3.main read so for the length of the body."""
    setattr(pyfuse3, "trio", _Trio())  # noqa: B010 (which its types do not tell)
    try:
        yield
    finally:
        setattr(pyfuse3, "trio", trio)  # noqa: B010


class _Delegate:
    """Has whatever a module has, but for what a subclass defines."""

    def __init__(self, module: object) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _LowLevel(_Delegate):
    async def wait_readable(self, fd: int) -> None:
        """Wait until a read finds something, as far as that can be known."""
        os.set_blocking(fd, False)
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        await trio.lowlevel.wait_readable(fd)
        while not poll.poll(0):
            await trio.lowlevel.wait_readable(fd)


class _Trio(_Delegate):
    def __init__(self) -> None:
        super().__init__(trio)
        self.lowlevel = _LowLevel(trio.lowlevel)

    @asynccontextmanager
    async def open_nursery(self) -> AsyncIterator[_Workers]:
        """Open the one of pyfuse3's workers."""
        async with trio.open_nursery() as nursery:
            yield _Workers(nursery)


class _Workers:
    """Starts workers that outlive a read which found nothing."""

    def __init__(self, nursery: trio.Nursery) -> None:
        self._nursery = nursery

    def start_soon(self, worker: Callable[..., Awaitable[None]], *args: object, name: object = None) -> None:
        """As trio.Nursery's."""
        self._nursery.start_soon(_work, worker, args, name=name)


async def _work(worker: Callable[..., Awaitable[None]], args: tuple[object, ...]) -> None:
    while True:
        try:
            await worker(*args)
        except BlockingIOError:
            continue  # it counts as running still
        return
