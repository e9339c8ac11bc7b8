"""mkdir, rmdir, unlink and rename on the vehicle as rename(2) and its kin have it. Layer: cache.

Servers check little: some remove files by rmdir, or move into directories by rename (servers.md 9). So types
and targets are looked up in listings first. Whoever changes a name holds its path alone (`pathlocks`); what a
draft has undelivered is delivered before its path changes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.cache.draft import State
from mavftpfs.cache.hiding import Hider
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.replace import Replacer
from mavftpfs.cache.reserved import fits_rename
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    FileBusy,
    InvalidMove,
    IsADirectory,
    NotADirectory,
    NotFound,
    NotSupported,
)
from mavftpfs.shared.model import DirEntry, EntryKind, wire_path


class Namespace:
    """Changes of names on the vehicle. Paths are the vehicle's, not local, not below `@`."""

    def __init__(
        self,
        context: Context,
        names: Names,
        deliverer: Deliverer,
        replacer: Replacer,
        hider: Hider,
        *,
        on_renamed: Callable[[bytes, bytes], None],
    ) -> None:
        """`on_renamed(old, new)`: the vehicle's path has another name."""
        self._context = context
        self._names = names
        self._deliverer = deliverer
        self._replacer = replacer
        self._hider = hider
        self._on_renamed = on_renamed

    async def mkdir(self, path: bytes) -> None:
        """See Tree.mkdir."""
        async with self._context.paths.hold(path):
            if await self._names.entry(path) is not None:
                raise AlreadyExists(f"{path!r} exists")
            await self._names.require_new(path)
            await self._names.make_directory(path)

    async def rmdir(self, path: bytes) -> None:
        """See Tree.rmdir."""
        async with self._context.paths.hold(path):
            entry = await self._need(path)
            if entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
            await self._names.require_empty(path)
            await self._names.remove_directory(path)

    async def unlink(self, path: bytes) -> None:
        """See Tree.unlink."""
        node = self._context.nodes.get(path)
        with nullcontext() if node is None else node.doom():
            async with self._context.paths.hold(path):
                node = self._context.nodes.get(path)
                if node is not None and await self._names.entry(path) is not None:
                    await self._unlink_node(node)
                    return
                entry = await self._names.current(path)
                if entry is None:
                    raise NotFound(f"{path!r} does not exist")
                if entry.kind is not EntryKind.FILE:
                    raise IsADirectory(f"{path!r} is a directory")
                self._context.require_idle(path)
                await self._remove(path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """See Tree.rename."""
        if new.startswith(old + b"/"):
            raise InvalidMove(f"{old!r} cannot become a part of itself")
        if old != new:
            await self._deliver_below(old)
        displaced = None if noreplace or old == new else self._context.nodes.get(new)
        with nullcontext() if displaced is None else displaced.doom():
            async with self._context.paths.hold(old, new):
                await self._rename(old, new, noreplace=noreplace)

    async def release(self, node: Node) -> None:
        """Nobody has an unlinked file open any more: remove what was hidden of it.

        Raises:
            As WriteStore.remove; the next listing of the directory removes it then.
        """
        node.drop_draft()
        while node.hidden and not node.handles:
            path = node.path
            async with self._context.paths.hold(path):  # a directory above it may be about to move
                if node.path == path and node.hidden:
                    await self._hider.remove(node)

    # --- inside: looking

    async def _need(self, path: bytes) -> DirEntry:
        entry = await self._names.entry(path)
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
            await self._names.require_empty(new)
        elif source.kind is EntryKind.DIRECTORY:
            raise NotADirectory(f"{new!r} is not a directory")

    # --- inside: unlinking

    async def _remove(self, path: bytes) -> None:
        await self._names.purge(path)
        await self._names.remove(path)
        self._context.files.on_removed(path)

    async def _unlink_node(self, node: Node) -> None:
        path = node.path
        await self._deliverer.abandon(node)
        there = await self._is_file(path, node)
        if there and node.draft is None:
            self._context.require_idle(path)
        await self._names.purge(path)
        if there and node.handles and not self._hider.keep_local(node):
            await self._hider.hide(node)
            return
        if there:
            await self._names.remove_if_there(path)
            self._context.files.on_removed(path)
        self._hider.displace(node)

    async def _is_file(self, path: bytes, node: Node) -> bool:
        """Return whether the vehicle has an open file; what else has its name by now is not to be removed.

        Raises:
            IsADirectory: it is a directory, and there is no file of ours that could lose its name.
        """
        entry, draft = await self._names.current(path), node.draft
        if entry is not None and entry.kind is EntryKind.DIRECTORY and draft is None:
            raise IsADirectory(f"{path!r} is a directory")
        if entry is None or entry.kind is not EntryKind.FILE:
            return False
        return draft is None or draft.base is not None or draft.begun or draft.state is State.TORN

    # --- inside: renaming

    async def _deliver_below(self, path: bytes) -> None:
        """Have the vehicle hold what is about to get another name. Raises FileBusy if that takes too long."""
        with trio.move_on_after(self._context.options.op_deadline) as scope:
            for node in self._context.nodes.below(path):
                await self._deliverer.deliver(node)
                self._context.nodes.maybe_forget(node)
        if scope.cancelled_caught:
            raise FileBusy(f"{path!r} is still being delivered")

    async def _rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        context = self._context
        wire_path(new)
        listed = await self._names.current(new, free=noreplace)
        target = listed or await self._names.entry(new)
        source = await self._need(old)
        if target is None:
            await self._names.require_new(new)
        elif noreplace:
            raise AlreadyExists(f"{new!r} exists")
        if old == new:
            return
        await self._require_replaceable(source, new, target)
        if not fits_rename(old, new):
            raise CrossDevice(f"{old!r} and {new!r} do not fit one request together")
        for path in (old, new):
            if context.nodes.get(path) is None:
                context.require_idle(path)
        await self._rename_checked(old, new, source, listed)
        context.follow_rename(old, new)
        self._on_renamed(old, new)

    async def _rename_checked(
        self, old: bytes, new: bytes, source: DirEntry, listed: DirEntry | None
    ) -> None:
        displaced = self._context.nodes.get(new)
        for node in [*self._context.nodes.below(old), *([displaced] if displaced else [])]:
            await self._deliverer.abandon(node)
            if node is not displaced and node.draft is not None and node.draft.base is None:
                raise FileBusy(f"{node.path!r} is being written, and not on the vehicle yet")
        await self._names.purge(old)
        try:
            if listed is None:
                await self._names.rename(old, new)
            elif listed.kind is EntryKind.DIRECTORY:
                await self._names.remove_directory(new)
                await self._names.rename(old, new)
            else:
                await self._replace(old, new, displaced)
        except NotSupported as error:
            raise CrossDevice(str(error)) from error
        if displaced is not None and not displaced.removed:
            self._hider.displace(displaced)
        if source.kind is EntryKind.DIRECTORY:
            self._context.dentries.forget(old)

    async def _replace(self, old: bytes, new: bytes, displaced: Node | None) -> None:
        """Rename over a file; who has that open keeps it."""
        context = self._context
        keep = displaced is not None and displaced.handles > 0 and not self._hider.keep_local(displaced)
        places = context.own.places(new)
        if keep and places.sidecar is not None:
            raise FileBusy(f"{new!r} is open, and its path is too long to keep it")
        context.own.live |= places.all
        try:
            await self._replacer.replace(old, new, places, keep_old=keep)
            if keep and displaced is not None and places.old is not None:
                await self._hider.on_hidden(displaced, places.old)
        finally:
            context.own.live -= places.all
            context.own.live |= context.nodes.hidden.keys()
