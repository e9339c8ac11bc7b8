"""mkdir, rmdir, unlink and rename on the vehicle, by the rules of rename(2) and its kin. Layer: cache.

Servers check little: some remove files by rmdir, or move into directories by rename (servers.md 9). So types
and targets are looked up in listings first. A change holds its paths alone (`pathlocks`). A rename first
delivers the drafts of what it moves.

When a file loses its name, the vehicle has it no more. Programs that have it open go on with what was written
here; to read any other byte of it is ESTALE.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import Deliverer
from mavftpfs.cache.names import Names
from mavftpfs.cache.reserved import fits_rename, require_not_ours
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    FileBusy,
    InvalidMove,
    IsADirectory,
    NotADirectory,
    NotFound,
    NotSupported,
    OutcomeUnknown,
)
from mavftpfs.shared.model import DirEntry, EntryKind, require_listable, wire_path

RECENT = 2.0
"""Seconds for which a listing is recent enough to change a name by. So the removal of many files does not
list their directory before each."""


class Namespace:
    """Changes of names. Paths are the vehicle's, not local, not below `@`."""

    def __init__(self, context: Context, names: Names, deliverer: Deliverer) -> None:
        self._context = context
        self._names = names
        self._deliverer = deliverer

    async def mkdir(self, path: bytes) -> None:
        """See Tree.mkdir."""
        self._context.require_changeable()
        require_not_ours(path)
        require_listable(path)
        async with self._context.paths.hold(path):
            if await self._context.entry(path) is not None:
                raise AlreadyExists(f"{path!r} exists")
            await self._names.require_new(path)
            await self._names.make_directory(path)

    async def rmdir(self, path: bytes) -> None:
        """See Tree.rmdir."""
        self._context.require_changeable()
        async with self._context.paths.hold(path):
            entry = await self._context.entry(path)
            if entry is None:
                raise NotFound(f"{path!r} does not exist")
            if entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
            await self._names.require_empty(path)
            await self._names.remove_directory(path)
        self._context.times.forget(path)

    async def unlink(self, path: bytes) -> None:
        """See Tree.unlink."""
        self._context.require_changeable()
        require_not_ours(path)
        async with self._claim(path), self._context.paths.hold(path):
            await self._unlink(path)
        self._context.times.forget(path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """See Tree.rename."""
        self._context.require_changeable()
        require_not_ours(old)
        require_not_ours(new)
        require_listable(new)
        if new.startswith(old + b"/"):
            raise InvalidMove(f"{old!r} cannot become a part of itself")
        if old != new:
            await self._deliver_below(old)
        claimed = nullcontext() if noreplace or old == new else self._claim(new)
        async with claimed, self._context.paths.hold(old, new):
            await self._rename(old, new, noreplace=noreplace)

    @asynccontextmanager
    async def _claim(self, path: bytes) -> AsyncIterator[None]:
        """Claim the file of a path, if it is open or not delivered, for a body that takes its name away.

        Raises:
            FileBusy: see Node.claim.
        """
        nodes = self._context.nodes
        node = nodes.get(path)
        try:
            patience = self._context.options.op_deadline
            async with nullcontext() if node is None else node.claim(patience):
                yield
        finally:
            if node is not None:
                nodes.maybe_forget(node)

    @asynccontextmanager
    async def _moving(self, *paths: bytes) -> AsyncIterator[None]:
        """For a body that moves the first path to the second. If its outcome is unknown, forget what these
        names were; files of these names that are not delivered are STALE, because their names may have other
        files."""
        context = self._context
        try:
            yield
        except OutcomeUnknown:
            self._names.on_unknown(*paths)
            for node in [n for path in paths for n in context.nodes.below(path)]:
                if node.undelivered and node.draft is not None:
                    self._names.settle(node)
                    node.draft.lose_base(though_rewritten=True)
                else:
                    context.files.on_replaced(node.path)
            raise

    # --- inside: unlinking

    async def _unlink(self, path: bytes) -> None:
        context, node = self._context, self._context.nodes.get(path)
        draft = None if node is None else node.draft
        if node is not None:
            await self._deliverer.look(node)
            await self._deliverer.abandon(node)
        entry = await context.directories.ask_entry(path, within=RECENT)
        there = entry is not None and entry.kind is EntryKind.FILE
        if draft is not None:  # a file of others under its name is not to be removed, if it holds something
            ours = draft.base is not None or draft.sent_in_place
            there &= ours or (entry is not None and not entry.size)
        elif entry is None:
            context.nodes.forget_broken(path)
            raise NotFound(f"{path!r} does not exist")
        elif not there:
            raise IsADirectory(f"{path!r} is a directory")
        else:
            context.require_idle(path)
        await self._names.purge(path)
        context.nodes.forget_broken(path)
        if there:
            await self._names.remove_if_there(path)
            context.files.on_changed(path)
        if node is not None:
            context.nodes.unnamed(node)

    # --- inside: renaming

    async def _deliver_below(self, path: bytes) -> None:
        """Deliver what is about to get another name. Raises FileBusy if that takes too long."""
        with trio.move_on_after(self._context.options.op_deadline) as scope:
            for node in self._context.nodes.below(path):
                await self._deliverer.deliver(node)
                self._context.nodes.maybe_forget(node)
        if scope.cancelled_caught:
            raise FileBusy(f"{path!r} is still being delivered")

    async def _rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        context = self._context
        wire_path(new)
        listed = await context.directories.ask_entry(new, within=RECENT)
        target = listed or await self._context.entry(new)
        source = await self._context.entry(old)
        if source is None:
            raise NotFound(f"{old!r} does not exist")
        if target is None:
            await self._names.require_new(new)
        elif noreplace:
            raise AlreadyExists(f"{new!r} exists")
        if old == new:
            return
        if target is not None and target.kind is EntryKind.DIRECTORY:
            if source.kind is EntryKind.FILE:
                raise IsADirectory(f"{new!r} is a directory")
            await self._names.require_empty(new)
        elif target is not None and source.kind is EntryKind.DIRECTORY:
            raise NotADirectory(f"{new!r} is not a directory")
        if not fits_rename(old, new):
            raise CrossDevice(f"{old!r} and {new!r} do not fit one request together")
        for path in (old, new):
            if context.nodes.get(path) is None:
                context.require_idle(path)
        await self._move(old, new, listed)
        if source.kind is EntryKind.DIRECTORY:
            context.directories.forget(old)
        context.files.on_renamed(old, new)
        context.nodes.rename(old, new)
        for path in (old, new):
            context.nodes.forget_broken(path)
        for directory in context.own.follow_rename(old, new):
            context.list_later(directory)
        self._context.times.rename(old, new)

    async def _move(self, old: bytes, new: bytes, listed: DirEntry | None) -> None:
        """Rename on the vehicle. listed: what it has at `new`, which is replaced."""
        context, displaced = self._context, self._context.nodes.get(new)
        for node in context.nodes.below(old):
            await self._deliverer.abandon(node)
            if node.draft is not None and node.draft.base is None:
                raise FileBusy(f"{node.path!r} is being written, and not on the vehicle yet")
        if displaced is not None:
            await self._deliverer.look(displaced)
            await self._deliverer.abandon(displaced)
        await self._names.purge(old)
        try:
            async with self._moving(old, new):
                if listed is not None and listed.kind is EntryKind.FILE:
                    context.files.close_readers(new)
                    await self._names.replace(old, new)
                else:
                    if listed is not None:
                        await self._names.remove_directory(new)
                    await self._names.rename(old, new)
        except NotSupported as error:
            raise CrossDevice(str(error)) from error
        if displaced is not None:
            context.nodes.unnamed(displaced)
