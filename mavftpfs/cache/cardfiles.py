"""The files and directories of the vehicle's card, as the tree asks for them. Layer: cache."""

from __future__ import annotations

from mavftpfs.cache import delivery, namespace, reading, uploads, writing
from mavftpfs.cache.attributes import Stat, shown_mtime
from mavftpfs.cache.card import Card
from mavftpfs.cache.directories import Directory, Found
from mavftpfs.cache.file import File, State
from mavftpfs.cache.handles import ReadHandle, WriteHandle
from mavftpfs.cache.source import Opening, Source
from mavftpfs.cache.temporary import is_temporary
from mavftpfs.shared.errors import AlreadyExists, IsADirectory, NotDeliveredYet, NotFound
from mavftpfs.shared.model import EntryKind, join, split


class CardFiles(Source):
    """The card's files and directories, pending changes included. Paths are the vehicle's."""

    def __init__(self, card: Card) -> None:
        self._card = card

    # --- asking

    async def stat(self, path: bytes) -> Stat:
        """Return attributes; the root's cost no traffic."""
        card = self._card
        if path == card.options.root:
            return Stat(EntryKind.DIRECTORY, 0, shown_mtime(path, None), card.options.attributes_hold)
        self._require_shown(path)
        file = card.find(path)
        if file is not None and file.is_local:
            return self.stat_of(file)
        return self.stat_listed(path, await card.directories.find(path))

    def stat_of(self, file: File) -> Stat:
        """Return the attributes of a file that was changed here."""
        card = self._card
        assert file.folder is not None
        mtime_ns = file.folder.times.peek(file.name)
        if mtime_ns is None:
            entry = card.directories.entry(file.path)
            listed = entry.mtime if entry is not None and file.state is State.CLEAN else None
            mtime_ns = shown_mtime(file.path, listed)
        return Stat(EntryKind.FILE, file.size, mtime_ns, card.options.attributes_hold)

    def stat_listed(self, path: bytes, found: Found) -> Stat:
        """Return the attributes of what a listing shows."""
        card, (parent, name) = self._card, split(path)
        valid_for = max(0.0, min(card.options.attributes_hold, card.directories.left(found.directory)))
        file, folder = card.find(path), card.root.find_folder(parent)
        user_set = None
        if folder is not None and (file is None or not file.is_local):  # else no listing tells of it
            user_set = folder.times.get(name, found.size, found.entry.mtime)
        mtime_ns = shown_mtime(path, found.entry.mtime) if user_set is None else user_set
        return Stat(found.entry.kind, found.size, mtime_ns, valid_for)

    async def list(self, path: bytes) -> tuple[Directory, dict[bytes, Stat]]:
        """Return a directory's listing, and what it shows.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        card = self._card
        directory = await card.directories.get(path)
        shown = {}
        for name, entry in directory.entries.items():
            if card.options.read_only or not is_temporary(name):
                shown[name] = self.stat_listed(join(path, name), Found(entry, directory))
        folder = card.root.find_folder(path)
        for child in [] if folder is None else folder.children.values():
            if isinstance(child, File) and child.is_local:
                shown[child.name] = self.stat_of(child)
        return directory, shown

    async def crc32(self, path: bytes) -> int:
        """Return the vehicle's CRC32 of a file."""
        card = self._card
        file = card.find(path)
        if file is not None and file.undelivered:
            raise NotDeliveredYet(f"{path!r} is not on the vehicle yet")
        self._require_not_root(path)
        found = await card.directories.find(path)
        if found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        card.directories.require_heard()
        return await card.store.crc32(path, size=found.size)

    # --- opening

    async def open(self, path: bytes, how: Opening) -> ReadHandle:
        """Open a file."""
        card = self._card
        if how.write:
            return await self._open_for_writing(path, truncate=how.truncate)
        self._require_not_root(path)
        self._require_shown(path)
        async with card.paths.hold(path, shared=True):
            file, same = await reading.opened(card, path)
            return ReadHandle(card, file, same=same)

    async def _open_for_writing(self, path: bytes, *, truncate: bool) -> WriteHandle:
        card = self._card
        card.require_disarmed()
        await uploads.remove_parts(card, path)
        async with card.paths.hold(path, shared=True):
            handle = WriteHandle(card, await writing.for_writing(card, path, truncate=truncate))
        if truncate:
            try:
                await handle.truncate(0)
            except BaseException:
                handle.close()
                raise
        return handle

    async def create(self, path: bytes, *, exclusive: bool) -> WriteHandle:
        """Make a file, or open the one that is there."""
        card = self._card
        card.require_disarmed()
        await uploads.remove_parts(card, path)
        async with card.paths.hold(path, shared=True):
            file = await writing.made(card, path)
            if file is not None:
                handle = WriteHandle(card, file)
                handle.on_made()
                return handle
        if exclusive:
            raise AlreadyExists(f"{path!r} exists")
        return await self._open_for_writing(path, truncate=False)

    # --- changing

    async def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file, and deliver it, unless another program has it open for writing."""
        card = self._card
        card.require_changeable()
        async with card.paths.hold(path, shared=True):
            file = await writing.for_writing(card, path, truncate=size == 0)
            handle = WriteHandle(card, file)  # also beside other writers: they may end meanwhile
        had = file.undelivered
        try:
            await handle.truncate(size)
            if file.writers == 1:  # else the others deliver it
                await delivery.deliver(card, file)
        except BaseException:
            # A call that was interrupted cannot wait for the lock: who has that, delivers the file.
            others = had or file.writers > 1 or file.lock.locked()
            if file.undelivered and not (others or file.lies_in_place):
                await writing.drop(card, file)
            raise
        finally:
            handle.close()

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Show this mtime until the file changes."""
        folder, name = self._card.root.home(path)
        folder.times.set(name, mtime_ns)

    async def mkdir(self, path: bytes) -> None:
        """Make a directory."""
        await namespace.mkdir(self._card, path)

    async def rmdir(self, path: bytes) -> None:
        """Remove an empty directory."""
        await namespace.rmdir(self._card, path)

    async def unlink(self, path: bytes) -> None:
        """Remove a file."""
        await namespace.unlink(self._card, path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """Rename a file or directory."""
        await namespace.rename(self._card, old, new, noreplace=noreplace)

    # --- inside

    def _require_not_root(self, path: bytes) -> None:
        if path == self._card.options.root:
            raise IsADirectory("the mount's root is a directory")

    def _require_shown(self, path: bytes) -> None:
        if is_temporary(split(path)[1]) and not self._card.options.read_only:
            raise NotFound(f"{path!r} is a name of a temporary file")
