"""Open files of a mount that can be written. Layer: cache.

Every handle of a file shares its node, so that a reader sees at once what a writer wrote, whatever the
vehicle has. A handle opened for reading keeps its own readahead and opens the vehicle's file anew after we
changed it. If somebody else replaced the file it reads nothing more, whatever is written there later: what
has the path now is another file.
"""

from __future__ import annotations

from typing import Protocol

from mavftpfs.cache.base import open_node, read_base
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft, Where
from mavftpfs.cache.files import FileHandle
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.shared.errors import FileChanged, LocalProtocolError

TRIES = 3
"""How often a read starts anew because the file was delivered meanwhile."""


class Owner(Protocol):
    """What a handle asks of writeback.Writeback."""

    async def write(self, node: Node, offset: int, data: bytes | memoryview) -> int: ...
    async def truncate_node(self, node: Node, size: int) -> None: ...
    async def deliver(self, node: Node) -> None: ...
    async def close(self, node: Node) -> None: ...
    def drop_handle(self, node: Node, *, writing: bool) -> None: ...
    def forget_made(self, node: Node) -> None: ...


class _Reading(OpenFile):
    """Reads of one handle: the draft if there is one, else the vehicle's file."""

    def __init__(self, owner: Owner, context: Context, node: Node, handle: FileHandle | None = None) -> None:
        self._owner = owner
        self._context = context
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
        """Whether the kernel's pages could come from, or go to, who has another file of the path open."""
        path = self._node.path
        if self._context.nodes.has_another(path) or self._context.files.was_lost(path):
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
                    node.require_current()
                if self._handle is not None and state == (self._generation, None):
                    return await self._handle.read(offset, size)
                return await self._read_changed(offset, size)
            except (FileChanged, LocalProtocolError):  # the latter: what lay below was closed as delivered
                if self._closed or state == (node.generation, node.draft) or not tries_left:
                    raise
        raise AssertionError

    async def _read_changed(self, offset: int, size: int) -> bytes | memoryview:
        """Read a file that was written here since the handle was opened, or that is not open yet."""
        node = self._node
        if self._handle is not None:
            self._handle.require_not_lost()
        if node.draft is not None:
            return await self._read_draft(node.draft, offset, offset + size)
        self._close_handle()
        self._generation = node.generation
        self._handle = await open_node(self._context, node)
        return await self._handle.read(offset, size)

    async def _read_draft(self, draft: Draft, start: int, stop: int) -> bytes | memoryview:
        parts: list[bytes | memoryview] = []
        at = start
        while at < min(stop, draft.size):
            # Asked anew after each await: the draft may have been written meanwhile.
            where, a, b = draft.segments(at, stop)[0]
            if where is Where.BASE:
                parts.append(await read_base(self._context, self._node, a, b))
                if self._node.draft is not draft:
                    raise FileChanged(f"what was changed of {self._node.path!r} was given up")
            else:
                parts.append(draft.local_bytes(a, b))
            at = b
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _close_handle(self) -> None:
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()


class ReadFile(_Reading):
    """One open() for reading (see cache.openfile.OpenFile)."""

    async def fsync(self) -> None:
        """Deliver what others wrote.

        Raises:
            Why it is not delivered.
        """
        await self._owner.deliver(self._node)

    async def release(self) -> None:
        """Close the handle; the last one of an unlinked file has it removed."""
        if not self._closed:
            self.close()
            await self._owner.close(self._node)

    def close(self) -> None:
        """Close the handle; closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._close_handle()
            self._owner.drop_handle(self._node, writing=False)


class WriteFile(_Reading):
    """One open() for writing (see cache.openfile.OpenFile) of `node`."""

    writable = True

    def __init__(self, owner: Owner, context: Context, node: Node, *, made: bool = False) -> None:
        """`made`: there was no such file before."""
        super().__init__(owner, context, node)
        self._made = made
        self.node = node
        node.writers += 1

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data`; see OpenFile.write."""
        self._require_open()
        return await self._owner.write(self._node, offset, data)

    async def truncate(self, size: int) -> None:
        """Cut or extend; see OpenFile.truncate."""
        self._require_open()
        await self._owner.truncate_node(self._node, size)

    async def flush(self) -> None:
        """Deliver, unless all that happened is that the file was emptied: more is about to come.

        A shell empties the file, closes that descriptor's twin, and only then writes.

        Raises:
            Why it is not delivered.
        """
        draft = self._node.draft
        if draft is not None and (draft.size > 0 or self._node.error is not None):
            await self._owner.deliver(self._node)

    async def fsync(self) -> None:
        """Deliver.

        Raises:
            Why it is not delivered.
        """
        await self._owner.deliver(self._node)

    async def release(self) -> None:
        """Deliver and close; what could not be delivered stays held.

        Raises:
            Why it is not delivered.
        """
        if self._closed:
            return
        try:
            await self._owner.deliver(self._node)
        finally:
            self.close()
            await self._owner.close(self._node)

    def give_up(self) -> None:
        """Close, also after release; see OpenFile.give_up."""
        self.close()
        if self._made:
            self._owner.forget_made(self._node)

    def close(self) -> None:
        """Close without delivering; closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._close_handle()
            self._owner.drop_handle(self._node, writing=True)

    def _require_open(self) -> None:
        if self._closed:
            raise LocalProtocolError("write to a closed handle")
