"""One version of a file on the local disk, as its readers use it. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, TypeVar

import trio

from mavftpfs.cache.blockdirectory import BlockDirectory
from mavftpfs.cache.blocks import BLOCK_SIZE, FileBlocks
from mavftpfs.cache.persistent import BlockKey, FileKey, Settling

T = TypeVar("T")


class InThread(Protocol):
    """Calls something that blocks, elsewhere than on the event loop."""

    async def __call__(self, work: Callable[[], T], /) -> T: ...


async def in_thread(work: Callable[[], T], /) -> T:
    """Call it in a worker thread of trio's."""
    return await trio.to_thread.run_sync(work)


@dataclass(slots=True)
class Kept:
    """Loads blocks. settling: which of the version's blocks are on the disk, or will be."""

    key: FileKey
    directory: BlockDirectory
    run: InThread
    settling: Settling = field(default_factory=Settling)

    async def load(self, index: int) -> bytes | None:
        """Return a block, None if it is not kept."""
        return await self.run(partial(self.directory.read, self.block(index)))

    def block(self, index: int) -> BlockKey:
        """Return the key of a block."""
        return self.key.block(*extent(self.key.size, index))

    async def fill(self, blocks: FileBlocks, start: int, stop: int, still: Callable[[], None]) -> None:
        """Add the blocks of [start, stop) that are lacking and on the disk; `still()` raises if they are not
        wanted any more. Where no mtime tells versions apart a block alone proves nothing: none is added."""
        if self.key.mtime is None:
            return
        for index in range(start // BLOCK_SIZE, -(-stop // BLOCK_SIZE)):
            first, last = extent(self.key.size, index)
            if blocks.missing(max(start, first), min(stop, last)):
                data = await self.load(index)
                still()
                if data is not None:
                    self.give(blocks, index, data)

    def give(self, blocks: FileBlocks, index: int, data: bytes) -> None:
        """Put a block from the disk where readers find it."""
        blocks.preload(index * BLOCK_SIZE, data)
        self.settling.on_kept(index)


def extent(size: int, index: int) -> tuple[int, int]:
    """Return [start, stop) of a block of a file of `size` bytes."""
    start = index * BLOCK_SIZE
    return start, min(start + BLOCK_SIZE, size)
