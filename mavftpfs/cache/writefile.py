"""Open files of a mount that can be written. Layer: cache.

All handles of a file share its node, so a reader sees at once what a writer wrote. A handle for reading has
its own readahead, and opens the vehicle's file again after we changed it. If others replaced the file, the
handle reads nothing more, whatever is written under the path later: that belongs to another file.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial

from mavftpfs.cache.base import open_node, read_base
from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.cache.draft import Draft, State, Where
from mavftpfs.cache.files import VersionHandle
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared.errors import Armed, FileChanged, FileTooLarge, LocalProtocolError, MavftpfsError

TRIES = 3
"""How often a read starts again because the file was delivered meanwhile."""

MAX_FILE = 2**32 - 1
"""Bytes: the protocol's offsets have 32 bits; ArduPilot's servers refuse from 2 GiB on (servers.md 8)."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What the handles of one mount share."""

    context: Context
    deliverer: Deliverer
    throttle: Throttle


class ReadFile(OpenFile):
    """One open() for reading: of the draft if there is one, else of the vehicle's file."""

    def __init__(self, parts: Parts, node: Node, handle: VersionHandle | None = None) -> None:
        self._parts = parts
        self._context = parts.context
        self._node = node
        self._handle = handle
        self._generation = node.generation
        self._closed = False
        node.handles += 1

    @property
    def size(self) -> int:
        """Bytes, as programs see it now."""
        if self._node.draft is not None:
            return self._node.draft.size
        return 0 if self._handle is None else self._handle.size

    @property
    def direct_io(self) -> bool:
        """Whether the kernel's pages could be those of another file that had the path."""
        if self._context.nodes.has_another(self._node.path):
            return True
        return self._node.draft is None and self._handle is not None and self._handle.direct_io

    @property
    def keep_cache(self) -> bool:
        """Whether the kernel's pages are still right."""
        return self._node.draft is None and self._handle is not None and self._handle.keep_cache

    @property
    def broken(self) -> bool:
        """See OpenFile.broken."""
        return self._node.broken

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the file.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        if self._closed:
            raise LocalProtocolError("read of a closed handle")
        node = self._node
        for tries_left in reversed(range(TRIES)):
            state = (node.generation, node.draft)
            try:
                if node.removed:
                    node.require_not_stale()
                if self._handle is not None and state == (self._generation, None):
                    return await self._handle.read(offset, size)
                return await self._read_changed(offset, size)
            except (FileChanged, LocalProtocolError):  # LocalProtocolError: a delivery closed the base
                if self._closed or state == (node.generation, node.draft) or not tries_left:
                    raise
        raise AssertionError

    async def fsync(self, *, ends_write: bool = False) -> None:
        """Deliver what was written through any handle; see OpenFile.fsync."""
        await self._deliver(ends_write=ends_write)

    async def release(self) -> None:
        """Deliver what was written by this handle, and close it. What could not be delivered stays held.

        Raises:
            Why it is not delivered.
        """
        if self._closed:
            return
        try:
            if self.writable:
                await self._deliver()
        finally:
            self.close()

    def close(self) -> None:
        """Close without delivering; closing twice is harmless."""
        if self._closed:
            return
        self._closed = True
        if self._handle is not None:
            self._handle.close()
        node = self._node
        node.handles -= 1
        node.writers -= self.writable
        if node.handles:
            return
        if node.removed:
            if self._context.nodes.broken.get(node.path) is not node:
                node.forget_draft()
            return
        self._context.nodes.maybe_forget(node)

    # --- inside

    async def _deliver(self, *, ends_write: bool = False) -> None:
        await self._parts.deliverer.deliver(self._node)

    async def _read_changed(self, offset: int, size: int) -> bytes | memoryview:
        """Read a file that was written here since the handle was opened, or that is not open yet."""
        node = self._node
        handle = self._handle
        if node.draft is not None:
            return await self._read_draft(node.draft, offset, offset + size)
        if handle is not None:
            self._handle = None
            handle.close()
        self._generation = node.generation
        self._handle = await open_node(self._context, node)
        return await self._handle.read(offset, size)

    async def _read_draft(self, draft: Draft, start: int, stop: int) -> bytes | memoryview:
        parts: list[bytes | memoryview] = []
        at = start
        while at < min(stop, draft.size):
            # Asked again after each await: the draft may have been written meanwhile.
            where, a, b = draft.segments(at, stop)[0]
            if where is Where.BASE:
                parts.append(await read_base(self._context, self._node, a, b))
                if self._node.draft is not draft:
                    raise FileChanged(f"what was changed of {self._node.path!r} was given up")
            else:
                parts.append(draft.local_bytes(a, b))
            at = b
        return parts[0] if len(parts) == 1 else b"".join(parts)


class WriteFile(ReadFile):
    """One open() for writing (see cache.openfile.OpenFile)."""

    writable = True

    def __init__(self, parts: Parts, node: Node) -> None:
        super().__init__(parts, node)
        if not node.writers:
            node.delivered_since_open = False
        node.writers += 1
        self._changed: int | None = None  # the node's generation when this handle changed the file
        self._verified = ""

    @property
    def verified(self) -> str:
        """See OpenFile.verified."""
        return self._verified

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data`; see OpenFile.write."""
        stop = offset + len(data)
        async with self._changing(stop) as draft:
            self._node.require_not_stale()
            self._parts.throttle.require_sendable(draft, max(draft.size, stop))
            draft.write(offset, data)
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut or extend; see OpenFile.truncate."""
        node = self._node
        assert node.draft is not None
        async with self._changing(size, empties=not size and node.draft.size > 0) as draft:
            if node.removed or size:
                node.require_not_stale()
            if size == draft.size and draft.state is not State.STALE:
                return
            if size:
                self._parts.throttle.require_sendable(draft, size)
            draft.truncate(size)
            if not (size or node.removed):
                self._context.nodes.forget_broken(node.path)

    def on_made(self) -> None:
        """Note that this handle made the file, which is a change of it."""
        self._changed = self._node.generation

    async def flush(self) -> None:
        """Deliver, but not a file that was only emptied: bytes are about to come.

        A shell empties the file, closes a copy of the descriptor, and only then writes.

        Raises:
            Why it is not delivered.
        """
        draft = self._node.draft
        if draft is not None and (draft.size > 0 or self._node.error is not None):
            await self._deliver()

    async def take_back(self) -> bool | None:
        """See OpenFile.take_back. May take as long as a request that is not answered."""
        try:
            return await self._parts.deliverer.withdraw(self._node)
        finally:
            self.close()

    # --- inside

    @asynccontextmanager
    async def _changing(self, size: int, *, empties: bool = False) -> AsyncIterator[Draft]:
        """Hold the file's lock while the body changes the draft. If the body fails, or there is no room for
        it, the file breaks, if this handle changed it before.

        size: bytes that the file will have at least. empties: the body empties the file: the bytes on their
        way to the vehicle are not wanted any more, and new ones need no room.

        Raises:
            As _have_room; WriteFailed.
        """
        node, refused = self._node, None
        if self._closed:
            raise LocalProtocolError("write to a closed handle")
        if not empties:
            try:
                await self._have_room(size)
            except MavftpfsError as error:
                refused = error
        patience = self._context.options.op_deadline
        async with node.claim(patience) if empties else node.lock:
            try:
                node.require_not_broken()
                if refused is not None:
                    raise refused
                self._context.require_disarmed()
                assert node.draft is not None
                yield node.draft
            except MavftpfsError as error:
                await self._break(error)
                raise
            self._changed = node.generation
            await self._parts.deliverer.push(node)

    async def _break(self, error: MavftpfsError) -> None:
        """Break the file, because a program is told that a change of it failed, if this handle made changes
        that the vehicle lacks. The caller has the node's lock.

        A new file that is too large at once does not break, because the program can go on with less.
        """
        node = self._node
        stale = node.draft is not None and node.draft.state is State.STALE
        if isinstance(error, FileTooLarge) and node.is_new_and_empty:
            return
        if self._changed == node.generation and node.undelivered and not stale:
            await self._parts.deliverer.break_off(node, error)

    async def _deliver(self, *, ends_write: bool = False) -> None:
        """Deliver for a program. If the rest of the old file cannot be fetched, there is no whole file that
        could be delivered later, so the file breaks."""
        node, draft = self._node, self._node.draft
        try:
            await self._parts.deliverer.deliver(node)
            self._verified = "" if draft is None else draft.verified
        except MavftpfsError as error:
            lacks_base = node.draft is not None and not node.draft.whole and not isinstance(error, Armed)
            if ends_write or lacks_base:
                async with node.lock:
                    await self._break(error)
            raise

    async def _have_room(self, size: int) -> None:
        """Wait until not too much is un-ACKed. size: bytes that the file will have.

        Raises:
            FileTooLarge, Armed. Else as Deliverer.deliver, when nothing moves.
        """
        if size > MAX_FILE:
            raise FileTooLarge(f"no vehicle takes files of more than {MAX_FILE} bytes")
        throttle = self._parts.throttle
        while throttle.is_full(self._node):
            self._context.require_disarmed()
            if not await throttle.wait():
                await throttle.while_full(self._node, partial(self._parts.deliverer.deliver, self._node))
