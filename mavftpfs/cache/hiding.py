"""What becomes of open files that lose their names: who has one open reads on. Layer: cache.

What is cached whole is held here; else the file is kept on the vehicle under a reserved name until its last
handle is closed. Where it cannot have one (LittleFS), what is not known of it is fetched before it goes.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial

import trio

from mavftpfs.cache.base import open_node, read_base
from mavftpfs.cache.blocks import FileBlocks
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.replacing import Replacer
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    FileBusy,
    FileChanged,
    FileTooLarge,
    FtpNak,
    LinkError,
    MavftpfsError,
    NoSpace,
    PathTooLong,
    RequestTimeout,
    SpoolFailed,
)

log = logging.getLogger("mavftpfs.cache")

PIECE = 64 * 1024
_GONE = frozenset({errno.ENOENT, errno.ESTALE})


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
        if draft is not None:
            return self._hold(draft, blocks)
        content = self._new_content(node)
        draft = Draft(content, blocks.size)
        # Readers of what was there before must not be given this.
        if self._context.files.was_replaced(node.path) or not self._hold(draft, blocks):
            content.close()
            return False
        self._attach(node, draft, content)
        return True

    def _hold(self, draft: Draft, blocks: FileBlocks) -> bool:
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

    def _attach(self, node: Node, draft: Draft, content: SpoolContent) -> None:
        content.settle()  # whatever becomes of this mount, nobody misses a copy
        node.draft, node.content, node.copied = draft, content, True

    @contextmanager
    def keeping(self, node: Node) -> Iterator[None]:
        """The body takes the name of a file that nobody else delivers or renames; if that is refused, what
        was copied for it is forgotten, so that who opens the file has the vehicle's."""
        try:
            yield
        except MavftpfsError as error:
            unsure = isinstance(error, RequestTimeout | LinkError)
            if node.copied and not unsure and not (node.removed or node.writers or node.undelivered):
                node.drop_draft()
            raise

    async def fetch(self, node: Node) -> None:
        """Hold all of an open file that cannot be hidden, so that it can be removed; the caller has its lock.

        If it became another file nobody can read on anyway: that is only logged.

        Raises:
            FileBusy: it is too much, did not come in time, or is not given; nothing is to be removed then.
            RequestTimeout, LinkError.
        """
        with trio.move_on_after(self._context.options.op_deadline) as scope:
            try:
                with node.looking():
                    while node.handles and not self.keep_content(node):
                        await (self._copy(node) if node.draft is None else self._complete(node, node.draft))
            except (RequestTimeout, LinkError):
                raise
            except MavftpfsError as error:
                log.info("%r is open and cannot be fetched before it is removed: %s", node.path, error)
                if errno_for(error) not in _GONE:
                    raise FileBusy(f"{node.path!r} is open, and cannot be kept for that: {error}") from error
        if scope.cancelled_caught:
            raise FileBusy(f"{node.path!r} is open, and the rest of it did not come in time")

    async def _complete(self, node: Node, draft: Draft) -> None:
        await self._fill(node, draft, partial(read_base, self._context, node, sure=True))

    async def _copy(self, node: Node) -> None:
        """Make a draft of what nobody changed, unless somebody is about to."""
        handle = await open_node(self._context, node)
        content = self._new_content(node)
        draft = Draft(content, handle.size)

        async def read(start: int, stop: int) -> bytes | memoryview:
            content.settle()  # of a part of it even less than of a copy
            self._require_same(node)
            return await handle.read(start, stop - start, sure=True)

        try:
            await self._fill(node, draft, read)
            self._require_same(node)
            if draft.whole and node.draft is None:
                self._attach(node, draft, content)
        finally:
            handle.close()
            if node.draft is not draft:
                content.close()

    def _require_same(self, node: Node) -> None:
        files = self._context.files
        if files.was_replaced(node.path) or files.was_lost(node.path):
            raise FileChanged("who opened it before had another one")

    async def _fill(
        self, node: Node, draft: Draft, read: Callable[[int, int], Awaitable[bytes | memoryview]]
    ) -> None:
        """Fetch what a draft lacks, as long as anybody has the file open."""
        missing, most = draft.missing_base(), self._context.options.rmw_max
        if sum(stop - start for start, stop in missing) > most:
            raise FileTooLarge(f"more than {most} bytes of it are only on the vehicle; see rmw_max")
        for start, stop in missing:
            for at in range(start, stop, PIECE):
                if not node.handles:
                    return
                draft.fill(at, await read(at, min(at + PIECE, stop)))

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
            log.info("%r is being read and cannot be kept on the vehicle: %s", old, error)
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
