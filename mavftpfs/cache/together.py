"""Requests that need not wait for each other. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

import trio

T = TypeVar("T")


async def together(first: Callable[[], Awaitable[T]], second: Callable[[], Awaitable[None]]) -> T:
    """Await two calls at the same time, and return what the first one returned. The first one starts first,
    so its requests go out first.

    Raises:
        The error of the first call, else that of the second; after both have ended.
    """
    failures: list[Exception] = []

    async def run_second() -> None:
        try:
            await second()
        except Exception as error:  # raised again below
            failures.append(error)

    async with trio.open_nursery() as nursery:
        nursery.start_soon(run_second)
        try:
            result = await first()
        except Exception as error:  # raised again below
            failures.insert(0, error)
    if failures:
        raise failures[0]
    return result
