"""An event loop in a thread of its own, and calls into it from any other. Layer: api.

A call that waits can be interrupted: Ctrl-C cancels it, and it ends in order. A finalizer may not wait, so it
posts. The thread is a daemon. When the interpreter ends, all that is open is closed, for EXIT_PATIENCE at
most.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import AbstractAsyncContextManager, suppress
from typing import Any, Generic, TypeVar

import trio

T = TypeVar("T")
ResultT = TypeVar("ResultT")

EXIT_PATIENCE = 10.0
"""Seconds that the end of the interpreter waits for the sessions to be closed."""


class Closed(ValueError):
    """The event loop has ended, or was told to."""


class _Call(Generic[ResultT]):
    """A call, from a thread into the loop. scope: cancels it."""

    def __init__(self, function: Callable[..., Awaitable[ResultT]], args: tuple[Any, ...]) -> None:
        self._function = function
        self._args = args
        self.scope = trio.CancelScope()
        self.outcome: Future[ResultT] = Future()

    async def run(self) -> None:
        """Run in the loop. Raises nothing but Cancelled."""
        try:
            with self.scope:
                try:
                    self.outcome.set_result(await self._function(*self._args))
                except Exception as exc:  # raised again in the thread that waits
                    self.outcome.set_exception(exc)
        finally:
            self.end()

    def end(self) -> None:
        """Have nobody wait for it any more; it may have a result, or an error."""
        if self.outcome.cancel():
            self.outcome.set_running_or_notify_cancel()  # else `wait` goes on


class LoopThread(Generic[T]):
    """Runs an async context in a thread of its own, and calls from other threads in it.

    | | from | waits for |
    |---|---|---|
    | `call` | any thread but the loop's | the result |
    | `post`, `stop` | any thread, at any time: for finalizers | nothing |
    | `close` | any thread | the end of the loop; in the loop's own thread nothing |

    In another process than its own, after a fork, `call` raises and the others do nothing. `stop` ends the
    calls that are under way, and leaves the context. What the context does at its exit is not cut off. The
    loop and the thread end with it.

    Attributes:
        value: what the context gave.
    """

    def __init__(self, context: Callable[[], AbstractAsyncContextManager[T]], name: str) -> None:
        """Start, and wait until the context is entered; raises what that raises. name: for people."""
        self._context = context
        self._name = name
        self._pid = os.getpid()
        self._token: trio.lowlevel.TrioToken | None = None
        self._nursery: trio.Nursery | None = None
        self._scope = trio.CancelScope()
        self._stopping = False
        self._error: BaseException | None = None
        self._entered: Future[T] = Future()
        self._ended: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, name=f"mavftpfs {name}", daemon=True)
        self._thread.start()
        try:
            self.value = self._entered.result()
        except BaseException:  # also Ctrl-C
            self.close()
            raise
        _running.add(self)

    @property
    def closed(self) -> bool:
        """Whether nothing can be called any more."""
        return self._stopping or self._ended.done()

    # --- from any thread

    def call(self, function: Callable[..., Awaitable[ResultT]], *args: Any) -> ResultT:
        """Have an async function run in the loop; return its result. Ctrl-C ends the call in order; a second
        one does not wait for that.

        Raises:
            RuntimeError: after a fork, or from the loop's own thread. Closed. Else what the function raises.
        """
        if os.getpid() != self._pid:
            raise RuntimeError(
                f"the connection to {self._name} was made before a fork and belongs to the other process: "
                "connect in each process; those of one user share the port"
            )
        if threading.current_thread() is self._thread:
            raise RuntimeError("a call from the connection's own thread would wait for itself")
        if self.closed:
            raise self._reason()
        call = _Call(function, args)
        self._soon(self._spawn, call)
        try:
            self._wait(call)
        except BaseException:
            self._soon(call.scope.cancel)
            self._wait(call)
            raise
        if not call.outcome.done() or call.outcome.cancelled():
            self.close()  # it tells why when it has ended
            raise self._reason()
        return call.outcome.result()

    def post(self, function: Callable[..., Awaitable[None]], *args: Any) -> None:
        """Have a function run, and do not wait; after the loop has ended, do nothing."""
        if os.getpid() == self._pid:
            self._soon(self._spawn, _Call(function, args))

    def close(self, *, patience: float | None = None) -> None:
        """Leave the context, and wait until it is left. patience: seconds to wait at most."""
        self.stop()
        if os.getpid() == self._pid and threading.current_thread() is not self._thread:
            wait([self._ended], timeout=patience)

    def stop(self) -> None:
        """Have the context left, and do not wait for that. For finalizers."""
        if os.getpid() == self._pid:
            self._stopping = True
            _running.discard(self)
            self._soon(self._stop)

    # --- inside

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        """Have a function called in the loop, unless that has not begun, or has ended. What trio takes it
        carries out before it ends."""
        if self._token is not None:
            with suppress(trio.RunFinishedError):
                self._token.run_sync_soon(function, *args)

    def _wait(self, call: _Call[Any]) -> None:
        """Wait for the end of a call, or of the loop."""
        wait([call.outcome, self._ended], return_when=FIRST_COMPLETED)

    def _reason(self) -> BaseException:
        """Return why nothing can be called."""
        return self._error or Closed(f"the connection to {self._name} is closed")

    # --- in the loop's thread

    def _run(self) -> None:
        try:
            trio.run(self._main)
        except BaseException as exc:  # raised again in the threads that wait
            self._error = _first(exc)
        if not self._entered.done():
            self._entered.set_exception(self._reason())
        self._ended.set_result(None)

    async def _main(self) -> None:
        self._token = trio.lowlevel.current_trio_token()
        if self._stopping:
            return
        with self._scope:
            async with self._context() as value, trio.open_nursery() as self._nursery:
                self._scope = self._nursery.cancel_scope
                self._entered.set_result(value)
                await trio.sleep_forever()

    def _spawn(self, call: _Call[Any]) -> None:
        assert self._nursery is not None
        try:
            self._nursery.start_soon(call.run)
        except RuntimeError:  # it has just been closed
            call.end()

    def _stop(self) -> None:
        """Cancel: the calls and the body of the context; or, before it is entered, that."""
        self._scope.cancel()


def _first(error: BaseException) -> BaseException:
    """Return the first of several errors."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


_running: set[LoopThread[Any]] = set()


def _close_all() -> None:
    """Close, as the interpreter ends, all connections that are open, with their vehicles' sessions."""
    loops = list(_running)
    for loop in loops:
        loop.stop()
    deadline = time.monotonic() + EXIT_PATIENCE
    for loop in loops:
        loop.close(patience=max(0.0, deadline - time.monotonic()))


atexit.register(_close_all)
