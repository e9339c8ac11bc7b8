"""An event loop in a thread of its own, and calls to it from other threads. Layer: api.

Ctrl-C cancels a call that waits, and the call cleans up before it returns. A finalizer may not wait, so it
posts. The thread is a daemon. At the interpreter's end `_close_all` closes everything that is open, within
EXIT_PATIENCE.
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
"""Seconds that the end of the interpreter waits for sessions to close."""


class Closed(ValueError):
    """The event loop has ended, or has been told to end."""


class _Call(Generic[ResultT]):
    """A call from a thread into the loop. scope: cancels the call."""

    def __init__(self, function: Callable[..., Awaitable[ResultT]], args: tuple[Any, ...]) -> None:
        self._function = function
        self._args = args
        self.scope = trio.CancelScope()
        self.outcome: Future[ResultT] = Future()

    async def run(self) -> None:
        """Run in the loop. Never raises, except Cancelled."""
        try:
            with self.scope:
                try:
                    self.outcome.set_result(await self._function(*self._args))
                except Exception as exc:  # `wait` raises the error again in its own thread
                    self.outcome.set_exception(exc)
        finally:
            self.end()

    def end(self) -> None:
        """Release the thread that waits; harmless if the call has a result or an error."""
        if self.outcome.cancel():
            self.outcome.set_running_or_notify_cancel()  # otherwise `wait` would wait on


class LoopThread(Generic[T]):
    """An async context in a thread of its own, and the calls of other threads in that context.

    | | from | waits for |
    |---|---|---|
    | `call` | any thread but the loop's | the result |
    | `post`, `stop` | any thread, at any time: for finalizers | nothing |
    | `close` | any thread | the end of the loop; in the loop's own thread nothing |

    After a fork, in the child process, `call` raises and the others do nothing. `stop` cancels the running
    calls and leaves the context. The context's own exit always runs to its end; then the loop and the thread
    end.

    Attributes:
        value: the result of entering the context.
    """

    def __init__(self, context: Callable[[], AbstractAsyncContextManager[T]], name: str) -> None:
        """Start the thread, and wait until the context is entered; raise its error. name: for people."""
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
        """Whether every further call raises."""
        return self._stopping or self._ended.done()

    # --- from any thread

    def call(self, function: Callable[..., Awaitable[ResultT]], *args: Any) -> ResultT:
        """Run an async function in the loop; return its result. Ctrl-C cancels the call and waits for its
        cleanup; a second Ctrl-C does not wait.

        Raises:
            RuntimeError: after a fork, or from the loop's own thread. Closed. Also the function's own errors.
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
            self.close()  # which knows the reason once the thread has ended
            raise self._reason()
        return call.outcome.result()

    def post(self, function: Callable[..., Awaitable[None]], *args: Any) -> None:
        """Run a function in the loop, without waiting for it; after the loop's end do nothing."""
        if os.getpid() == self._pid:
            self._soon(self._spawn, _Call(function, args))

    def close(self, *, patience: float | None = None) -> None:
        """Leave the context, and wait until the thread has ended. patience: seconds to wait at most."""
        self.stop()
        if os.getpid() == self._pid and threading.current_thread() is not self._thread:
            wait([self._ended], timeout=patience)

    def stop(self) -> None:
        """Have the context left, without waiting. For finalizers."""
        if os.getpid() == self._pid:
            self._stopping = True
            _running.discard(self)
            self._soon(self._stop)

    # --- inside

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function in the loop, unless the loop has not begun, or has ended. trio runs all accepted
        functions before it ends."""
        if self._token is not None:
            with suppress(trio.RunFinishedError):
                self._token.run_sync_soon(function, *args)

    def _wait(self, call: _Call[Any]) -> None:
        """Wait for the end of a call, or of the loop."""
        wait([call.outcome, self._ended], return_when=FIRST_COMPLETED)

    def _reason(self) -> BaseException:
        """Return the reason why calls are impossible."""
        return self._error or Closed(f"the connection to {self._name} is closed")

    # --- in the loop's thread

    def _run(self) -> None:
        try:
            trio.run(self._main)
        except BaseException as exc:  # the threads that wait raise it again
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
        """Cancel the calls and the body of the context, or the entering of the context."""
        self._scope.cancel()


def _first(error: BaseException) -> BaseException:
    """Return the first of several errors."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


_running: set[LoopThread[Any]] = set()


def _close_all() -> None:
    """Close all open connections and their vehicles' sessions, as the interpreter ends."""
    loops = list(_running)
    for loop in loops:
        loop.stop()
    deadline = time.monotonic() + EXIT_PATIENCE
    for loop in loops:
        loop.close(patience=max(0.0, deadline - time.monotonic()))


atexit.register(_close_all)
