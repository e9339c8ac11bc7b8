"""Running a link's helper task for the length of an `async with`. Layer: link."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import trio


@asynccontextmanager
async def background(
    task: Callable[[], Awaitable[None]], close: Callable[[], Awaitable[None]]
) -> AsyncIterator[None]:
    """Run `task` beside the body; when the body ends, `close` (shielded) and cancel the task.

    An Exception of the body comes out as itself, not inside an ExceptionGroup as a bare nursery would
    have it: callers catch LinkClosed by name.
    """
    failure: Exception | None = None
    async with trio.open_nursery() as nursery:
        nursery.start_soon(task)
        try:
            yield
        except Exception as exc:
            failure = exc
        finally:
            with trio.CancelScope(shield=True):
                await close()
            nursery.cancel_scope.cancel()
    if failure is not None:
        raise failure
