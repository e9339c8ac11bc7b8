"""What the vehicle has under a name, changes of names, and how files get their names. Layer: cache.

Servers check little before they change a name. RemoveFile removes an empty directory where the server calls
remove(3). On NuttX a rename moves into a directory. A rename may replace a file that others made (servers.md
9, 14.34). So the vehicle is asked what has a name before the name is changed (`Directories.ask_entry`).

The session finds out whether a change happened. Here the remembered listings are updated.

A new file is renamed to a free name, never over another file. An existing file is replaced by one rename
where the server does that in one step. Else (FAT refuses it, NuttX removes the target first) it takes three
requests: the old file is moved aside, the new one gets the name, the old one is removed. After the first
request the name has no file. So the second one is sent even if the vehicle was armed meanwhile. If it cannot
be sent because the link is lost, the replacement is unfinished (`replacements`): programs still see the name,
and when the link is back a listing is made and the name gets a file again (`repair`).
"""

from __future__ import annotations

import errno
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from mavftpfs.cache.context import Context
from mavftpfs.cache.replacements import Replacement
from mavftpfs.cache.reserved import Kind, is_reserved, parse
from mavftpfs.protocol.payload import NakCode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    DirectoryNotEmpty,
    FileBusy,
    FtpNak,
    MavftpfsError,
    NotSupported,
    OutcomeUnknown,
    PathTooLong,
)
from mavftpfs.shared.model import DirEntry, EntryKind, is_on_nuttx, join, split

log = logging.getLogger("mavftpfs.cache")

LIES_ASIDE = 10.0
"""Seconds for which the old file stays aside when it was replaced in doubt."""

_HONEST = frozenset({errno.EACCES, errno.EROFS, errno.ENOSPC, errno.ENAMETOOLONG})
"""Refusals that mean what they say. Others may mean that the server never renames over a file."""

_ONE_LETTER = bytes(range(128)) + b"\x80" * 128
"""Maps all bytes beyond ASCII to one."""


class Names:
    """Looks names up, changes them, and gives files theirs. Paths are the vehicle's, not below `@`."""

    def __init__(self, context: Context) -> None:
        self._context = context

    # --- asking

    async def size(self, path: bytes) -> int | None:
        """Return the size of a file on the vehicle, asked just now; None if there is none.

        Raises:
            As VehicleStore.stat_size.
        """
        if self._opening_waits(path):
            entry = await self._context.directories.ask_entry(path)
            if entry is not None:
                return entry.size
        try:
            return await self._context.store.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            return None

    def _opening_waits(self, path: bytes) -> bool:
        """Return whether to open a file would wait for the end of another one's upload. It takes the server's
        one session, and where OpenFileWO empties files no upload gives way. There a directory is listed."""
        context = self._context
        beside = any(n.attempt is not None and n.attempt.path != path for n in context.nodes)
        return beside and bool(context.store.traits.wo_truncates)

    async def is_free(self, path: bytes) -> bool:
        """Return whether a name is free, asked just now.

        Raises:
            As VehicleStore.stat_size.
        """
        if self._opening_waits(path):
            return await self._context.directories.ask_entry(path) is None
        return await self._opens_nothing(path)

    async def _opens_nothing(self, path: bytes, *, perhaps_directory: bool = False) -> bool:
        """Return whether a name is free in every spelling that the card takes for it: it is opened.

        perhaps_directory: it may be another spelling of a directory, which does not open either.
        """
        try:
            await self._context.store.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return True
            # Other numbers may be those of an older refusal.
            return not perhaps_directory and await self._context.directories.ask_entry(path) is None
        return False

    async def require_new(self, path: bytes) -> None:
        """Refuse a new name that the card takes for an existing one.

        FAT ignores case, and dots and blanks at the end of a name (servers.md 9). If a listing shows a name
        that differs only in that, the new name is opened to find out.

        Raises:
            AlreadyExists. Else as entry and VehicleStore.stat_size.
        """
        parent, name = split(path)
        entries = (await self._context.directories.get(parent)).entries
        plain, alike = _plain(name), set()
        for other, entry in entries.items():
            if _plain(other) == plain and not is_reserved(other):
                alike.add(entry.kind)
        if not alike or name in entries:
            return
        if not await self._opens_nothing(path, perhaps_directory=EntryKind.DIRECTORY in alike):
            raise AlreadyExists(f"{path!r} is the name of another file on this card")

    async def require_empty(self, path: bytes) -> None:
        """Check by a new listing that a directory is empty.

        A directory that looks empty may hold reserved names, of another mount that may be at work.

        Raises:
            DirectoryNotEmpty; FileBusy: only reserved names are in it. Else as Directories.ask.
        """
        if self._context.nodes.below(path):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        names = (await self._context.directories.ask(path)).entries
        if not all(is_reserved(name) for name in names):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        if names:
            raise FileBusy(f"{path!r} holds temporary files, perhaps of another mount")

    # --- changing

    async def remove(self, path: bytes) -> None:
        """Remove a file. Raises as VehicleStore. A reserved name is used once, so it does not rest before."""
        async with self._changing(path):
            await self._context.store.remove(path, at_once=is_reserved(split(path)[1]))
        self._context.directories.put(path, None)

    async def remove_if_there(self, path: bytes) -> None:
        """Remove a file that may be gone. Raises as VehicleStore."""
        try:
            await self.remove(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            self._context.directories.put(path, None)

    async def remove_directory(self, path: bytes) -> None:
        """Remove an empty directory. Raises as VehicleStore."""
        async with self._changing(path):
            await self._context.store.remove_directory(path)
        self._context.directories.put(path, None)

    async def make_directory(self, path: bytes) -> None:
        """Make a directory. Raises as VehicleStore."""
        async with self._changing(path):
            await self._context.store.make_directory(path)
        self._context.directories.put(path, DirEntry(b"", EntryKind.DIRECTORY))

    async def discard(self, path: bytes) -> None:
        """Remove a reserved name that is not needed any more. If that fails, it is removed after the next
        listing of its directory, or by `purge`."""
        try:
            await self.remove_if_there(path)
        except MavftpfsError as error:
            log.info("%r stays until its directory is listed again: %s", path, error)
            self._context.directories.expire(split(path)[0])

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False, over: bool = False) -> None:
        """Rename; both paths fit a request.

        completes: see VehicleStore. over: a file has the new name.

        Raises:
            NotSupported: the card cannot rename. AlreadyExists: the new name is taken, and not `over`. Else
            as VehicleStore.
        """
        store = self._context.store
        if store.traits.rename_works is False:
            raise NotSupported("this server cannot rename")
        try:
            async with self._changing(old, new):
                await store.rename(old, new, completes=completes)
        except FtpNak as nak:
            taken = nak.code == NakCode.FILE_EXISTS
            if store.traits.rename_works is None and not (over and taken):  # FAT: the next rename tells more
                await self.learn_rename_works(old)
                if store.traits.rename_works is False:
                    raise NotSupported("this server cannot rename") from nak
            if taken and not over:
                raise AlreadyExists(f"{new!r} was made by somebody else in the meantime") from nak
            raise
        self._context.directories.rename(old, new)

    async def learn_rename_works(self, near: bytes) -> None:
        """Learn with an empty file of ours whether the card can rename (`Traits.rename_works`). near: a path
        beside which it is made.

        The refusal of another file's rename does not tell: its error number proves nothing (servers.md 12),
        and the card may refuse only that name. An ACK does not tell either. So the file is removed under its
        new name: if that works, the rename worked.

        Raises:
            As VehicleStore, but no FtpNak: after a refusal the trait may be as unknown as before.
        """
        for _ in range(2):  # a REMOVE that arrived twice may be refused, too, but hardly twice in a row
            if await self._try_rename(near):
                return
        self._context.store.traits.rename_works = False

    async def _try_rename(self, near: bytes) -> bool:
        """Make an empty file, rename and remove it; return False if it was lost on the way."""
        context, store, own = self._context, self._context.store, self._context.own
        try:
            first = place = own.beside(near, Kind.NEW)
            second = own.beside(first, Kind.NEW)
        except PathTooLong:
            return True
        own.in_use |= {first, second}
        try:
            await store.create_empty(first)
            try:
                await store.rename(first, second)
                place = second
            except FtpNak:
                store.traits.rename_works = False
            await store.remove(place)
            if place == second:
                store.traits.rename_works = True
        except FtpNak as nak:
            log.debug("an empty file beside %r was refused: %s", near, nak)
            return place != second or await context.directories.ask_entry(second) is not None
        finally:
            own.in_use -= {first, second}
            context.directories.expire(split(near)[0])  # the next listing cleans up what is left
        return True

    async def purge(self, path: bytes) -> None:
        """Before a name goes, remove what earlier replacements left: it would bring the name back.

        Raises:
            As VehicleStore: then the name has to stay.
        """
        await self.remove_aside(path)
        own, (parent, name) = self._context.own, split(path)
        directory = self._context.directories.known(parent)
        ended = self._context.replacements.end(path)
        needed = own.in_use | self._context.replacements.needed_asides()
        for entry in [] if directory is None else list(directory.entries):
            reserved, left = parse(entry), join(parent, entry)
            if reserved is None or reserved.owner != own.owner or left in needed:
                continue
            if reserved.target in (name, None):
                try:
                    await self.remove_if_there(left)
                except MavftpfsError:
                    if ended is not None:
                        self._context.replacements.put(path, ended)
                    raise

    async def remove_aside(self, path: bytes) -> None:
        """Remove the old file that still lies aside, if one does: the name is about to change again."""
        own, replacements = self._context.own, self._context.replacements
        record = replacements.get(path)
        if record is None or not record.placed:
            return
        replacements.end(path)
        if record.aside in own.in_use:
            own.in_use.discard(record.aside)
            await self.remove_if_there(record.aside)

    # --- giving a verified file its name

    async def replace(self, source: bytes, target: bytes) -> None:
        """Rename over a file that exists.

        One rename is enough where the server never leaves the name without a file. NuttX removes the old file
        first (servers.md 9).

        Raises:
            NotSupported: the server does not rename. Else as VehicleStore.rename. After an error the old file
            has its name again, unless the replacement is unfinished.
        """
        traits = self._context.store.traits
        if traits.rename_replaces is not False and not is_on_nuttx(target):
            try:
                await self.rename(source, target, over=True)
                traits.rename_replaces = True
                return
            except FtpNak as nak:
                if errno_for(nak) in _HONEST:
                    raise
                if nak.code == NakCode.FILE_EXISTS:  # an errno may be of an older failure
                    traits.rename_replaces = False
                log.debug("the server does not rename %r over %r: %s", source, target, nak)
        await self.remove_aside(target)
        own = self._context.own
        aside = own.beside(target, Kind.OLD)
        own.in_use.add(aside)
        stays = False
        with self._context.store.finishing():
            try:
                if await self._swap(source, target, aside):
                    stays = await self._discard_old(target, aside)
            finally:
                if not stays:
                    own.in_use.discard(aside)

    def on_unknown(self, *paths: bytes) -> None:
        """Note that it is not known what these names are after an interrupted change: the listings and files
        there, and below, prove nothing from now on."""
        for path in paths:
            self._context.directories.forget(path)
            self._context.directories.expire(split(path)[0])
            self._context.files.on_changed(path)

    # --- inside

    async def _swap(self, source: bytes, target: bytes, aside: bytes) -> bool:
        """Move the old file aside, and give the new one its name. Returns False if the old file was gone.

        Raises:
            As replace.
        """
        moved: bool | None = None  # not known
        try:
            try:
                await self.rename(target, aside)
                moved = True
            except FtpNak as nak:
                gone = errno_for(nak) == errno.ENOENT
                if not gone or await self._context.directories.ask_entry(target) is not None:
                    raise
                moved = False
            await self.rename(source, target, completes=moved)
        except OutcomeUnknown:
            if moved is not False:
                self._note_unfinished(target, aside, placed=None if moved else False)
            raise
        except MavftpfsError:
            if moved:
                await self._undo(aside, target)
            raise
        return moved

    async def _discard_old(self, target: bytes, aside: bytes) -> bool:
        """Remove the file that a new one replaced; return whether it stays for now. In doubt it stays until a
        listing shows the new one: a late copy of the first rename may have moved that over the old one.
        `Cleaner.finish` sees to that. Removed or not, the record stays for some seconds: a late copy may
        bring the old file back."""
        context, stays = self._context, self._context.store.in_doubt()
        if not stays:
            await self.discard(aside)
        context.replacements.put(target, Replacement(aside, placed=True, until=context.clock() + LIES_ASIDE))
        context.retry_later()
        return stays

    def _note_unfinished(self, path: bytes, aside: bytes, *, placed: bool | None) -> None:
        """Note that the file of a name may lie aside: go on showing the name, and have its directory
        listed."""
        context = self._context
        entry = context.directories.entry(path) or context.directories.entry(aside)
        if entry is not None:
            context.directories.put(path, entry)
        context.replacements.put(path, Replacement(aside, placed=placed))
        context.retry_later()
        context.directories.expire(split(path)[0])
        log.warning("%r may lie under %r until the vehicle is heard again", path, aside)

    @asynccontextmanager
    async def _changing(self, *paths: bytes) -> AsyncIterator[None]:
        """If the outcome of the body is unknown, forget what these names were (`on_unknown`)."""
        try:
            with self._context.directories.changing(*paths):
                yield
        except OutcomeUnknown:
            self.on_unknown(*paths)
            raise

    async def _undo(self, place: bytes, path: bytes) -> None:
        try:
            await self.rename(place, path, completes=True)
        except MavftpfsError as error:
            self._note_unfinished(path, place, placed=False)
            log.debug("%r did not get its file back: %s", path, error)


def _plain(name: bytes) -> bytes:
    """Return a key that is equal for all names that a card may take for one name. A card ignores the case of
    letters, and beyond ASCII it folds bytes by its code page (by page 850 FatFs folds the UTF-8 of ä and å).
    """
    return name.rstrip(b". ").lower().translate(_ONE_LETTER)
