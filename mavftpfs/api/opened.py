"""An open file of a vehicle, as the Python files above it need it. Layer: api."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mavftpfs.api.errors import translated, whereabouts
from mavftpfs.client.files import File, Writing, close_reader
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.api")

PIECE = 1 << 20
"""Bytes of each read while a file is read to its end."""


class Opened:
    """An open file. All methods raise OSErrors (see api.errors). All but `size` and `fail` run in the event
    loop.

    Attributes:
        name: for people. writable: whether a program may change the file through this object.
    """

    def __init__(self, name: str, file: File, *, writable: bool, forget: Callable[[Opened], None]) -> None:
        """Keep an open file; `close` calls `forget(self)`."""
        self.name = name
        self.writable = writable
        self._file = file
        self._writing = Writing(file)
        self._forget = forget
        self._failure: BaseException | None = None
        self._closed = False
        self._changed = False

    @property
    def closed(self) -> bool:
        """Whether `close` has returned, or raised its error."""
        return self._closed

    @property
    def there(self) -> bool | None:
        """NotDelivered.on_vehicle after a failed close."""
        return self._writing.there

    @property
    def size(self) -> int:
        """The size in bytes that programs see now."""
        return self._file.size

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, or fewer at the end of the file."""
        with translated():
            return await self._file.read(offset, size)

    async def read_to_end(self, offset: int) -> bytes:
        """Return everything from `offset` on."""
        parts = []
        while data := await self.read(offset, PIECE):
            parts.append(data)
            offset += len(data)
        return b"".join(parts)

    async def write(self, offset: int | None, data: bytes | memoryview) -> int:
        """Write all of `data`, at the end if there is no offset; return the offset behind it."""
        with self._changing():
            offset = self._file.size if offset is None else offset
            return offset + await self._file.write(offset, data)

    async def truncate(self, size: int) -> None:
        """Cut the file, or extend it with zeros."""
        with self._changing():
            await self._file.truncate(size)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        self._changed = True
        with translated():
            try:
                yield
            except BaseException as exc:
                self.fail(exc)
                raise

    def fail(self, error: BaseException) -> None:
        """Have `close` discard the changes, because a part of a file must not pass for the whole."""
        self._failure = self._failure or error

    async def close(self) -> None:
        """Put the changes on the card; or leave the card as it was, and raise NotDelivered.

        Raises:
            NotDelivered.
        """
        with translated():
            if self._closed:
                return
            self._end()
            if not self.writable:
                await close_reader(self._file)
            elif self._failure is None:
                await self._writing.deliver()
            elif isinstance(self._failure, MavftpfsError):
                await self._writing.fail(self._failure)
            else:
                await self._writing.fail(MavftpfsError(f"{self.name}: the write was interrupted"))

    async def abandon(self) -> None:
        """Close the file and discard its changes; log a failure to do so. Calling this twice is harmless.
        Never raises MavftpfsError."""
        if self._closed:
            return
        self._end()
        await self._writing.take_back(whole=not self._changed)
        if self.there is None:
            log.error("%s: %s", self.name, whereabouts(None))

    def _end(self) -> None:
        self._closed = True
        self._forget(self)
