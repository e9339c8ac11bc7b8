"""mkdir, rmdir, unlink and rename of paths that may be local, the vehicle's, or one of each. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from mavftpfs.cache.context import Context
from mavftpfs.cache.names import Names
from mavftpfs.cache.namespace import Namespace
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.overlay import Overlay
from mavftpfs.shared.errors import AlreadyExists, CrossDevice, DirectoryNotEmpty, FileBusy, NotADirectory
from mavftpfs.shared.model import EntryKind, split


class Changes:
    """Changes of names."""

    def __init__(
        self,
        context: Context,
        names: Names,
        overlay: Overlay,
        namespace: Namespace,
        *,
        open_reader: Callable[[bytes], Awaitable[OpenFile]],
        put: Callable[[bytes, bytes, bool], Awaitable[None]],
    ) -> None:
        """`put(path, data, exclusive)` writes and delivers a whole file."""
        self._context = context
        self._names = names
        self._overlay = overlay
        self._local = overlay.local
        self._namespace = namespace
        self._open_reader = open_reader
        self._put = put

    async def mkdir(self, path: bytes) -> None:
        """See Tree.mkdir."""
        if self._local.owns(path):
            await self.require_parent(path)
            self._local.mkdir(path)
            return
        self._context.require_disarmed()
        self._overlay.require_new(path)
        await self._namespace.mkdir(path)

    async def rmdir(self, path: bytes) -> None:
        """See Tree.rmdir."""
        if self._local.owns(path):
            self._local.rmdir(path)
            return
        self._context.require_disarmed()
        if self._local.names(path):
            raise DirectoryNotEmpty(f"{path!r} holds local files")
        await self._namespace.rmdir(path)
        self._overlay.times.forget(path)

    async def unlink(self, path: bytes) -> None:
        """See Tree.unlink."""
        if self._local.owns(path):
            self._local.unlink(path)
            return
        self._context.require_disarmed()
        self._overlay.require_free(path)
        await self._namespace.unlink(path)
        self._overlay.times.forget(path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool) -> None:
        """See Tree.rename."""
        local_old, local_new = self._local.owns(old), self._local.owns(new)
        if local_old and local_new:
            await self.require_parent(new)
            self._require_no_local(new, noreplace=noreplace)
            self._local.rename(old, new)
            return
        self._context.require_disarmed()
        for path in (old, new):
            self._overlay.require_free(path)
        if not local_new:
            self._overlay.require_new(new)
        if local_old or local_new:
            await self._rename_across(old, new, to_vehicle=local_old, noreplace=noreplace)
        else:
            await self._namespace.rename(old, new, noreplace=noreplace)

    async def _rename_across(self, old: bytes, new: bytes, *, to_vehicle: bool, noreplace: bool) -> None:
        """Rename between a local name and one of the vehicle's: a copy, since they are two places.

        Raises:
            FileBusy: a program writes the file, or did meanwhile. It stays then.
        """
        if await self._is_directory(old):
            raise CrossDevice(f"{old!r} and {new!r} are in different places")
        source = await self._open_reader(old)
        try:
            if to_vehicle:
                await self._copy_to_vehicle(old, new, source, noreplace=noreplace)
                self._local.unlink(old)
            else:
                await self._move_from_vehicle(old, new, source, noreplace=noreplace)
        finally:
            await source.release()

    async def _copy_to_vehicle(self, old: bytes, new: bytes, source: OpenFile, *, noreplace: bool) -> None:
        self._require_unwritten(old, self._local.find(old).writers)
        data = bytes(await source.read(0, source.size))
        await self._put(new, data, noreplace)
        entry = self._local.find(old)
        self._require_unwritten(old, entry.writers or bytes(entry.data or b"") != data)

    async def _move_from_vehicle(self, old: bytes, new: bytes, source: OpenFile, *, noreplace: bool) -> None:
        node = self._context.nodes.need(old)  # its reader is open
        self._require_unwritten(old, node.writers)
        await self.require_parent(new)
        self._local.require_room(source.size)
        await source.fsync()
        known = node.generation
        data = bytes(await source.read(0, source.size))
        kept = False

        def keep() -> None:
            """Nobody can open it any more: it is what was read, or it stays."""
            nonlocal kept
            same = self._context.nodes.get(old) is node and node.generation == known
            self._require_unwritten(old, node.writers or node.undelivered or not same)
            if not kept:
                self._require_no_local(new, noreplace=noreplace)
                self._local.put(new, data)
                source.close()  # else it would be kept on the vehicle for this reader
                kept = True

        await self._namespace.unlink(old, first=keep)
        self._overlay.times.forget(old)

    def _require_unwritten(self, path: bytes, writing: int) -> None:
        if writing:
            raise FileBusy(f"{path!r} is being written, so it cannot be moved to another place")

    async def require_parent(self, path: bytes) -> None:
        """Check that the directory of a local path exists, here or on the vehicle.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        parent = split(path)[0]
        if not self._local.owns(parent):
            await self._context.directories.get(parent)
        elif self._local.find(parent).kind is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{parent!r} is not a directory")

    # --- inside

    def _require_no_local(self, path: bytes, *, noreplace: bool) -> None:
        parent, name = split(path)
        if noreplace and name in self._local.names(parent):
            raise AlreadyExists(f"{path!r} exists")

    async def _is_directory(self, path: bytes) -> bool:
        if self._local.owns(path):
            return self._local.find(path).kind is EntryKind.DIRECTORY
        entry = await self._names.entry(path)
        return entry is not None and entry.kind is EntryKind.DIRECTORY
