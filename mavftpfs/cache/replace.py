"""Puts a verified file in its place. Layer: cache.

A new file is renamed to a name that is free, and never over anything. A file that exists is replaced by one
rename where the server does that in one step; else (FAT refuses it, NuttX removes the target first) the old
file is moved aside, and removed when the new one has its name. `repair` says how an interruption is mended.

Between these two requests the name lacks its file, so the second one is sent even if the vehicle was armed
meanwhile. If it cannot be sent (the link is lost), the name is *torn*: programs go on seeing it, and the next
listing, of which the first comes when the link is back, gives it its file again.
"""

from __future__ import annotations

import errno
import logging

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.names import Names
from mavftpfs.cache.remote import UploadSource
from mavftpfs.cache.reserved import Places
from mavftpfs.protocol.payload import NakCode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    FtpNak,
    MavftpfsError,
    OutcomeUnknown,
)
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")

_HONEST = frozenset({errno.EACCES, errno.EROFS, errno.ENOSPC, errno.ENAMETOOLONG})
"""Refusals that mean what they say; others do not tell whether the server replaces files at all."""


class Replacer:
    """Renames files into place."""

    def __init__(self, context: Context, names: Names) -> None:
        self._context = context
        self._names = names

    async def put(self, places: Places, target: bytes) -> None:
        """Give what was sent its name: in place of the old file, or, if it is new, one that is free.

        Raises:
            AlreadyExists: it is not. Else as replace.
        """
        if places.old is not None:
            await self.replace(places.new, target, places)
            return
        try:
            await self._names.rename(places.new, target)
        except FtpNak as nak:
            if nak.code == NakCode.FILE_EXISTS:
                raise AlreadyExists(f"{target!r} was made by somebody else in the meantime") from nak
            raise

    async def replace(self, source: bytes, target: bytes, places: Places, *, keep_old: bool = False) -> None:
        """Rename over a file that exists; with keep_old that lies at `places.old` afterwards.

        Raises:
            NotSupported: the server does not rename. Else as WriteStore.rename. The old file has its name
            again then, unless the name is torn.
        """
        litter = [places.sidecar] if places.sidecar is not None else []
        if not keep_old and self._replaces_at_once(target) and await self._rename_over(source, target):
            await self._names.discard(target, *litter)
            return
        assert places.old is not None
        if source != places.new:  # else it was written before
            await self.write_sidecar(places, target)
        moved = await self._move_aside(target, places.old)
        try:
            await self._names.rename(source, target, completes=moved)
        except (OutcomeUnknown, trio.Cancelled):
            if moved:
                self.tear(target, places.old)
            raise
        except MavftpfsError:
            if moved:
                await self._undo(places.old, target)
            raise
        self._context.own.found((places.old,))
        if moved and not keep_old:
            litter.insert(0, places.old)
        await self._names.discard(target, *litter)

    async def write_sidecar(self, places: Places, target: bytes) -> None:
        """Write down where short names belong, if the names are short. Raises as Upload.finish."""
        if places.sidecar is None:
            return
        upload = await self._context.writer.open_upload(places.sidecar, _Text(target))
        try:
            upload.wake()
            await upload.finish()
        finally:
            await upload.abort()

    def tear(self, path: bytes, place: bytes) -> None:
        """The file of a name may lie at `place` for now: show it on, and have both directories listed."""
        context = self._context
        entry = context.dentries.entry(path) or context.dentries.entry(place)
        if entry is not None:
            context.dentries.put(path, entry)
        context.own.torn[path] = place
        context.retry_later()
        for directory in (split(path)[0], split(place)[0]):
            context.dentries.expire(directory)
        log.warning("%r may lie under %r until the vehicle is heard again", path, place)

    # --- inside

    def _replaces_at_once(self, target: bytes) -> bool:
        """Return whether the target has the old file or the new one at any time. NuttX, where storages are
        mounted at /fs/NAME, removes the old one first (servers.md 9)."""
        return self._context.writer.traits.rename_replaces is not False and not target.startswith(b"/fs/")

    async def _rename_over(self, source: bytes, target: bytes) -> bool:
        """Return whether the server replaced the target."""
        traits = self._context.writer.traits
        try:
            await self._names.rename(source, target)
        except FtpNak as nak:
            if errno_for(nak) in _HONEST:
                raise
            if nak.code == NakCode.FILE_EXISTS:  # an errno may be a stale one
                traits.rename_replaces = False
            log.debug("the server does not rename %r over %r: %s", source, target, nak)
            return False
        traits.rename_replaces = True
        return True

    async def _move_aside(self, target: bytes, old: bytes) -> bool:
        """Return whether there was something to move."""
        try:
            await self._names.rename(target, old)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT and await self._names.ask(target) is None:
                return False
            raise
        except (OutcomeUnknown, trio.Cancelled):
            self.tear(target, old)
            raise
        return True

    async def _undo(self, place: bytes, path: bytes) -> None:
        try:
            await self._names.rename(place, path, completes=True)
        except BaseException as error:
            self.tear(path, place)
            if not isinstance(error, MavftpfsError):
                raise
            log.debug("%r did not get its file back: %s", path, error)


class _Text(UploadSource):
    """A path to upload."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See UploadSource."""
        chunk = (self._at, self._data[self._at : self._at + limit])
        self._at += len(chunk[1])
        return chunk if chunk[1] else None

    def on_acked(self, offset: int, count: int) -> None:
        """See UploadSource."""

    def on_unsent(self, offset: int, count: int) -> None:
        """See UploadSource: all behind it again, it is at most one path."""
        self._at = min(self._at, offset)

    def on_checkpoint(self) -> None:
        """See UploadSource."""

    def on_rollback(self, everything: bool) -> None:
        """See UploadSource."""
        self._at = 0
