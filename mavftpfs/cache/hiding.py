"""What becomes of open files that lose their names: who has one open reads on. Layer: cache.

What is known here whole is held here. Else the file is kept on the vehicle under a reserved name until its
last handle is closed. Where it cannot have one (LittleFS), the change of the name is refused (EBUSY).
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from mavftpfs.cache.blocks import FileBlocks
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Base, Draft
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.reserved import Kind
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.shared.errors import (
    FileBusy,
    FtpNak,
    MavftpfsError,
    NoSpace,
    NotSupported,
    PathTooLong,
    SpoolFailed,
)

log = logging.getLogger("mavftpfs.cache")

PIECE = 64 * 1024
"""Bytes copied at once."""


class Hider:
    """Keeps files without names. The caller holds their paths alone."""

    def __init__(self, context: Context, names: Names, new_content: Callable[[Node], SpoolContent]) -> None:
        """`new_content(node)`: room for a draft."""
        self._context = context
        self._names = names
        self._new_content = new_content

    def keep_local(self, node: Node) -> bool:
        """Hold what is known of an open file; return whether it can be read on without the vehicle."""
        draft, blocks = node.draft, self._context.files.cached(node.path)
        if draft is not None and (draft.whole or blocks is None):
            return draft.whole
        if blocks is None or not blocks.complete or self._context.files.was_replaced(node.path):
            return False  # who opened what was there before must not be given this
        if draft is not None:
            return self._fill(draft, blocks)
        content = self._new_content(node)
        draft = Draft(content, Base(blocks.size))
        if not self._fill(draft, blocks):
            content.close()
            return False
        content.settle()  # whatever becomes of this mount, nobody misses a copy
        node.draft, node.content = draft, content
        return True

    def _fill(self, draft: Draft, blocks: FileBlocks) -> bool:
        """Put what is cached into a draft; return whether all is held then."""
        try:
            for at in range(0, draft.base_limit, PIECE):
                data = blocks.get(at, min(at + PIECE, draft.base_limit))
                if data is None:
                    return False
                draft.fill(at, data)
        except (NoSpace, SpoolFailed) as error:
            log.info("what is cached cannot be held here: %s", error)
            return False
        return True

    async def hide(self, node: Node) -> None:
        """Keep an unlinked file on the vehicle under a reserved name as long as somebody has it open.

        Raises:
            FileBusy: that cannot be. Else as WriteStore.rename.
        """
        context, old = self._context, node.path
        try:
            hidden = context.own.beside(old, Kind.DELETED)
        except PathTooLong as error:
            raise FileBusy(f"{old!r} is open, and its path is too long to keep it: {error}") from error
        context.own.live.add(hidden)
        try:
            await self._names.rename(old, hidden)
        except BaseException as error:
            context.own.live.discard(hidden)
            if isinstance(error, FtpNak | NotSupported):
                raise FileBusy(f"{old!r} is open, and this card cannot keep it: {error}") from error
            raise
        await self.on_hidden(node, hidden)

    async def on_hidden(self, node: Node, hidden: bytes) -> None:
        """The file was renamed to a reserved name, under which it is read on."""
        node.lose_name()
        self._context.files.on_renamed(node.path, hidden)
        self._context.nodes.hide(node, hidden)
        if not node.handles:  # the last one was closed before there was anything to remove
            try:
                await self.remove(node)
            except MavftpfsError as error:
                log.info("%r stays until its directory is listed again: %s", hidden, error)

    async def remove(self, node: Node) -> None:
        """Remove what was hidden of a file that nobody has open.

        Raises:
            As WriteStore.remove; the next listing of the directory removes it then.
        """
        context = self._context
        try:
            await self._names.remove_if_there(node.path)
        finally:
            context.nodes.forget_hidden(node)
            context.own.live.discard(node.path)
        context.files.on_removed(node.path)

    def displace(self, node: Node) -> None:
        """The file that is open at a path lost its name; who has it open keeps what is held of it."""
        node.lose_name()
        self._context.nodes.detach(node)
