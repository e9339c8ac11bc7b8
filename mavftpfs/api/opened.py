"""An open file of a vehicle, as the Python files above it need it. Layer: api."""

from __future__ import annotations

import logging
from collections.abc import Callable

import trio

from mavftpfs.api.errors import translated, whereabouts
from mavftpfs.client.files import File, written
from mavftpfs.client.mounted import CLOSING_TIME, WITHDRAWAL_TIME
from mavftpfs.shared.errors import MavftpfsError, NotDelivered

log = logging.getLogger("mavftpfs.api")

PIECE = 1 << 20
"""Bytes of one read while a file is read to its end."""


class Opened:
    """An open file. All methods raise OSErrors (see api.errors). All but `size` run in the event loop.

    Attributes:
        name: for people. writable: whether it may be changed by this. there: after a close that failed, as
            NotDelivered.on_vehicle.
    """

    def __init__(self, name: str, file: File, *, writable: bool, forget: Callable[[Opened], None]) -> None:
        """`forget(self)` is called when it is closed."""
        self.name = name
        self.writable = writable
        self._file = file
        self._forget = forget
        self._failure: BaseException | None = None
        self._closed = False
        self._abandoned = False
        self._changed = False
        self.there: bool | None = None

    @property
    def closed(self) -> bool:
        """Whether it is closed, and any error of that was raised."""
        return self._closed

    @property
    def size(self) -> int:
        """Bytes, as programs see it now."""
        return self._file.size

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end."""
        with translated():
            return await self._file.read(offset, size)

    async def read_to_end(self, offset: int) -> bytes:
        """Return all from `offset` on."""
        parts = []
        while data := await self.read(offset, PIECE):
            parts.append(data)
            offset += len(data)
        return b"".join(parts)

    async def write(self, offset: int | None, data: bytes | memoryview) -> int:
        """Take all of `data`, at the end if no offset is given; return the offset behind it."""
        with translated():
            self._changed = True
            try:
                offset = self._file.size if offset is None else offset
                return offset + await self._file.write(offset, data)
            except BaseException as exc:
                self._failure = exc
                raise

    def fail(self, error: BaseException) -> None:
        """Have `close` withdraw what was written, because of this error."""
        self._failure = self._failure or error

    async def truncate(self, size: int) -> None:
        """Cut or extend it."""
        with translated():
            self._changed = True
            try:
                await self._file.truncate(size)
            except BaseException as exc:
                self._failure = exc
                raise

    async def close(self) -> None:
        """Deliver what was written; or have nothing of it on the card, and raise NotDelivered.

        Raises:
            NotDelivered. Also if the file was abandoned.
        """
        if self._closed:
            with translated():
                self._require_not_abandoned()
            return
        self._closed = True
        self._forget(self)
        with translated():
            if self.writable:
                async with written(self._file, self._on_taken_back):
                    self._require_whole()
            else:
                with trio.CancelScope(deadline=trio.current_time() + CLOSING_TIME, shield=True):
                    await self._file.release()

    def _on_taken_back(self, there: bool | None) -> None:
        self.there = there

    def _require_whole(self) -> None:
        """Raise the error of an earlier write: a part of the file must not pass for the whole."""
        if isinstance(self._failure, MavftpfsError):
            raise self._failure
        if self._failure is not None:
            raise MavftpfsError(f"{self.name}: writing it was interrupted")

    def _require_not_abandoned(self) -> None:
        if self._abandoned and self.writable:
            raise NotDelivered(f"{self.name} was given up before it was closed", there=self.there)

    async def abandon(self) -> None:
        """Close it, and withdraw what was written; log it if that cannot be done. Twice is harmless. Raises
        no MavftpfsError."""
        if self._closed:
            return
        self._closed = self._abandoned = True
        self._forget(self)
        with trio.CancelScope(deadline=trio.current_time() + WITHDRAWAL_TIME, shield=True):
            self.there = await self._file.give_up()
        if self._changed and self.there is not False:
            log.error("%s: %s", self.name, whereabouts(None))
