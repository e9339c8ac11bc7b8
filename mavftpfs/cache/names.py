"""What a path is: by drafts, by listings, by listings of just now, and in another spelling. Layer: cache.

Servers do what they are told to whatever has the name by then: RemoveFile takes an empty directory where the
server calls remove(3), a rename moves into a directory on NuttX, and replaces a file that others made
(servers.md 9, 14.34). So whoever is about to change a name asks `current`, not what is remembered of it.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import trio

from mavftpfs.cache.asides import is_reserved
from mavftpfs.cache.context import Context
from mavftpfs.cache.remote import FREE_FOR
from mavftpfs.cache.shortnames import is_short
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, LocalProtocolError, MavftpfsError
from mavftpfs.shared.model import DirEntry, EntryKind, folded, join, split

log = logging.getLogger("mavftpfs.cache")


class Names:
    """Looks names up. Paths are the vehicle's, not local, not below `@`."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._trying = trio.Lock()

    async def entry(self, path: bytes) -> DirEntry | None:
        """Return what a path is, drafts included; None if it does not exist though its directory does.

        Raises:
            NotFound, NotADirectory: its directory. Else as RemoteStore.list_directory.
        """
        return self._drafted(path) or await self.listed(path)

    async def listed(self, path: bytes) -> DirEntry | None:
        """Return what the vehicle has there, as far as is remembered.

        Raises:
            As entry.
        """
        parent, name = split(path)
        return (await self._context.directories.get(parent)).entries.get(name)

    async def current(self, path: bytes, *, free: bool = False) -> DirEntry | None:
        """Return what the vehicle has there, as it was shown to be at most FREE_FOR ago.

        free: that it is nothing counts for no longer than that either. Else the time that the listing took is
        not counted, so that the removal of many files does not list a large directory before each.

        Raises:
            As entry; VehicleLost instead of an old answer.
        """
        parent, name = split(path)
        context = self._context
        since = context.clock() - FREE_FOR
        known = context.dentries.known(parent)
        if known is not None and known.proven.get(name, float("-inf")) >= since:
            return known.entries[name]
        asked = context.directories.recent(parent, began=since if free else None, ended=since)
        return (await asked).entries.get(name)

    async def other_spelling(self, path: bytes) -> bytes | None:
        """Return the listed spelling of the file or directory that a path not listed itself would open.

        CreateFile of `README` empties `readme` where the card folds case (servers.md 9): FatFs that of all
        names, NuttX that of short ones.
        """
        parent, name = split(path)
        entries = (await self._context.directories.get(parent)).entries
        folded = name.lower()
        others = [n for n in entries if n != name and n.lower() == folded and not is_reserved(n)]
        if not others or name in entries:
            return None
        # Short ones first: what opens by their name tells nothing about the long ones.
        for other in sorted(others, key=is_short, reverse=True):
            if await self._is_other(parent, name, entries[other]):
                return join(parent, other)
        return None

    async def require_kept(self, path: bytes) -> None:
        """Refuse a new name that the card would take for another one, of which it would change the file.

        FatFs drops dots and blanks at the end of every name (its create_name), NuttX the dot behind a short
        one only (its fat_parsesfname): files of our own show it. Where a file has a name like it (`folded`),
        it is looked, too, whether the new one opens it although no listing shows that.

        Raises:
            LocalProtocolError. Else as entry and WriteStore.create_empty, stat_size; PathTooLong.
        """
        parent, name = split(path)
        entries = (await self._context.directories.get(parent)).entries
        if name in entries:
            return
        plain = _without_end(name)
        if len(plain) < len(name) and await self._drops_end(path):
            raise LocalProtocolError(f"this card drops dots and blanks at the end of names as {name!r}")
        files = [n for n, entry in entries.items() if entry.kind is EntryKind.FILE]
        alike = any(_without_end(n) == plain and n.lower() != name.lower() for n in files)
        if alike and await self._opens(path):
            raise LocalProtocolError(f"this card takes {name!r} for the name of another file")

    # --- inside

    async def _drops_end(self, path: bytes) -> bool:
        """Return whether the card drops the end of a name, or may: what shows nothing proves nothing."""
        traits, short = self._context.writer.traits, is_short(split(path)[1])
        if traits.drops_ends:
            return True
        async with self._trying:  # the short name is always the same
            if short and traits.drops_short_ends is None:
                traits.drops_short_ends = await self._learn_ends(path, short=True)
            elif not short and traits.drops_ends is None:
                traits.drops_ends = await self._learn_ends(path, short=False)
        return (traits.drops_short_ends if short else traits.drops_ends) is not False

    async def _learn_ends(self, path: bytes, *, short: bool) -> bool | None:
        async with self._own_file(self._probe(path, short=short)) as own:
            return await self._finds(own, own + b".")

    def _drafted(self, path: bytes) -> DirEntry | None:
        node = self._context.nodes.get(path)
        if node is None or node.draft is None:
            return None
        return DirEntry(split(path)[1], EntryKind.FILE, node.draft.size)

    async def _is_other(self, parent: bytes, name: bytes, other: DirEntry) -> bool:
        """Return whether a name is, or may be, that other one which differs in case only."""
        traits, short = self._context.writer.traits, is_short(name) and is_short(other.name)
        if traits.folds_case:
            return True
        if short:
            if traits.folds_short_case is None:
                traits.folds_short_case = await self._learn_folding(join(parent, name), other, short=True)
            return traits.folds_short_case is not False
        if traits.folds_case is None:
            traits.folds_case = await self._learn_folding(join(parent, name), other, short=False)
        return traits.folds_case is not False

    async def _learn_folding(self, path: bytes, other: DirEntry, *, short: bool) -> bool | None:
        """Find out by a file whether names are found in another case; directories are not opened for it."""
        parent = split(path)[0]
        try:
            if other.kind is EntryKind.FILE:
                return await self._finds(join(parent, other.name), path)
            async with self._trying, self._own_file(self._probe(path, short=short)) as own:
                above, name = split(own)
                return await self._finds(own, join(above, name.swapcase()))
        except FtpNak as nak:
            log.info("whether names in %r are told apart by case stays unknown: %s", parent, nak)
            return None

    async def _finds(self, there: bytes, spelled: bytes) -> bool | None:
        """Open a file by another spelling of its name; a refusal counts if it is still there by its own."""
        if await self._opens(spelled):
            return True
        return False if await self._opens(there) else None

    async def _opens(self, path: bytes) -> bool:
        """Return whether a file is there.

        Raises:
            FtpNak: refused for any reason but that it is not.
        """
        try:
            await self._context.writer.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            return False
        return True

    def _probe(self, path: bytes, *, short: bool) -> bytes:
        namer = self._context.namer
        return namer.short_probe(path) if short else namer.probes(path)[0]

    @asynccontextmanager
    async def _own_file(self, own: bytes) -> AsyncIterator[bytes]:
        """Try with an empty file of our own, which is removed, here or at a later listing."""
        context = self._context
        context.live.add(own)
        try:
            await context.writer.create_empty(own)
            yield own
        finally:
            context.live.discard(own)
            await self._remove_own(own)

    async def _remove_own(self, own: bytes) -> None:
        try:
            await self._context.writer.remove(own)
        except MavftpfsError as error:
            log.debug("%r goes at a later listing: %s", own, error)
        self._context.dentries.expire(split(own)[0], self._context.clock())


def _without_end(name: bytes) -> bytes:
    return folded(name.rstrip(b". "))
