"""Requests that need not wait for each other. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import trio


async def together(*calls: Callable[[], Awaitable[None]]) -> None:
    """Await calls at once: the first is begun first, so what it asks for goes out first.

    Raises:
        What the first of them, in this order, failed with; when all have ended.
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
