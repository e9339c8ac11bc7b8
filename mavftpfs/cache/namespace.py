"""mkdir, rmdir, unlink and rename on the vehicle as rename(2) and its kin have it. Layer: cache.

Servers check little: some remove files by rmdir, move into directories by rename, or truncate another
spelling of a name (servers.md 9). So types and targets are looked up in listings first. Changes that concern
one another wait for each other; what a draft has undelivered is delivered before its path changes.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import trio

from mavftpfs.cache.asides import Places, fits_rename
from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.cache.emptying import Emptier
from mavftpfs.cache.hiding import Hider
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.replacing import Present
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    CrossDevice,
    FileBusy,
    FtpNak,
    InvalidMove,
    IsADirectory,
    LinkError,
    NotADirectory,
    NotFound,
    NotSupported,
    RequestTimeout,
)
from mavftpfs.shared.model import DirEntry, EntryKind, wire_path

log = logging.getLogger("mavftpfs.cache")

TRIES = 5
"""How often a change begins anew because files were opened or closed while it waited."""


class Namespace(Names):
    """Changes of names on the vehicle. Paths are the vehicle's, not local, not below `@`."""

    def __init__(
        self,
        context: Context,
        sure: Sure,
        deliverer: Deliverer,
        *,
        purge: Callable[[bytes], Awaitable[None]],
        new_content: Callable[[Node], SpoolContent],
        on_renamed: Callable[[bytes, bytes], None],
    ) -> None:
        """`purge(path)` removes what would bring a path back (Cleaner); `new_content(node)`: room for
        a draft; `on_renamed(old, new)`: the vehicle's path has another name."""
        self._sure = sure
        self._deliverer = deliverer
        super().__init__(context)
        self._emptier = Emptier(context, sure)
        self._purge = purge
        self._hider = Hider(context, sure, deliverer.replacer, new_content)
        self._on_renamed = on_renamed

    # --- changing

    async def mkdir(self, path: bytes) -> None:
        """See Tree.mkdir."""
        async with self._context.paths.hold(path):
            if await self.entry(path) is not None:
                raise AlreadyExists(f"{path!r} exists")
            if self._context.writer.traits.folds and await self.other_spelling(path):
                raise AlreadyExists(f"{path!r} exists in another spelling")  # else the server says it
            await self.require_kept(path)
            await self._sure.make_directory(path)
            self._context.on_changed(path)

    async def rmdir(self, path: bytes) -> None:
        """See Tree.rmdir."""
        async with self._context.paths.hold(path):
            entry = await self._need(path)
            if entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
            await self._emptier.vacate(path)
            await self._sure.remove_directory(path)
            self._context.on_changed(path)

    async def unlink(self, path: bytes, *, first: Callable[[], None] = lambda: None) -> None:
        """See Tree.unlink; `first()` is called, perhaps twice, when nobody else can open the file, and may
        raise."""
        if not await self._unlink(path, first):
            await self._unlink(path, first, fetched=True)

    async def _unlink(self, path: bytes, first: Callable[[], None], *, fetched: bool = False) -> bool:
        """Return False if it has to be fetched first; `fetched`: do that."""
        async with self._changing(path, doomed=path, fetched=fetched):
            first()
            node = self._context.nodes.get(path)
            if node is not None and await self.entry(path) is not None:
                return await self._unlink_node(node, path, fetched=fetched)
            entry = await self.current(path)
            if entry is None:
                raise NotFound(f"{path!r} does not exist")
            if entry.kind is not EntryKind.FILE:
                raise IsADirectory(f"{path!r} is a directory")
            self._context.require_idle(path)
            await self._remove(path)
            return True

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """See Tree.rename."""
        if new.startswith(old + b"/"):
            raise InvalidMove(f"{old!r} cannot become a part of itself")
        if not await self._rename(old, new, noreplace=noreplace):
            await self._rename(old, new, noreplace=noreplace, fetched=True)

    async def _rename(self, old: bytes, new: bytes, *, noreplace: bool, fetched: bool = False) -> bool:
        """Return False if what is to be replaced has to be fetched first; `fetched`: do that."""
        async with self._changing(old, new, doomed=None if noreplace or old == new else new, fetched=fetched):
            wire_path(new)
            listed = await self.current(new, free=noreplace)
            target = listed or await self.entry(new)
            source = await self._need(old)
            other = None if target is not None else await self.other_spelling(new)
            if other not in (None, old):
                raise AlreadyExists(f"{new!r} is {other!r} on this card, which does not tell case apart")
            if target is None:
                await self.require_kept(new)
            if target is not None and noreplace:
                raise AlreadyExists(f"{new!r} exists")
            if old == new:
                return True
            await self._require_replaceable(source, new, target)
            if not fetched and self._would_lose(old, new):
                return False
            await self._rename_checked(old, new, source, target, by_case=other == old)
            return True

    async def release(self, node: Node) -> None:
        """Nobody has an unlinked file open any more: remove what was hidden of it.

        Raises:
            As Sure.remove; the next listing of the directory removes it then.
        """
        node.drop_draft()
        async with node.lock:  # it may be about to get its reserved name
            try:
                while node.hidden:
                    path = node.path
                    async with self._context.paths.hold(path):  # a directory above it may be about to move
                        if node.path == path:
                            await self._hider.drop_unread(node)
            finally:
                if node.hidden:
                    self._context.forget_hidden(node)

    # --- inside: whom to wait for

    @asynccontextmanager
    async def _changing(
        self, old: bytes, new: bytes | None = None, *, doomed: bytes | None = None, fetched: bool = False
    ) -> AsyncIterator[None]:
        """Hold the path, or both, and the files there and below; those at the old path are delivered before,
        and what is not known of one that is to lose its name while it is open is fetched if that is asked.

        A delivery may last: nobody waits for one, or makes one, while it keeps others from their paths. That
        of a file which is to lose its name (`doomed`) is called off instead; if it keeps it after all, who
        waits for the delivery has it begin again.

        Raises:
            FileBusy: one is still being delivered, or cannot be fetched. RequestTimeout: another change took
            too long. Else as Deliverer.deliver.
        """
        paths = (old,) if new is None else (old, new)
        for _ in range(TRIES):
            nodes = self._nodes_of(paths)
            try:
                async with AsyncExitStack() as locks:
                    await self._lock_nodes(nodes, doomed, locks)
                    if fetched:
                        await self._fetch(nodes, doomed)
                    if new not in (None, old) and not await self._deliver_below(old, nodes):
                        continue
                    await locks.enter_async_context(self._context.paths.hold(*paths))
                    if self._nodes_of(paths) == nodes:
                        yield
                        return
            finally:
                for node in nodes:
                    self._context.nodes.maybe_forget(node)  # a close that found it locked could not
                self._deliverer.let_go()
        raise FileBusy(f"{old!r} is opened and closed all the time")

    def _nodes_of(self, paths: tuple[bytes, ...]) -> list[Node]:
        """Return the files concerned, in an order that renames do not change."""
        return sorted({node for path in paths for node in self._context.nodes.below(path)}, key=id)

    async def _lock_nodes(self, nodes: list[Node], doomed: bytes | None, locks: AsyncExitStack) -> None:
        with trio.move_on_after(self._context.options.op_deadline) as scope:
            for node in nodes:
                if node.path == doomed:
                    locks.enter_context(node.dooming())
                await locks.enter_async_context(node.lock)
                if node.path == doomed:
                    locks.enter_context(self._hider.keeping(node))
        if scope.cancelled_caught:
            raise FileBusy("a file that is concerned is still being delivered")

    async def _fetch(self, locked: list[Node], doomed: bytes | None) -> None:
        for node in locked:
            if node.path == doomed:
                await self._deliverer.abandon(node)
                await self._hider.fetch(node)

    async def _deliver_below(self, path: bytes, locked: list[Node]) -> bool:
        """Return False if a file among them is about to lose its name."""
        for node in locked:
            concerned = node.path == path or node.path.startswith(path + b"/")
            if concerned and not await self._deliverer.deliver_locked(node):
                return False
        return True

    # --- inside: looking

    async def _need(self, path: bytes) -> DirEntry:
        entry = await self.entry(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return entry

    async def _require_replaceable(self, source: DirEntry, new: bytes, target: DirEntry | None) -> None:
        """Raise what rename(2) says of a target that cannot be replaced; FUSE hands both over unchecked."""
        if target is None:
            return
        if target.kind is EntryKind.DIRECTORY:
            if source.kind is EntryKind.FILE:
                raise IsADirectory(f"{new!r} is a directory")
            await self._emptier.require_empty(new)
        elif source.kind is EntryKind.DIRECTORY:
            raise NotADirectory(f"{new!r} is not a directory")

    # --- inside: unlinking

    async def _remove(self, path: bytes) -> None:
        await self._purge(path)
        await self._sure.remove(path)
        self._context.files.on_removed(path)
        self._context.on_changed(path)

    async def remove_perhaps(self, path: bytes) -> None:
        """Remove a file that we were about to make: CreateFile may not have come to it."""
        try:
            await self._remove(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            self._context.dentries.note_removed(path)

    async def _unlink_node(self, node: Node, path: bytes, *, fetched: bool) -> bool:
        """Return False if it can be neither held here nor hidden, and was not fetched before."""
        await self._deliverer.abandon(node)
        if path in self._context.torn:
            await self._purge(path)
        there = await self._is_file(path, node)
        if there and node.draft is None:
            self._context.require_idle(path)
        hidden = False
        if there and node.handles and not self._hider.keep_content(node) and not fetched:
            await self._purge(path)
            hidden = await self._hider.hide(node)
            if not hidden:
                return False
        if there and not hidden:
            await self.remove_perhaps(path)
        node.lose_name()
        self._context.nodes.detach(node)
        return True

    async def _is_file(self, path: bytes, node: Node) -> bool:
        """Return whether the vehicle has an open file; what else has its name by now is not to be removed.

        Raises:
            IsADirectory: it is a directory, and there is no file of ours that could lose its name.
        """
        entry, draft = await self.current(path), node.draft
        if entry is not None and entry.kind is EntryKind.DIRECTORY and draft is None:
            raise IsADirectory(f"{path!r} is a directory")
        if entry is None or entry.kind is not EntryKind.FILE:
            return False
        return draft is None or draft.on_vehicle or (draft.maybe_made and not entry.size)

    # --- inside: renaming

    async def _rename_checked(
        self, old: bytes, new: bytes, source: DirEntry, target: DirEntry | None, *, by_case: bool
    ) -> None:
        context = self._context
        for path in (old, new):
            if context.nodes.get(path) is None:
                context.require_idle(path)
        displaced = context.nodes.get(new)
        if displaced is not None:
            await self._deliverer.abandon(displaced)
        await self._purge(old)
        if not await self._is_kept(old, new, displaced, by_case=by_case):
            await self._rename_or_refuse(old, new, target, by_case=by_case)
        if displaced is not None and not displaced.hidden:
            self._hider.displace(displaced)
        if source.kind is EntryKind.DIRECTORY:
            context.dentries.forget(old)
        context.follow_rename(old, new)
        self._on_renamed(old, new)

    def _would_lose(self, old: bytes, new: bytes) -> bool:
        """Return whether readers of what is replaced, in steps, would lose it: it cannot be hidden then."""
        node = self._context.nodes.get(new)
        if node is None or not node.handles or fits_rename(old, new):
            return False
        return self._context.writer.traits.rename_works is not False and not self._hider.keep_content(node)

    async def _is_kept(self, old: bytes, new: bytes, displaced: Node | None, *, by_case: bool) -> bool:
        """Rename over an open file so that its readers keep it; return False if that is not the way."""
        if displaced is None or by_case or not fits_rename(old, new):
            return False
        there = await self.current(new)
        if there is None or there.kind is not EntryKind.FILE:
            return False
        return await self._hider.rename_over(old, new, displaced)

    async def _rename_or_refuse(
        self, old: bytes, new: bytes, target: DirEntry | None, *, by_case: bool
    ) -> None:
        try:
            await self._rename_on_vehicle(old, new, target, by_case=by_case)
        except NotSupported as error:
            raise CrossDevice(str(error)) from error

    async def _rename_on_vehicle(
        self, old: bytes, new: bytes, target: DirEntry | None, *, by_case: bool
    ) -> None:
        there = target is not None and await self.listed(new) is not None
        if target is not None and target.kind is EntryKind.DIRECTORY:
            await self._emptier.vacate(new)
            await self._sure.remove_directory(new)
            there = False
        if not there and not by_case and fits_rename(old, new):
            await self._rename_plainly(old, new)
            return
        if not fits_rename(old, new) and self._context.writer.traits.rename_works is False:
            raise NotSupported("this server cannot rename")  # a small file would be made for nothing
        replacer = self._deliverer.replacer
        places = self._context.namer.places(new, old)
        replacer.reserve(places)
        try:
            present = Present(new=True, old=False, target=there)
            if fits_rename(old, new) and not by_case:
                await replacer.replace(old, new, places, present)
            else:
                await self._step_aside(old, new, places)
                await replacer.replace_by_way(old, new, places, present)
        except (FtpNak, Armed, NotSupported):
            if self._context.torn.keys().isdisjoint((old, new)):
                await replacer.clean(new, places)  # all is where it was
            raise
        finally:
            replacer.release(places)

    async def _rename_plainly(self, old: bytes, new: bytes) -> None:
        traits = self._context.writer.traits
        try:
            await self._sure.rename(old, new)
        except FtpNak as nak:
            if traits.rename_works is None and await self._cannot_rename(old, new):
                traits.rename_works = False
                raise NotSupported("this server cannot rename") from nak
            if traits.rename_works is False:
                raise NotSupported("this server cannot rename") from nak
            raise

    async def _cannot_rename(self, old: bytes, new: bytes) -> bool:
        """A first rename to a free name failed: return whether both names are as they were."""
        return await self._sure.entry(old) is not None and await self._sure.entry(new) is None

    async def _step_aside(self, old: bytes, new: bytes, places: Places) -> None:
        """Move `old` to a reserved name on its way to `new`; if cut off, a listing moves it on or back."""
        replacer = self._deliverer.replacer
        await replacer.write_sidecar(places, new, old)
        try:
            await self._rename_plainly(old, places.moved)
        except (RequestTimeout, LinkError):
            replacer.tear(old, places.moved)
            raise
