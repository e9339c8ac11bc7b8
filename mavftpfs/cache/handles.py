"""Open files of a mount: one handle for each open(). Layer: cache.

All handles of a file share its content and its size, so a reader sees at once what a writer wrote. Each
handle has a readahead of its own.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial

from mavftpfs.cache import delivery, reading, uploads, writing
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import File, State
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.readahead import Readahead
from mavftpfs.shared.errors import (
    Armed,
    FileTooLarge,
    LocalProtocolError,
    MavftpfsError,
)

MAX_FILE = 2**32 - 1
"""Bytes: the protocol's offsets have 32 bits; ArduPilot's servers refuse from 2 GiB on (servers.md 8)."""


class ReadHandle(OpenFile):
    """One open() for reading."""

    def __init__(self, card: Card, file: File, *, same: bool) -> None:
        """same: the kernel may keep pages that it has of the file."""
        self._card = card
        self.file = file
        self._readahead = Readahead(file.size)
        self._closed = self._ended = False
        self._keep_cache = same and file.in_kernel and not file.is_local
        file.in_kernel = not file.is_local
        file.handles += 1
        card.keep(file)

    @property
    def size(self) -> int:
        """Bytes: as the file was last opened by any program, or as programs changed it."""
        return self.file.size

    @property
    def keep_cache(self) -> bool:
        """Whether the kernel's pages are still right."""
        return self._keep_cache

    @property
    def has_name(self) -> bool:
        """See OpenFile.has_name."""
        return self.file.has_name

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the file.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        while True:
            if self._closed:
                raise LocalProtocolError("read of a closed handle")
            self.file.require_alive()
            stop = min(offset + size, self.size)
            if offset >= stop:
                return b""
            data = await reading.read(self._card, self.file, offset, stop, self._readahead, ended=self._ended)
            self._ended |= stop == self.size
            if stop == min(offset + size, self.size):  # else its end moved meanwhile
                return data

    async def fsync(self, *, ends_write: bool = False) -> None:
        """Deliver what was written through any handle; see OpenFile.fsync.

        A shell does not look at the result of a close. So `sync FILE` also fails while a broken file of this
        name is kept.

        Raises:
            WriteFailed: it is. Otherwise as delivery.deliver.
        """
        await self._deliver(ends_write=ends_write)
        if self.file.has_name and (broken := self._card.find_broken(self.file.path)) is not None:
            broken.require_not_broken()

    async def release(self) -> None:
        """Deliver what was written by this handle, and close it. Bytes that could not be delivered stay held.

        Raises:
            Why it is not delivered.
        """
        if self._closed:
            return
        try:
            if self.writable:
                await self._deliver(closing=True)
        finally:
            self.close()

    def close(self) -> None:
        """Close without delivering; closing twice is harmless."""
        if self._closed:
            return
        self._closed = True
        file = self.file
        file.handles -= 1
        file.writers -= self.writable
        file.changers.discard(self)
        if not file.handles:
            on_closed(self._card, file)

    async def _deliver(self, *, closing: bool = False, ends_write: bool = False) -> None:
        await delivery.deliver(self._card, self.file)


def on_closed(card: Card, file: File) -> None:
    """Let go of a file whose last handle was closed."""
    if not file.undelivered:
        file.blocks.on_failed(LocalProtocolError(f"{file.path!r} was closed while it was read"))
        file.blocks.close_reader()
    if file.has_name:
        card.maybe_forget(file)
        return
    card.live.pop(file, None)
    if file not in card.broken:
        file.forget_content()


class WriteHandle(ReadHandle):
    """One open() for writing (see cache.openfile.OpenFile)."""

    writable = True

    def __init__(self, card: Card, file: File) -> None:
        super().__init__(card, file, same=False)
        if not file.writers:
            file.delivered_since_open = False
        file.writers += 1

    @property
    def verified(self) -> str:
        """See OpenFile.verified."""
        return self.file.verified

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data`; see OpenFile.write."""
        stop = offset + len(data)
        async with self._changing(stop) as file:
            file.require_not_stale()
            self._card.throttle.require_sendable(file, max(file.size, stop))
            writing.write(self._card, file, offset, data)
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut or extend; see OpenFile.truncate."""
        async with self._changing(size, empties=not size and self.file.size > 0) as file:
            file.require_alive()
            if size:
                file.require_not_stale()
            if size == file.size and file.state is not State.STALE:
                return
            if size:
                self._card.throttle.require_sendable(file, size)
            writing.truncate(self._card, file, size)

    def on_made(self) -> None:
        """Note that this handle made the file, which is a change of it."""
        self.file.changers.add(self)

    async def flush(self) -> None:
        """Deliver, but not a file that was only emptied: bytes are about to come.

        A shell empties the file, closes a copy of the descriptor, and only then writes.

        Raises:
            Why it is not delivered.
        """
        if self.file.size > 0 or self.file.error is not None:
            await self._deliver(closing=True)

    async def take_back(self) -> bool | None:
        """See OpenFile.take_back. May take as long as a request that is not answered."""
        try:
            return await delivery.withdraw(self._card, self.file)
        finally:
            self.close()

    # --- inside

    @asynccontextmanager
    async def _changing(self, size: int, *, empties: bool = False) -> AsyncIterator[File]:
        """Hold the file's lock while the body changes the file. If the body fails, or the wait for room
        does, and this handle changed the file before, the file breaks (`_break`).

        size: bytes that the file will have at least. empties: the body empties the file: an upload
        that is under way is cancelled, and the change needs no room.

        Raises:
            As _have_room; WriteFailed.
        """
        file, refused = self.file, None
        if self._closed:
            raise LocalProtocolError("write to a closed handle")
        if not empties:
            try:
                await self._have_room(size)
            except MavftpfsError as error:
                refused = error
        async with file.preempt(self._card.options.op_deadline) if empties else file.lock:
            try:
                file.require_not_broken()
                if refused is not None:
                    raise refused
                self._card.require_disarmed()
                yield file
            except MavftpfsError as error:
                await self._break(error)
                raise
            self.on_made()
            await uploads.push(self._card, file)

    async def _break(self, error: MavftpfsError) -> None:
        """Break the file, because a program is told that a change of it failed, if this handle made changes
        that the vehicle lacks. The caller has the file's lock.

        A new file that is too large at once does not break, because the program can go on with less.
        """
        file = self.file
        if isinstance(error, FileTooLarge) and file.is_new_and_empty:
            return
        if self in file.changers and file.undelivered and file.state is State.DIRTY:
            await writing.break_off(self._card, file, error)

    async def _deliver(self, *, closing: bool = False, ends_write: bool = False) -> None:
        """Deliver for a program. If the rest of the old file cannot be fetched, there is no whole file that
        could be delivered later, so the file breaks.

        closing: this is a flush or a release. If another program empties the file meanwhile, that program's
        close delivers it, because bytes are about to come.
        """
        file = self.file

        def wanted() -> bool:
            return not closing or file.size > 0 or self in file.changers or file.writers == 1

        try:
            await delivery.deliver(self._card, file, wanted=wanted)
        except MavftpfsError as error:
            lacks_base = file.is_local and not file.content.whole and not isinstance(error, Armed)
            if ends_write or lacks_base:
                async with file.lock:
                    await self._break(error)
            raise

    async def _have_room(self, size: int) -> None:
        """Wait until not too much is un-ACKed. size: bytes that the file will have.

        Raises:
            FileTooLarge, Armed. Otherwise as delivery.deliver, when nothing moves.
        """
        if size > MAX_FILE:
            raise FileTooLarge(f"no vehicle takes files of more than {MAX_FILE} bytes")
        throttle = self._card.throttle
        while throttle.is_full(self.file):
            self._card.require_disarmed()
            if not await throttle.wait():
                await throttle.while_full(self.file, partial(delivery.deliver, self._card, self.file))
