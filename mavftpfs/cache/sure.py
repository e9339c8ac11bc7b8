"""Changes of the vehicle's names that are known to have happened when they return. Layer: cache.

The reply to a request may be lost although the request was done, and its repetition is then refused
(servers.md 14.4). So a refusal of a repetition, and silence, are checked by a listing asked for just then,
unless whoever sent it did so already (`MavftpfsError.checked`).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial

import trio

from mavftpfs.cache.context import Context
from mavftpfs.shared.errors import (
    FtpNak,
    MavftpfsError,
    NotADirectory,
    NotFound,
    RequestTimeout,
    SessionBusy,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split

_TERMINATE_SESSION = 1


class Sure:
    """mkdir, rmdir, unlink and rename on the vehicle, and what the listings say afterwards."""

    def __init__(self, context: Context) -> None:
        self._context = context

    async def entry(self, path: bytes) -> DirEntry | None:
        """Return what a listing asked for just now says of a path.

        Raises:
            As Directories.ask, but None where its directory is gone.
        """
        parent, name = split(path)
        try:
            return (await self._context.directories.ask(parent)).entries.get(name)
        except (NotFound, NotADirectory):
            return None

    async def remove(self, path: bytes) -> None:
        """Remove a file.

        Raises:
            As WriteStore.
        """
        await self._do(lambda: self._context.writer.remove(path), lambda: self._is_gone(path), path)
        self._context.dentries.note_removed(path)

    async def remove_directory(self, path: bytes) -> None:
        """Remove an empty directory.

        Raises:
            As WriteStore.
        """
        await self._do(lambda: self._context.writer.remove_directory(path), lambda: self._is_gone(path), path)
        self._context.dentries.note_removed(path)

    async def make_directory(self, path: bytes) -> None:
        """Make a directory.

        Raises:
            As WriteStore.
        """
        await self._do(
            lambda: self._context.writer.make_directory(path), lambda: self._is_directory(path), path
        )
        self._context.dentries.note_created(path, DirEntry(split(path)[1], EntryKind.DIRECTORY))

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename, on a server that replaces files perhaps over a file; both paths fit a request.

        completes: see WriteStore.rename.

        Raises:
            As WriteStore.
        """
        rename = partial(self._context.writer.rename, old, new, completes=completes)
        await self._do(rename, lambda: self._is_moved(old, new), old, new)
        self._context.writer.traits.rename_works = True
        self._context.dentries.note_renamed(old, new)
        self._context.dentries.note_proven(new, self._context.clock())

    # --- inside

    async def _do(
        self, act: Callable[[], Awaitable[None]], done: Callable[[], Awaitable[bool]], *paths: bytes
    ) -> None:
        try:
            await act()
        except (FtpNak, RequestTimeout) as error:
            if isinstance(error, FtpNak) and not error.retransmitted:
                raise
            if error.checked:
                self._doubt(paths)
                raise
            if not await _ask(done, error):
                raise
        except trio.Cancelled:
            self._doubt(paths)
            raise

    def _doubt(self, paths: tuple[bytes, ...]) -> None:
        """Nobody knows whether it was done: what is remembered proves nothing any more."""
        for path in paths:
            self._context.dentries.expire(split(path)[0], self._context.clock())

    async def _is_gone(self, path: bytes) -> bool:
        return await self.entry(path) is None

    async def _is_directory(self, path: bytes) -> bool:
        entry = await self.entry(path)
        return entry is not None and entry.kind is EntryKind.DIRECTORY

    async def _is_moved(self, old: bytes, new: bytes) -> bool:
        return await self.entry(old) is None and await self.entry(new) is not None


def may_have_made(error: BaseException) -> bool:
    """Return whether an empty file may be there though WriteStore.create_empty ended with this."""
    if isinstance(error, FtpNak):
        return error.opcode == _TERMINATE_SESSION
    return isinstance(error, RequestTimeout | SessionBusy | trio.Cancelled)


async def _ask(done: Callable[[], Awaitable[bool]], error: MavftpfsError) -> bool:
    """Return whether it was done; if that cannot be found out, raise why it was asked."""
    try:
        return await done()
    except MavftpfsError as second:
        raise error from second
