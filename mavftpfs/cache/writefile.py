"""Open files of a mount that can be written. Layer: cache.

All handles of a file share its node, so a reader sees at once what a writer wrote. A handle for reading has
its own readahead, and opens the vehicle's file again after we changed it. If others replaced the file, the
handle reads nothing more, whatever is written under the path later: that belongs to another file.
"""

from __future__ import annotations

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
from mavftpfs.shared.errors import FileChanged, FileTooLarge, LocalProtocolError

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

    async def fsync(self) -> None:
        """Deliver what was written through any handle; see OpenFile.fsync."""
        await self._parts.deliverer.deliver(self._node)

    async def release(self) -> None:
        """Deliver what was written by this handle, and close it. What could not be delivered stays held.

        Raises:
            Why it is not delivered.
        """
        if self._closed:
            return
        try:
            if self.writable:
                await self._parts.deliverer.deliver(self._node)
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
            node.forget_draft()
            return
        self._context.nodes.maybe_forget(node)

    # --- inside

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

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data`; see OpenFile.write."""
        node, stop = self._node, offset + len(data)
        await self._have_room(stop)
        async with node.lock:
            self._context.require_disarmed()
            node.require_not_stale()
            assert node.draft is not None
            self._parts.throttle.require_sendable(node.draft, max(node.draft.size, stop))
            node.draft.write(offset, data)
            await self._parts.deliverer.push(node)
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut or extend; see OpenFile.truncate."""
        node = self._node
        assert node.draft is not None
        if size or not node.draft.size:
            await self._have_room(size)
            async with node.lock:
                await self._truncate(node, size)
            return
        if self._closed:
            raise LocalProtocolError("truncate of a closed handle")
        # The bytes under way to the vehicle are not wanted any more, and new ones need no room.
        async with node.claim():
            await self._truncate(node, 0)

    async def flush(self) -> None:
        """Deliver, but not a file that was only emptied: bytes are about to come.

        A shell empties the file, closes a copy of the descriptor, and only then writes.

        Raises:
            Why it is not delivered.
        """
        draft = self._node.draft
        if draft is not None and (draft.size > 0 or self._node.error is not None):
            await self._parts.deliverer.deliver(self._node)

    async def take_back(self) -> bool | None:
        """See OpenFile.take_back. May take as long as a request that is not answered."""
        try:
            return await self._parts.deliverer.withdraw(self._node)
        finally:
            self.close()

    # --- inside

    async def _have_room(self, size: int) -> None:
        """Wait until not too much is un-ACKed. size: bytes that the file will have.

        Raises:
            FileTooLarge, Armed. Else as Deliverer.deliver, when nothing moves.
        """
        if self._closed:
            raise LocalProtocolError("write to a closed handle")
        if size > MAX_FILE:
            raise FileTooLarge(f"no vehicle takes files of more than {MAX_FILE} bytes")
        throttle = self._parts.throttle
        while throttle.is_full(self._node):
            self._context.require_disarmed()
            if not await throttle.wait():
                await throttle.while_full(self._node, partial(self._parts.deliverer.deliver, self._node))

    async def _truncate(self, node: Node, size: int) -> None:
        self._context.require_disarmed()
        if node.removed or size:
            node.require_not_stale()
        assert node.draft is not None
        if size == node.draft.size and node.draft.state is not State.STALE:
            return
        if size:
            self._parts.throttle.require_sendable(node.draft, size)
        node.draft.truncate(size)
        await self._parts.deliverer.push(node)
