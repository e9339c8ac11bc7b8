"""Concurrent requests for one thing share one execution. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Hashable
from typing import Generic, TypeVar

import trio

from mavftpfs.shared.errors import RequestTimeout

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")


class _Flight(Generic[T]):
    def __init__(self) -> None:
        self.landed = trio.Event()
        self.results: list[T] = []  # one, or none after an error or a cancellation
        self.error: Exception | None = None

    def outcome(self) -> T:
        if self.error is not None:
            raise self.error.with_traceback(None)
        return self.results[0]

    @property
    def abandoned(self) -> bool:
        return self.error is None and not self.results


class Flights(Generic[K, T]):
    """Runs at most one piece of work per key at a time; who comes meanwhile gets the same result or error.

    With a nursery the work outlives the caller that started it: a sweep of a large directory over a radio
    may take longer than one system call may wait, and the retry finds it done. Without one the first
    caller runs it, and if that caller is cancelled, one of the others starts again.
    """

    def __init__(self, nursery: trio.Nursery | None = None) -> None:
        self._nursery = nursery
        self._running: dict[K, _Flight[T]] = {}

    def __len__(self) -> int:
        return len(self._running)

    async def run(self, key: K, work: Callable[[], Awaitable[T]]) -> T:
        """Return what `work` returns, or what the work already under way for `key` returns.

        Who came while it was under way did not wait as long: its time-out is not his, and he begins anew.

        Raises:
            Exception: what the work raised; all who share it get the same object.
        """
        older = key in self._running
        while True:
            flight = self._running.get(key)
            if flight is None:
                flight = await self._start(key, work)
            if not flight.landed.is_set():
                await flight.landed.wait()
            if not flight.abandoned and not (older and isinstance(flight.error, RequestTimeout)):
                return flight.outcome()
            older = False
            await trio.lowlevel.checkpoint()

    async def _start(self, key: K, work: Callable[[], Awaitable[T]]) -> _Flight[T]:
        flight = self._running[key] = _Flight()
        if self._nursery is None:
            await self._fly(key, flight, work)
        else:
            self._nursery.start_soon(self._fly, key, flight, work)
        return flight

    async def _fly(self, key: K, flight: _Flight[T], work: Callable[[], Awaitable[T]]) -> None:
        try:
            flight.results.append(await work())
        except Exception as error:  # handed to everyone who waits, not swallowed
            flight.error = error
        finally:
            del self._running[key]
            flight.landed.set()
