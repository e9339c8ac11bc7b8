"""Requests that need not wait for each other. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import trio


async def together(*calls: Callable[[], Awaitable[None]]) -> None:
    """Await several calls at the same time. The first one starts first, so its requests go out first.

    Raises:
        The error of the first call, in this order, that failed; after all have ended.
    """
    failures: dict[int, Exception] = {}

    async def run(index: int) -> None:
        try:
            await calls[index]()
        except Exception as error:  # raised again below
            failures[index] = error

    async with trio.open_nursery() as nursery:
        for index in range(1, len(calls)):
            nursery.start_soon(run, index)
        await run(0)
    if failures:
        raise failures[min(failures)]
