"""The names of files: look-ups, changes, and the way of a new file to its name. Layer: cache.

Servers check little before they change a name. RemoveFile removes an empty directory where the server calls
remove(3). On NuttX a rename moves into a directory. A rename may replace a file that others made (servers.md
9, 14.34). So the vehicle is asked what has a name before the name is changed (`Directories.ask_entry`).
Exception: a program that empties a file and writes it anew replaces whatever has the name by then; if that is
a directory of others, it is moved aside, and gets a name back (`repair`).

The session finds out whether a change happened. Here the remembered listings are updated.

**How does a file get its name?** (`Names.commit`) A new file is renamed to a free name, never over another
file. An existing file is replaced by one rename where the server does that in one step. Otherwise (FAT
refuses it, NuttX removes the target first) that takes three requests: the old file is moved aside, the new
one gets the name, the old one is removed. After the first request the name has no file, so the second one is
sent even if the vehicle was armed meanwhile. Once begun, all of that is finished, even if the caller is
cancelled. If the vehicle stops answering, the file stays `unsure`, and `looking` finds out what has its name;
of a `mv`, `repair` gives the name its file again.
"""

from __future__ import annotations

import dataclasses
import errno
import logging
from collections.abc import AsyncIterator, Callable, Collection
from contextlib import asynccontextmanager
from math import inf
from typing import Protocol

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.file import File
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.temporary import Kind, TemporaryNames, is_temporary, parse
from mavftpfs.cache.unsure import Unsure
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
from mavftpfs.shared.sameness import Known

log = logging.getLogger("mavftpfs.cache")

LIES_ASIDE = 10.0
"""Seconds for which the old file stays aside if it was replaced while replies were suspect. After these
seconds a directory is listed if they were."""

_HONEST = frozenset({errno.EACCES, errno.EROFS, errno.ENOSPC, errno.ENAMETOOLONG})
"""Refusals that mean what they say. Others may mean that the server never renames over a file."""

_ONE_LETTER = bytes(range(128)) + b"\x80" * 128
"""Maps all bytes beyond ASCII to one."""


class Later(Protocol):
    """Directories to list after a while; see repair.Repair."""

    def list_later(self, directory: bytes, seconds: float = 0.0, *, only_in_doubt: bool = False) -> None: ...


class Names:
    """Looks names up, changes them, and gives files theirs. Paths are the vehicle's, not below `@`."""

    def __init__(
        self,
        store: VehicleStore,
        directories: Directories,
        own: TemporaryNames,
        files: Collection[File],
        later: Later,
        clock: Callable[[], float],
    ) -> None:
        """files: all that may be sent just now."""
        self._store = store
        self._directories = directories
        self._own = own
        self._files = files
        self._later = later
        self._clock = clock

    # --- asking

    async def size(self, path: bytes) -> int | None:
        """Return the size of a file on the vehicle, asked just now; None if there is none.

        Raises:
            As VehicleStore.stat_size.
        """
        if self._opening_waits(path):
            entry = await self._directories.ask_entry(path)
            if entry is not None:
                return entry.size
        try:
            return await self._store.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            return None

    def _opening_waits(self, path: bytes) -> bool:
        """Return whether to open a file would wait for the end of another one's upload. It takes the server's
        one session, and where OpenFileWO empties files no upload gives way. There a directory is listed."""
        beside = any(file.attempt is not None and file.attempt.path != path for file in self._files)
        return beside and bool(self._store.traits.wo_truncates)

    async def is_free(self, path: bytes) -> bool:
        """Return whether a name is free, asked just now.

        Raises:
            As VehicleStore.stat_size.
        """
        if self._opening_waits(path):
            return await self._directories.ask_entry(path) is None
        return await self._opens_nothing(path)

    async def _opens_nothing(self, path: bytes, *, perhaps_directory: bool = False) -> bool:
        """Return whether a name is free in every spelling that the card takes for it: it is opened.

        perhaps_directory: it may be another spelling of a directory, which does not open either.
        """
        try:
            await self._store.stat_size(path)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return True
            # Other numbers may be those of an older refusal.
            return not perhaps_directory and await self._directories.ask_entry(path) is None
        return False

    async def require_new(self, path: bytes) -> None:
        """Refuse a new name that the card takes for an existing one.

        FAT ignores case, and dots and blanks at the end of a name (servers.md 9). If a listing shows a name
        that differs only in that, the new name is opened to learn that.

        Raises:
            AlreadyExists. Otherwise as entry and VehicleStore.stat_size.
        """
        parent, name = split(path)
        entries = (await self._directories.get(parent)).entries
        plain, alike = _plain(name), set()
        for other, entry in entries.items():
            if _plain(other) == plain and not is_temporary(other):
                alike.add(entry.kind)
        if not alike or name in entries:
            return
        if not await self._opens_nothing(path, perhaps_directory=EntryKind.DIRECTORY in alike):
            raise AlreadyExists(f"{path!r} is the name of another file on this card")

    async def require_empty(self, path: bytes) -> None:
        """Check by a new listing that a directory is empty.

        A directory that looks empty may hold temporary names, of another mount that may be at work.

        Raises:
            DirectoryNotEmpty; FileBusy: only temporary names are in it. Otherwise as Directories.ask.
        """
        names = (await self._directories.ask(path)).entries
        if not all(is_temporary(name) for name in names):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        if names:
            raise FileBusy(f"{path!r} holds temporary files, perhaps of another mount")

    # --- changing

    async def remove(self, path: bytes) -> None:
        """Remove a file; a temporary one at once, because its name is used once. Raises as VehicleStore."""
        async with self._changing(path):
            await self._store.remove(path, at_once=is_temporary(split(path)[1]))
        self._on_gone(path)

    async def remove_if_there(self, path: bytes) -> None:
        """Remove a file that may be gone. Raises as VehicleStore."""
        try:
            await self.remove(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            self._on_gone(path)

    def _on_gone(self, path: bytes) -> None:
        self._own.on_gone(path)
        self._directories.put(path, None)

    async def remove_directory(self, path: bytes) -> None:
        """Remove an empty directory. Raises as VehicleStore."""
        async with self._changing(path):
            await self._store.remove_directory(path)
        self._directories.put(path, None)

    async def make_directory(self, path: bytes) -> None:
        """Make a directory. Raises as VehicleStore."""
        async with self._changing(path):
            await self._store.make_directory(path)
        self._directories.put(path, DirEntry(b"", EntryKind.DIRECTORY))

    async def discard(self, path: bytes) -> None:
        """Remove a temporary file that is no longer needed. If that fails, `repair` removes it."""
        self._own.release(path)
        gone = False
        try:
            await self.remove_if_there(path)
            gone = True
        except MavftpfsError as error:
            log.info("%r stays until its directory is listed again: %s", path, error)
        finally:
            if not gone:  # also if the caller was cancelled
                self._later.list_later(split(path)[0])

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False, over: bool = False) -> None:
        """Rename; both paths fit a request.

        completes: see VehicleStore. over: a file has the new name.

        Raises:
            NotSupported: the card cannot rename. AlreadyExists: the new name is taken, and not `over`.
            Otherwise as VehicleStore.
        """
        store = self._store
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
        self._own.on_gone(old)
        self._directories.rename(old, new)

    async def learn_rename_works(self, near: bytes) -> None:
        """Learn with an empty temporary file whether the card can rename (`Traits.rename_works`). near: a
        path beside which it is made.

        The refusal of another file's rename does not tell: its error number proves nothing (servers.md 12),
        and the card may refuse only that name. An ACK does not tell either. So the file is removed under its
        new name: if that works, the rename worked.

        Raises:
            As VehicleStore, but no FtpNak: after a refusal the trait may be as unknown as before.
        """
        for _ in range(2):  # a REMOVE that arrived twice may be refused, too, but hardly twice in a row
            if await self._try_rename(near):
                return
        self._store.traits.rename_works = False

    async def _try_rename(self, near: bytes) -> bool:
        """Make an empty file, rename and remove it; return False if it was lost on the way."""
        store, own = self._store, self._own
        try:
            first = place = own.need(near, Kind.NEW)
            second = own.need(first, Kind.NEW)
        except PathTooLong:
            return True
        gone = False
        try:
            await store.create_empty(first)
            try:
                await store.rename(first, second)
                place = second
            except FtpNak:
                store.traits.rename_works = False
            await store.remove(place)
            gone = True
            if place == second:
                store.traits.rename_works = True
        except FtpNak as nak:
            log.debug("an empty file beside %r was refused: %s", near, nak)
            return place != second or await self._directories.ask_entry(second) is not None
        finally:
            own.release(first)
            own.release(second)
            self._directories.expire(split(near)[0])
            if not gone:
                self._later.list_later(split(near)[0])
        return True

    async def purge(self, path: bytes) -> None:
        """Before a name goes, remove old files of it, also those of other mounts: repair would bring the name
        back.

        Raises:
            As VehicleStore: then the name has to stay.
        """
        parent, _ = split(path)
        directory = self._directories.known(parent)
        for entry in [] if directory is None else list(directory.entries):
            temporary, left = parse(entry), join(parent, entry)
            old = temporary is not None and temporary.kind is Kind.OLD
            if temporary is not None and old and self._own.target_of(left, temporary) == path:
                await self.remove_if_there(left)

    # --- giving a verified file its name

    async def commit(self, file: File, temporary: bytes, sent: Known) -> None:
        """Give a file its name: rename its verified temporary file, over the file that has the name if it
        has a base. The caller holds the file's lock, and looked at the name just before if the base matters.

        From the first request on the file is `unsure`. It still is when this returns, so the caller can
        compare the file under its name first; then it calls `settle`. sent: what is committed.

        Raises:
            OutcomeUnknown: the file stays unsure. Otherwise as rename: the old file has its name again, and
            the file was not committed.
        """
        path = file.path
        with self._store.finishing():
            unsure = file.unsure = Unsure(temporary, None, sent, file.changes)
            try:
                if file.base is None:
                    await self.rename(temporary, path)
                elif not await self._replaces_at_once(temporary, path):
                    aside = await self._need_aside(path)
                    file.unsure = dataclasses.replace(unsure, aside=aside)
                    await self._swap(temporary, path, aside)
            except OutcomeUnknown:
                raise
            except MavftpfsError:
                file.unsure = None
                raise

    def settle(self, file: File) -> None:
        """Note that it is known what has the name of a file. `repair` removes what is left of its commit."""
        unsure, file.unsure = file.unsure, None
        if unsure is not None:
            own, now = self._own, self._clock()
            for left in filter(None, (unsure.temporary, unsure.aside)):
                if own.needed.get(left, now) == inf:
                    own.release(left)
                    self._later.list_later(split(left)[0])

    async def move_over(self, source: bytes, target: bytes) -> None:
        """Rename a file over another one, for a program.

        Raises:
            NotSupported: the server does not rename. OutcomeUnknown: the target may have no file; `repair`
            gives it one. Otherwise as rename: the target has its file again.
        """
        shown = self._directories.entry(target)
        if await self._replaces_at_once(source, target):
            return
        aside = await self._need_aside(target)
        try:
            with self._store.finishing():
                await self._swap(source, target, aside)
        except OutcomeUnknown:
            if shown is not None:
                self._directories.put(target, shown)  # programs go on seeing it
            self._own.release(aside)
            self._later.list_later(split(target)[0])
            raise

    def _on_unknown(self, *paths: bytes) -> None:
        """Note that it is not known what these names are after an interrupted change: what was listed there,
        and below, proves nothing from now on."""
        for path in paths:
            self._directories.forget(path)
            self._directories.expire(split(path)[0])

    # --- inside

    async def _replaces_at_once(self, source: bytes, target: bytes) -> bool:
        """Rename over a file by one request; return False where that takes three.

        One is enough where the server never leaves the name without a file. NuttX removes the old file first
        (servers.md 9).

        Raises:
            As rename.
        """
        traits = self._store.traits
        if traits.rename_replaces is False or is_on_nuttx(target):
            return False
        try:
            await self.rename(source, target, over=True)
        except FtpNak as nak:
            if errno_for(nak) in _HONEST:
                raise
            if nak.code == NakCode.FILE_EXISTS:  # an errno may be of an older failure
                traits.rename_replaces = False
            log.debug("the server does not rename %r over %r: %s", source, target, nak)
            return False
        traits.rename_replaces = True
        return True

    async def _need_aside(self, path: bytes) -> bytes:
        """Return a new name for the old file of a name.

        The old files that earlier changes left aside are removed first. Otherwise repair could give one of
        them the name while the next change leaves it without a file. Exception: if nothing has the name, one
        of them may be the only copy of the old file.

        Raises:
            As VehicleStore.
        """
        own = self._own
        if self._directories.entry(path) is not None:
            for aside in [aside for aside, target in own.targets.items() if target == path]:
                await self.remove_if_there(aside)
        return own.need(path, Kind.OLD)

    async def _swap(self, source: bytes, target: bytes, aside: bytes) -> None:
        """Move the old file aside, give the new one its name, and remove the old one.

        Raises:
            OutcomeUnknown: the target may have no file. Otherwise as rename: it has the old one again.
        """
        try:
            moved = await self._move_aside(target, aside)
            try:
                await self.rename(source, target, completes=moved)
            except MavftpfsError as error:
                if moved and not isinstance(error, OutcomeUnknown):
                    await self._undo(aside, target)
                raise
        except OutcomeUnknown:
            raise
        except MavftpfsError:
            self._own.on_gone(aside)
            raise
        if moved:
            await self._leave_or_remove(aside)
        else:
            self._own.on_gone(aside)

    async def _move_aside(self, target: bytes, aside: bytes, *, again: bool = True) -> bool:
        """Move the old file aside; return False if there is none.

        again: if a late duplicate had moved it, the look after the refusal gives it its name back, and it is
        moved then.
        """
        try:
            await self.rename(target, aside)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            if await self._directories.ask_entry(target) is None:
                return False
            if not again:
                raise
            return await self._move_aside(target, aside, again=False)
        return True

    async def _undo(self, aside: bytes, path: bytes) -> None:
        """Give an old file its name back.

        Raises:
            OutcomeUnknown: that failed.
        """
        try:
            await self.rename(aside, path, completes=True)
        except MavftpfsError as error:
            raise OutcomeUnknown(f"{path!r} may be {aside!r} for a while: {error}") from error

    async def _leave_or_remove(self, aside: bytes) -> None:
        """Remove the old file of a name that has a new one. In doubt it stays aside for some seconds: a late
        duplicate of the first rename may move the new file over it. That is looked at then, also if the doubt
        arises in these seconds."""
        parent = split(aside)[0]
        if self._store.in_doubt():
            self._own.needed[aside] = self._clock() + LIES_ASIDE
        else:
            await self.discard(aside)
        self._later.list_later(parent, LIES_ASIDE, only_in_doubt=True)

    @asynccontextmanager
    async def _changing(self, *paths: bytes) -> AsyncIterator[None]:
        """If the outcome of the body is unknown, forget what these names were (`_on_unknown`)."""
        try:
            with self._directories.changing(*paths):
                yield
        except OutcomeUnknown:
            self._on_unknown(*paths)
            raise


def _plain(name: bytes) -> bytes:
    """Return a key that is equal for all names that a card may take for one name. A card ignores the case of
    letters, and beyond ASCII it folds bytes by its code page (by page 850 FatFs folds the UTF-8 of ä and å).
    """
    return name.rstrip(b". ").lower().translate(_ONE_LETTER)
