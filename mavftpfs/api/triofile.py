"""Python's files for trio programs: each method in a thread, as trio.open_file has it. Layer: api."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable
from types import TracebackType
from typing import IO, Any, TypeVar

import trio

from mavftpfs.api.errors import NotDelivered, note_or_raise
from mavftpfs.api.opened import Opened

ResultT = TypeVar("ResultT")


class AsyncFile:
    """An open file, binary or text. If its task is cancelled it is closed without delivery, and what was
    written is withdrawn; a file of trio.open_file would go on and deliver.

    Attributes:
        wrapped: the file of which these are the methods.
    """

    def __init__(self, wrapped: IO[Any], opened: Opened) -> None:
        self.wrapped = wrapped
        self._opened = opened
        # Of its own: the thread waits for the event loop, which needs threads of the common limit.
        self._limit = trio.CapacityLimiter(1)

    @property
    def name(self) -> str:
        """The path."""
        return self._opened.name

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return self.wrapped.closed

    async def read(self, size: int = -1) -> Any:
        """See io.TextIOBase.read and io.BufferedIOBase.read."""
        return await self._in_thread(self.wrapped.read, size)

    async def readline(self, size: int = -1) -> Any:
        """See io.IOBase.readline."""
        return await self._in_thread(self.wrapped.readline, size)

    async def readlines(self) -> list[Any]:
        """See io.IOBase.readlines."""
        return await self._in_thread(self.wrapped.readlines)

    async def readinto(self, buffer: Any) -> int:
        """See io.BufferedIOBase.readinto."""
        readinto: Callable[[Any], int] = self.wrapped.readinto  # type: ignore[attr-defined]
        return await self._in_thread(readinto, buffer)

    async def write(self, data: Any) -> int:
        """See io.TextIOBase.write and io.BufferedIOBase.write."""
        return await self._in_thread(self.wrapped.write, data)

    async def writelines(self, lines: Iterable[Any]) -> None:
        """See io.IOBase.writelines."""
        await self._in_thread(self.wrapped.writelines, lines)

    async def seek(self, offset: int, whence: int = 0) -> int:
        """See io.IOBase.seek."""
        return await self._in_thread(self.wrapped.seek, offset, whence)

    async def tell(self) -> int:
        """See io.IOBase.tell."""
        return await self._in_thread(self.wrapped.tell)

    async def truncate(self, size: int | None = None) -> int:
        """See io.IOBase.truncate."""
        return await self._in_thread(self.wrapped.truncate, size)

    async def flush(self) -> None:
        """Hand on what is buffered; it is delivered by aclose."""
        await self._in_thread(self.wrapped.flush)

    async def aclose(self) -> None:
        """Return when what was written is on the card, checked.

        Raises:
            NotDelivered: it is not; `on_vehicle` says what is there.
        """
        try:
            await self._in_thread(self.wrapped.close)
        except trio.Cancelled:
            await self._opened.abandon()
            raise

    async def __aenter__(self) -> AsyncFile:
        """Return the file."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Close it. If the body was interrupted, that error stays, with a note of what became of the file."""
        try:
            await self.aclose()
        except NotDelivered as exc:
            note_or_raise(exc, error)

    def __aiter__(self) -> AsyncIterator[Any]:
        """Yield the lines."""
        return self

    async def __anext__(self) -> Any:
        """Return the next line."""
        line = await self.readline()
        if not line:
            raise StopAsyncIteration
        return line

    async def _in_thread(self, function: Callable[..., ResultT], *args: Any) -> ResultT:
        return await trio.to_thread.run_sync(function, *args, limiter=self._limit)
