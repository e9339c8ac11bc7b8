"""A hub as a process: what it inherits, signals, its end. Layer: hub."""

from __future__ import annotations

import signal
import socket
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path

import trio

from mavftpfs.hub.hub import Hub
from mavftpfs.link.base import background
from mavftpfs.link.rendezvous import Door
from mavftpfs.link.uri import parse_source


def serve(source: str, inherited: Sequence[int], on_ready: Callable[[], None]) -> None:
    """Be the hub of a port until it is not needed any more, or a signal ends it.

    inherited: the descriptors of the first client's connection, of the door, and of the port.

    Raises:
        LinkClosed: the port cannot be used.
    """
    client, door, *port = inherited
    first = socket.socket(fileno=client)
    listening = socket.socket(fileno=door)
    hub = Hub(parse_source(source), port, Door(listening, Path(listening.getsockname())))
    trio.run(_until_signalled, partial(hub.run, first, on_ready))


async def _until_signalled(work: Callable[[], Awaitable[None]]) -> None:
    scope = trio.CancelScope()
    with trio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:

        async def watch() -> None:
            async for _ in signals:
                scope.cancel()

        async with background(watch, trio.lowlevel.checkpoint):
            with scope:
                await work()
