"""Concurrent callers that want the same thing share one execution. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import trio

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")


@dataclass(slots=True, eq=False)
class _Call(Generic[T]):
    """ended: its work ended; results: one, or none after an error or a cancellation."""

    ended: trio.Event = field(default_factory=trio.Event)
    results: list[T] = field(default_factory=list)
    error: Exception | None = None


class SingleFlight(Generic[K, T]):
    """Runs at most one piece of work per key at a time; callers that come meanwhile get its result or error.

    With a nursery the work outlives the caller that started it: listing a large directory over a radio may
    take longer than one system call may wait, and the retry finds it done. Without one the first caller runs
    it; if that caller is cancelled, one of the others starts again.
    """

    def __init__(self, nursery: trio.Nursery | None = None) -> None:
        self._nursery = nursery
        self._running: dict[K, _Call[T]] = {}

    async def run(self, key: K, work: Callable[[], Awaitable[T]]) -> T:
        """Return what `work` returns, or what the work already under way for `key` returns.

        Raises:
            Exception: what the work raised; all its callers get the same object.
        """
        while True:
            call = self._running.get(key)
            if call is None:
                call = self._running[key] = _Call()
                if self._nursery is None:
                    await self._run(key, call, work)
                else:
                    self._nursery.start_soon(self._run, key, call, work)
            if not call.ended.is_set():
                await call.ended.wait()
            if call.results:
                return call.results[0]
            if call.error is not None:
                raise call.error.with_traceback(None)
            await trio.lowlevel.checkpoint()  # the caller that ran it was cancelled

    async def _run(self, key: K, call: _Call[T], work: Callable[[], Awaitable[T]]) -> None:
        try:
            call.results.append(await work())
        except Exception as error:  # handed to every caller that waits, not swallowed
            call.error = error
        finally:
            del self._running[key]
            call.ended.set()
