"""An event loop in a thread of its own, and calls into it from any other. Layer: api.

A call that waits can be interrupted: Ctrl-C cancels it, and it ends in order. A finalizer may not wait, so it
posts. The thread is a daemon: when the interpreter ends it does not wait for the thread, but closes what is
open, for EXIT_PATIENCE at most.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager, suppress
from typing import Any, Generic, Protocol, TypeVar

import trio

T = TypeVar("T")
ResultT = TypeVar("ResultT")

EXIT_PATIENCE = 10.0
"""Seconds that the end of the interpreter waits for the sessions to be closed."""


class Portal(Protocol):
    """A way from threads into an event loop."""

    def call(self, function: Callable[..., Awaitable[ResultT]], *args: Any) -> ResultT:
        """Have an async function run in the loop; return its result, or raise its error."""

    def post(self, function: Callable[..., Awaitable[None]], *args: Any) -> None:
        """Have a function run, and do not wait. For finalizers: from any thread, also the loop's, at any
        time."""


class TaskPortal:
    """A Portal of a trio program, for the threads that trio starts."""

    def __init__(self, nursery: trio.Nursery) -> None:
        """`nursery`: runs what is posted."""
        self._nursery = nursery
        self._token = trio.lowlevel.current_trio_token()

    def call(self, function: Callable[..., Awaitable[ResultT]], *args: Any) -> ResultT:
        """See Portal. Cancelling the task that waits for the thread cancels this, too."""
        return trio.from_thread.run(function, *args)

    def post(self, function: Callable[..., Awaitable[None]], *args: Any) -> None:
        """See Portal."""
        with suppress(trio.RunFinishedError):
            self._token.run_sync_soon(_start, self._nursery, function, args)


def _start(nursery: trio.Nursery, function: Callable[..., Awaitable[None]], args: tuple[Any, ...]) -> None:
    with suppress(RuntimeError):  # it has just been closed
        nursery.start_soon(function, *args)


class Closed(ValueError):
    """The event loop has ended, or was told to."""


class _Call(Generic[ResultT]):
    """One call, from its start in a thread to its end in the loop."""

    def __init__(self, function: Callable[..., Awaitable[ResultT]], args: tuple[Any, ...]) -> None:
        self._function = function
        self._args = args
        self._results: list[ResultT] = []
        self.error: BaseException | None = None
        self.scope = trio.CancelScope()
        self.done = threading.Event()

    async def run(self) -> None:
        """Run in the loop. Raises nothing but Cancelled."""
        try:
            with self.scope:
                try:
                    self._results.append(await self._function(*self._args))
                except Exception as exc:  # raised again in the thread that waits
                    self.error = exc
        finally:
            self.done.set()

    def result(self) -> ResultT:
        """Return the result, or raise the error."""
        if self.error is not None:
            raise self.error
        if not self._results:
            raise Closed("the connection was closed meanwhile")
        return self._results[0]


class LoopThread(Generic[T]):
    """Runs an async context in a thread, and calls from other threads in it. A Portal.

    Attributes:
        value: what the context gives.
    """

    def __init__(self, context: Callable[[], AbstractAsyncContextManager[T]], name: str) -> None:
        """Start, and wait until the context is entered; raises what that raises. name: for people."""
        self._context = context
        self._name = name
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._calls: set[_Call[Any]] = set()
        self._token: trio.lowlevel.TrioToken | None = None
        self._nursery: trio.Nursery | None = None
        self._scope = trio.CancelScope()
        self._stopping = False
        self._stopped = trio.Event()
        self._ready = threading.Event()
        self._ended = threading.Event()
        self._error: BaseException | None = None
        self._values: list[T] = []
        self._thread = threading.Thread(target=self._run, name=f"mavftpfs {name}", daemon=True)
        self._thread.start()
        try:
            self._ready.wait()
        except BaseException:  # Ctrl-C
            self.close()
            raise
        if not self._values:
            self._ended.wait()
            assert self._error is not None
            raise self._error
        _running.add(self)

    @property
    def value(self) -> T:
        """What the context gave."""
        return self._values[0]

    @property
    def closed(self) -> bool:
        """Whether nothing can be called any more."""
        return self._stopping or self._ended.is_set()

    # --- from any thread

    def call(self, function: Callable[..., Awaitable[ResultT]], *args: Any) -> ResultT:
        """See Portal.

        Raises:
            RuntimeError: after a fork, or from the loop's own thread. Closed. Else what the function raises.
        """
        self._require_usable()
        call = _Call(function, args)
        with self._lock:
            if self.closed:
                raise self._closed()
            self._calls.add(call)
        try:
            self._start(call)
            self._wait(call)
            return call.result()
        except trio.RunFinishedError:
            raise self._closed() from None
        finally:
            self._calls.discard(call)

    def post(self, function: Callable[..., Awaitable[None]], *args: Any) -> None:
        """See Portal. Does nothing after the loop has ended."""
        if os.getpid() == self._pid and not self._ended.is_set():
            with suppress(trio.RunFinishedError):
                self._start(_Call(function, args))

    def close(self, *, patience: float | None = None) -> None:
        """Leave the context, and wait until it is left. patience: seconds to wait at most."""
        if os.getpid() != self._pid:
            return
        self.stop()
        if threading.current_thread() is not self._thread:
            self._ended.wait(patience)

    def stop(self) -> None:
        """Have the context left, and do not wait for that. For finalizers."""
        if os.getpid() != self._pid:
            return
        _running.discard(self)
        with self._lock:
            self._stopping = True
            if self._token is not None:
                with suppress(trio.RunFinishedError):
                    self._token.run_sync_soon(self._stop)

    # --- inside

    def _require_usable(self) -> None:
        if os.getpid() != self._pid:
            raise RuntimeError(
                f"the connection to {self._name} was made before a fork and belongs to the other process: "
                "connect in each process; those of one user share the port"
            )
        if threading.current_thread() is self._thread:
            raise RuntimeError("a call from the connection's own thread would wait for itself")

    def _start(self, call: _Call[Any]) -> None:
        """Raises: trio.RunFinishedError."""
        token = self._token
        assert token is not None
        token.run_sync_soon(self._spawn, call)

    def _spawn(self, call: _Call[Any]) -> None:
        assert self._nursery is not None
        try:
            self._nursery.start_soon(call.run)
        except RuntimeError:  # it has just been closed
            call.done.set()

    def _wait(self, call: _Call[Any]) -> None:
        try:
            call.done.wait()
        except BaseException:  # Ctrl-C: let the call end in order; a second Ctrl-C does not wait
            if self._token is not None:
                with suppress(trio.RunFinishedError):
                    self._token.run_sync_soon(call.scope.cancel)
            call.done.wait()
            raise

    def _closed(self) -> BaseException:
        if self._error is not None:
            return self._error
        return Closed(f"the connection to {self._name} is closed")

    # --- the loop's thread

    def _run(self) -> None:
        try:
            trio.run(self._main)
        except BaseException as exc:  # raised again in the threads that wait
            self._error = _first(exc)
        finally:
            with self._lock:
                self._ended.set()
                left = list(self._calls)
            for call in left:
                call.error = call.error or self._error
                call.done.set()
            self._ready.set()

    async def _main(self) -> None:
        with self._lock:
            self._token = trio.lowlevel.current_trio_token()
            if self._stopping:
                return
        with self._scope:
            async with self._context() as value, trio.open_nursery() as self._nursery:
                self._values.append(value)
                self._ready.set()
                await self._stopped.wait()
                self._nursery.cancel_scope.cancel()

    def _stop(self) -> None:
        self._stopped.set()
        if not self._values:
            self._scope.cancel()


def _first(error: BaseException) -> BaseException:
    """Return the first of several errors."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


_running: set[LoopThread[Any]] = set()


def _close_all() -> None:
    """Close, as the interpreter ends, all connections that are open, with their vehicles' sessions."""
    loops = [loop for loop in _running if not loop.closed]
    for loop in loops:
        loop.stop()
    deadline = time.monotonic() + EXIT_PATIENCE
    for loop in loops:
        loop.close(patience=max(0.0, deadline - time.monotonic()))


atexit.register(_close_all)
