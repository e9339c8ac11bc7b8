"""mkdir, rmdir, unlink and rename of paths that may be local or the vehicle's. Layer: cache.

Between the two nothing is renamed: they are two places, so programs hear EXDEV and copy.
"""

from __future__ import annotations

from mavftpfs.cache.context import Context
from mavftpfs.cache.namespace import Namespace
from mavftpfs.cache.overlay import Overlay
from mavftpfs.shared.errors import AlreadyExists, CrossDevice, DirectoryNotEmpty, NotADirectory
from mavftpfs.shared.model import EntryKind, split


class Changes:
    """Changes of names."""

    def __init__(self, context: Context, overlay: Overlay, namespace: Namespace) -> None:
        self._context = context
        self._overlay = overlay
        self._local = overlay.local
        self._namespace = namespace

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
        local = self._local.owns(old)
        if local != self._local.owns(new):
            raise CrossDevice(f"one of {old!r} and {new!r} is not on the vehicle")
        if local:
            await self.require_parent(new)
            if noreplace and split(new)[1] in self._local.names(split(new)[0]):
                raise AlreadyExists(f"{new!r} exists")
            self._local.rename(old, new)
            return
        self._context.require_disarmed()
        for path in (old, new):
            self._overlay.require_free(path)
        self._overlay.require_new(new)
        await self._namespace.rename(old, new, noreplace=noreplace)

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
