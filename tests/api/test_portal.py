"""api.portal: calls into an event loop that ends, breaks, or is closed by another thread."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager

import pytest
import trio

from mavftpfs.api.portal import Closed, LoopThread

PATIENCE = 30.0


def context(
    broken: trio.Event | None = None, left: list[str] | None = None
) -> Callable[[], AbstractAsyncContextManager[str]]:
    """Return a context of which a task fails when `broken` is set. left: gets a word at the end of its
    exit."""

    @asynccontextmanager
    async def made() -> AsyncIterator[str]:
        async def fail() -> None:
            assert broken is not None
            await broken.wait()
            raise ConnectionResetError("the link broke")

        async with trio.open_nursery() as nursery:
            if broken is not None:
                nursery.start_soon(fail)
            yield "value"
            nursery.cancel_scope.cancel()
        await trio.sleep(0.1)
        if left is not None:
            left.append("left")

    return made


class Caller:
    """A thread with a call that waits for ever. error: what the call ended with."""

    def __init__(self, loop: LoopThread[str]) -> None:
        self.error: BaseException | None = None
        self._loop = loop
        began = threading.Event()

        async def sleep() -> None:
            began.set()
            await trio.sleep_forever()

        self._thread = threading.Thread(target=self._call, args=(sleep,))
        self._thread.start()
        assert began.wait(PATIENCE)

    def _call(self, function: Callable[[], object]) -> None:
        try:
            self._loop.call(function)  # type: ignore[arg-type]
        except Exception as exc:
            self.error = exc

    def join(self) -> None:
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


def test_a_call_that_waits_gets_the_error_that_ends_the_loop() -> None:
    broken = trio.Event()
    loop = LoopThread(context(broken), "here")
    caller = Caller(loop)

    async def break_it() -> None:
        broken.set()

    loop.post(break_it)
    caller.join()
    assert isinstance(caller.error, ConnectionResetError)
    with pytest.raises(ConnectionResetError):
        loop.call(trio.lowlevel.checkpoint)
    assert loop.closed
    loop.close()


def test_close_ends_the_calls_of_other_threads_and_leaves_the_context_whole() -> None:
    left: list[str] = []
    loop = LoopThread(context(left=left), "here")
    callers = [Caller(loop) for _ in range(3)]
    loop.close()
    assert left == ["left"]
    for caller in callers:
        caller.join()
        assert isinstance(caller.error, Closed)
    with pytest.raises(Closed, match="the connection to here is closed"):
        loop.call(trio.lowlevel.checkpoint)
    loop.post(trio.lowlevel.checkpoint)
