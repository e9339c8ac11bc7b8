"""What the vehicle has under a name, and changes of names. Layer: cache.

Servers do what they are told to whatever has the name by then: RemoveFile takes an empty directory where the
server calls remove(3), a rename moves into a directory on NuttX, and replaces a file that others made
(servers.md 9, 14.34). So whoever is about to change a name asks `current`, not what is remembered of it.

Whether a change happened is found out by the session; here the remembered listings follow.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import State
from mavftpfs.cache.reserved import Kind, is_reserved, parse
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    DirectoryNotEmpty,
    FileBusy,
    FtpNak,
    MavftpfsError,
    NotADirectory,
    NotFound,
    NotSupported,
    OutcomeUnknown,
    PathTooLong,
)
from mavftpfs.shared.model import DirEntry, EntryKind, folded, join, split

log = logging.getLogger("mavftpfs.cache")

RECENT = 2.0
"""Seconds for which what was seen of a name is taken to be true when the name is about to be changed. So the
removal of many files does not list their directory before each."""


class Names:
    """Looks names up and changes them. Paths are the vehicle's, not local, not below `@`."""

    def __init__(self, context: Context) -> None:
        self._context = context

    # --- asking

    async def entry(self, path: bytes) -> DirEntry | None:
        """Return what a path is, drafts included; None if it does not exist though its directory does.

        Raises:
            NotFound, NotADirectory: its directory. Else as RemoteStore.list_directory.
        """
        node = self._context.nodes.get(path)
        if node is not None and node.draft is not None and node.draft.state is not State.STALE:
            return DirEntry(split(path)[1], EntryKind.FILE, node.draft.size)
        return await self.listed(path)

    async def need(self, path: bytes) -> DirEntry:
        """Return what a path is, drafts included. Raises as entry; NotFound if it does not exist."""
        entry = await self.entry(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return entry

    async def listed(self, path: bytes) -> DirEntry | None:
        """Return what the vehicle has there, as far as is remembered. Raises as entry."""
        parent, name = split(path)
        return (await self._context.directories.get(parent)).entries.get(name)

    async def current(self, path: bytes, *, free: bool = False) -> DirEntry | None:
        """Return what the vehicle has there, as it was shown to be at most RECENT ago.

        free: that it is nothing counts for no longer than that either. Else the time that the listing took is
        not counted.

        Raises:
            As entry; VehicleLost instead of an old answer.
        """
        parent, name = split(path)
        context = self._context
        since = context.clock() - RECENT
        known = context.dentries.known(parent)
        if known is not None and known.proven.get(name, float("-inf")) >= since:
            return known.entries[name]
        asked = context.directories.recent(parent, began=since if free else None, ended=since)
        return (await asked).entries.get(name)

    async def ask(self, path: bytes) -> DirEntry | None:
        """Return what a listing asked for just now says of a path.

        Raises:
            As Directories.ask, but None where its directory is gone.
        """
        parent, name = split(path)
        try:
            return (await self._context.directories.ask(parent)).entries.get(name)
        except (NotFound, NotADirectory):
            return None

    async def size(self, path: bytes) -> int:
        """Return the size of a file on the vehicle, asked just now.

        Opening it needs the server's one session. That costs another upload all it sent where OpenFileWO
        empties files: there the directory is listed.

        Raises:
            As WriteStore.stat_size.
        """
        context = self._context
        if context.writer.traits.wo_truncates:
            for node in context.nodes:
                if node.attempt is not None and node.attempt.path != path:
                    entry = await self.ask(path)
                    if entry is not None and entry.size is not None:
                        return entry.size
                    break
        return await context.writer.stat_size(path)

    async def is_free(self, path: bytes, *, perhaps_directory: bool = False) -> bool:
        """Return whether nothing has a name, asked just now by opening it, so in any spelling.

        perhaps_directory: it may be another spelling of a directory, which does not open either.

        Raises:
            As WriteStore.stat_size.
        """
        try:
            await self._context.writer.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return True
            return not perhaps_directory and await self.ask(path) is None  # else of an older refusal
        return False

    async def require_new(self, path: bytes) -> None:
        """Refuse a new name that the card takes for one that is there.

        FAT knows names in any case, and without dots and blanks at their end (servers.md 9). Where a listing
        shows a name that differs in that alone, the new one is opened.

        Raises:
            AlreadyExists. Else as entry and is_free.
        """
        parent, name = split(path)
        entries = (await self._context.directories.get(parent)).entries
        plain = _plain(name)
        alike = [e for n, e in entries.items() if n != name and _plain(n) == plain and not is_reserved(n)]
        if not alike or name in entries:
            return
        if await self.is_free(path, perhaps_directory=any(e.kind is EntryKind.DIRECTORY for e in alike)):
            return
        raise AlreadyExists(f"{path!r} is the name of another file on this card")

    async def require_empty(self, path: bytes) -> None:
        """Check by a listing asked for just now that nothing is in a directory.

        A directory that looks empty may hold reserved names: of a file of ours that is open though it was
        unlinked, or of another mount that is perhaps at work.

        Raises:
            DirectoryNotEmpty; FileBusy: only reserved names are in it. Else as Directories.ask.
        """
        if self._context.nodes.below(path):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        names = (await self._context.directories.ask(path)).entries
        if not all(is_reserved(name) for name in names):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        if names:
            raise FileBusy(f"{path!r} holds files that are open, or temporary files of another mount")

    # --- changing

    async def remove(self, path: bytes) -> None:
        """Remove a file. Raises as WriteStore."""
        async with self._changing(path):
            await self._context.writer.remove(path)
        self._context.dentries.put(path, None)

    async def remove_if_there(self, path: bytes) -> None:
        """Remove a file that may be gone. Raises as WriteStore."""
        try:
            await self.remove(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            self._context.dentries.put(path, None)

    async def remove_directory(self, path: bytes) -> None:
        """Remove an empty directory. Raises as WriteStore."""
        async with self._changing(path):
            await self._context.writer.remove_directory(path)
        self._context.dentries.put(path, None)

    async def make_directory(self, path: bytes) -> None:
        """Make a directory. Raises as WriteStore."""
        async with self._changing(path):
            await self._context.writer.make_directory(path)
        self._context.dentries.put(path, DirEntry(b"", EntryKind.DIRECTORY), proven=True)

    async def discard(self, target: bytes, *paths: bytes) -> None:
        """Remove reserved names that are not needed any more; what cannot be removed now goes at a later
        listing, or before `target` is removed."""
        for at, path in enumerate(paths):
            try:
                await self.remove_if_there(path)
            except MavftpfsError as error:
                log.info("%r stays until its directory is listed again: %s", path, error)
                self._context.own.garbage.update(dict.fromkeys(paths[at:], target))
                return

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename, on a server that replaces files perhaps over a file; both paths fit a request.

        completes: see WriteStore.rename.

        Raises:
            NotSupported: the card cannot rename. Else as WriteStore.
        """
        writer = self._context.writer
        if writer.traits.rename_works is False:
            raise NotSupported("this server cannot rename")
        try:
            async with self._changing(old, new):
                await writer.rename(old, new, completes=completes)
        except FtpNak as nak:
            if writer.traits.rename_works is None:
                await self._find_out(old)
                if writer.traits.rename_works is False:
                    raise NotSupported("this server cannot rename") from nak
            raise
        writer.traits.rename_works = True
        self._context.dentries.rename(old, new)

    async def purge(self, path: bytes) -> None:
        """A path is about to lose its name: have nothing of an earlier replacement bring it back.

        Raises:
            As WriteStore: then the name has to stay.
        """
        own, (parent, name) = self._context.own, split(path)
        directory = self._context.dentries.known(parent)
        doomed = [left for left, target in own.garbage.items() if target == path]
        for entry in [] if directory is None else list(directory.entries):
            reserved, left = parse(entry), join(parent, entry)
            ours = reserved is not None and (reserved.owner, reserved.target) == (own.owner, name)
            if ours and left not in own.live and left not in doomed:
                doomed.append(left)
        for left in doomed:
            await self.remove_if_there(left)
            own.garbage.pop(left, None)
        own.torn.pop(path, None)

    # --- inside

    async def _find_out(self, near: bytes) -> None:
        """A first rename was refused: see on an empty file of ours whether the card can rename at all.

        The refusal's number proves nothing (servers.md 12), and it may be that name which the card does not
        take.

        Raises:
            As WriteStore, but FtpNak and OutcomeUnknown.
        """
        context = self._context
        try:
            first = context.own.beside(near, Kind.FRESH)
            second = context.own.beside(first, Kind.FRESH)
        except PathTooLong:
            return
        context.own.live |= {first, second}
        left = first
        try:
            await context.writer.create_empty(first)
            await context.writer.rename(first, second)
            left, context.writer.traits.rename_works = second, True
        except OutcomeUnknown:
            return  # the next listing removes it
        except FtpNak as nak:
            if nak.opcode == Opcode.RENAME:
                context.writer.traits.rename_works = False
        finally:
            context.own.live -= {first, second}
            context.dentries.expire(split(first)[0])
        await self.discard(left, left)

    @asynccontextmanager
    async def _changing(self, *paths: bytes) -> AsyncIterator[None]:
        """If nobody knows whether the body changed names, what is remembered of them proves nothing."""
        try:
            yield
        except (OutcomeUnknown, trio.Cancelled):
            for path in paths:
                self._context.dentries.expire(split(path)[0])
            raise


def _plain(name: bytes) -> bytes:
    return folded(name.rstrip(b". "))
