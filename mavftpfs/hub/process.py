"""A hub as a process: signals, and its end. Layer: hub."""

from __future__ import annotations

import signal

import trio

from mavftpfs.hub.hub import run_hub
from mavftpfs.link.base import plain_nursery
from mavftpfs.link.uri import LinkSpec, parse_source


def serve(source: str) -> None:
    """Be the hub of a port until nobody needs it, or a signal ends it.

    Raises:
        LinkClosed: the port cannot be used.
    """
    trio.run(_until_signalled, parse_source(source))


async def _until_signalled(spec: LinkSpec) -> None:
    scope = trio.CancelScope()
    with trio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:

        async def watch() -> None:
            async for _ in signals:
                scope.cancel()

        async with plain_nursery() as nursery:
            nursery.start_soon(watch)
            with scope:
                await run_hub(spec)
