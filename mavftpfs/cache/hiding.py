"""What becomes of open files that lose their names: who has one open reads on. Layer: cache.

What is cached whole is held here; else the file is kept on the vehicle under a reserved name until its last
handle is closed.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.replacing import Replacer
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, MavftpfsError, PathTooLong

log = logging.getLogger("mavftpfs.cache")

PIECE = 64 * 1024


class Hider:
    """Keeps files without names. All raise as Sure.rename."""

    def __init__(
        self, context: Context, sure: Sure, replacer: Replacer, new_content: Callable[[Node], SpoolContent]
    ) -> None:
        self._context = context
        self._sure = sure
        self._replacer = replacer
        self._new_content = new_content

    def keep_content(self, node: Node) -> bool:
        """Return whether the open file can be read on without the vehicle: hold what is cached of it."""
        draft = node.draft
        blocks = self._context.files.cached(node.path)
        if draft is not None and (draft.whole or blocks is None):
            return draft.whole
        if blocks is None or not blocks.complete:
            return False
        if draft is None:
            node.content = self._new_content(node)
            draft = node.draft = Draft(node.content, blocks.size)
        for at in range(0, draft.base_limit, PIECE):
            data = blocks.get(at, min(at + PIECE, draft.base_limit))
            if data is None:
                return False
            draft.fill(at, data)
        return True

    async def hide(self, node: Node) -> bool:
        """Keep an unlinked file on the vehicle under a reserved name as long as somebody reads it.

        Returns False if that cannot be.
        """
        context, old, hidden = self._context, node.path, b""
        try:
            hidden = context.namer.hidden(old)
            context.live.add(hidden)
            await self._sure.rename(old, hidden)
        except (FtpNak, PathTooLong) as error:
            context.live.discard(hidden)
            log.info("%r is removed although it is being read: %s", old, error)
            return False
        except BaseException:
            context.live.discard(hidden)
            raise
        self._call_hidden(node, hidden)
        context.on_changed(old)
        await self._settle(node)
        return True

    async def drop_unread(self, node: Node) -> None:
        """Remove what was hidden of a file if nobody has it open; its path must not change meanwhile.

        Raises:
            As Sure.remove; the next listing of the directory removes it then.
        """
        if not node.hidden or node.handles:
            return
        try:
            await self._sure.remove(node.path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
        finally:
            self._context.forget_hidden(node)
        self._context.files.on_removed(node.path)
        self._context.on_changed(node.path)

    async def _settle(self, node: Node) -> None:
        """A file was hidden: its last reader may have closed it before there was anything to remove."""
        try:
            await self.drop_unread(node)
        except MavftpfsError as error:
            log.info("%r stays until its directory is listed again: %s", node.path, error)

    def _call_hidden(self, node: Node, hidden: bytes) -> None:
        """The file was renamed to a reserved name, under which it is read on."""
        node.lose_name()
        self._context.nodes.detach(node)
        self._context.files.on_renamed(node.path, hidden)
        self._context.hide(node, hidden)

    async def rename_over(self, old: bytes, new: bytes, displaced: Node) -> bool:
        """Rename over a file that is read and not held here: it gets a reserved name, as if unlinked.

        Returns False if that need not or cannot be.
        """
        if not displaced.handles or self.keep_content(displaced):
            return False
        context, replacer = self._context, self._replacer
        hidden, places = context.namer.hidden(new), context.namer.places(new, old)
        replacer.reserve(places)
        try:
            if not await replacer.replace_open(old, new, places):
                return False
            self._call_hidden(displaced, places.old)
        finally:
            replacer.release(places)
            context.live.update(context.hidden)
        await self._rehide(displaced, hidden)
        await self._settle(displaced)
        return True

    async def _rehide(self, node: Node, hidden: bytes) -> None:
        """Give a hidden file a name that other mounts leave alone for long."""
        context, place = self._context, node.path
        context.live.add(hidden)
        try:
            await self._sure.rename(place, hidden)
        except MavftpfsError as error:
            context.live.discard(hidden)
            log.info("%r stays under %r while it is read: %s", hidden, place, error)
            return
        context.live.discard(place)
        context.files.on_renamed(place, hidden)
        context.hide(node, hidden)

    def displace(self, node: Node) -> None:
        """The file that is open at a path lost its name; who has it open keeps what is held of it."""
        if node.handles:
            self.keep_content(node)
        node.lose_name()
        self._context.nodes.detach(node)
