"""Puts a verified file in another's place, in steps of which each may be the last. Layer: cache.

Where the server replaces files by renaming, one request does it. Where it refuses (FAT) the old file is
moved aside first and removed last. `asides` says what is left by an interruption and how it is mended.

Between these two requests the name is missing, so the second one is sent even if the vehicle was armed
meanwhile; if it cannot be (the link is lost), the name is *torn*: programs go on seeing it, and the next
listing, of which the first comes when the link is back, gives it its file again.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

from mavftpfs.cache.asides import Places
from mavftpfs.cache.context import Context
from mavftpfs.cache.remote import UploadSource
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import Armed, FtpNak, MavftpfsError, NotSupported, VerificationFailed
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")

_FILE_EXISTS = 8
_HONEST = frozenset({errno.EACCES, errno.EROFS, errno.ENOSPC, errno.ENAMETOOLONG})
"""Refusals that mean what they say; others do not tell whether the server renames at all."""


@dataclass(frozen=True, slots=True)
class Present:
    """Which of the files of a replacement are on the vehicle."""

    new: bool
    old: bool
    target: bool


class Replacer:
    """Renames over files that exist.

    Attributes:
        on_torn: called when a name may lack its file.
    """

    def __init__(self, context: Context, sure: Sure) -> None:
        self._context = context
        self._sure = sure
        self.on_torn: Callable[[], None] = lambda: None

    def reserve(self, places: Places) -> None:
        """From now on the names are in use: no listing's repair touches them."""
        self._context.live |= self._names(places)

    def release(self, places: Places) -> None:
        """What is left under these names is for the next listing to clean up."""
        self._context.live -= self._names(places)

    def leave(self, target: bytes, places: Places) -> None:
        """A replacement is given up half-way: what removes the target has to remove its files, too."""
        parts = (places.new, places.old, places.sidecar)
        self._context.garbage.update({path: target for path in parts if path is not None})

    async def write_sidecar(self, places: Places, target: bytes, source: bytes | None = None) -> None:
        """Write down where short names belong, if the names are short; source: where `moved` came from.

        Raises:
            As WriteStore.open_upload.
        """
        if places.sidecar is None:
            return
        text = target if source is None else target + b"\0" + source
        upload = await self._context.writer.open_upload(places.sidecar, _Bytes(text), create=True)
        try:
            upload.wake()
            await upload.finish()
        finally:
            await upload.abort()

    async def observe(self, places: Places, target: bytes) -> Present:
        """Find out by listings how far an interrupted replacement came.

        Raises:
            As Sure.entry.
        """
        new = await self._sure.entry(places.new)
        parents = {split(path)[0] for path in (places.new, target)}
        old = self._known(places.old)
        there = await self._sure.entry(target) is not None if len(parents) > 1 else self._known(target)
        return Present(new is not None, old, there)

    async def replace_open(self, source: bytes, target: bytes, places: Places) -> bool:
        """Do as `replace`, but leave a target that is there at `places.old`; return False if that cannot be.

        Raises:
            As replace.
        """
        await self.write_sidecar(places, target)
        try:
            await self._sure.rename(target, places.old)
        except FtpNak as nak:
            log.debug("%r cannot be kept for its readers: %s", target, nak)
            return False
        except Armed:
            raise  # before it was sent
        except BaseException:
            self.tear(target, places.old)
            raise
        await self._finish_rename(source, target, places, old=True)
        await self.clean(target, places)
        return True

    async def replace(self, source: bytes, target: bytes, places: Places, present: Present) -> None:
        """Rename `source` to `target`, over the file that is there.

        Raises:
            NotSupported: the server does not rename. Else as WriteStore.rename. The old file is under its
            name again, unless that failed too: then the next listing puts it back.
        """
        if present.new:
            if not present.target:
                await self._finish_rename(source, target, places, old=present.old)
            elif not await self._rename_over(source, target):
                if source not in (places.new, places.moved):  # else it was written before
                    await self.write_sidecar(places, target)
                present = Present(new=True, old=await self._move_aside(target, places.old), target=False)
                await self._finish_rename(source, target, places, old=present.old)
        elif not present.target:
            raise VerificationFailed(f"{source!r} vanished before it was renamed to {target!r}")
        await self.clean(target, places, old=present.old)

    async def replace_by_way(self, source: bytes, target: bytes, places: Places, present: Present) -> None:
        """Do the same for a file that left `source` for `places.moved`; if it fails it goes back there.

        Raises:
            As replace.
        """
        try:
            await self.replace(places.moved, target, places, present)
        except (FtpNak, Armed, NotSupported):
            await self._undo(places.moved, source)
            raise
        except BaseException:
            self.tear(source, places.moved)
            raise

    def tear(self, path: bytes, place: bytes) -> None:
        """The file of a name may lie at `place` for now: show it on, and have both directories listed."""
        context = self._context
        (parent, name), (directory, reserved) = split(path), split(place)
        for listed, known in ((parent, name), (directory, reserved)):
            listing = context.dentries.known(listed)
            entry = None if listing is None else listing.entries.get(known)
            if entry is not None:
                context.dentries.note_created(path, replace(entry, name=name))
                break
        context.torn[path] = place
        self.on_torn()
        for listed in (parent, directory):
            context.dentries.expire(listed, context.clock())
        log.warning("%r may lie under %r until the vehicle is heard again", path, place)

    async def clean(self, target: bytes, places: Places, *, new: bool = False, old: bool = False) -> None:
        """Remove what is not needed any more; what cannot be removed now goes at a later listing."""
        doomed = [places.new] * new + [places.old] * old
        if places.sidecar is not None:
            doomed.append(places.sidecar)
        for path in doomed:
            try:
                await self._sure.remove(path)
            except MavftpfsError as error:
                if errno_for(error) == errno.ENOENT:
                    continue
                log.info("%r stays until its directory is listed again: %s", path, error)
                self._context.garbage.update(dict.fromkeys(doomed, target))
                return

    # --- inside

    def _names(self, places: Places) -> set[bytes]:
        names = {places.new, places.old, places.moved}
        return names if places.sidecar is None else names | {places.sidecar}

    def _known(self, path: bytes) -> bool:
        parent, name = split(path)
        directory = self._context.dentries.known(parent)
        return directory is not None and name in directory.entries

    async def _rename_over(self, source: bytes, target: bytes) -> bool:
        """Return whether the server replaced the target."""
        traits = self._context.writer.traits
        if traits.rename_replaces is False:
            return False
        try:
            await self._sure.rename(source, target)
        except FtpNak as nak:
            if errno_for(nak) in _HONEST:
                raise
            if nak.code == _FILE_EXISTS:  # an errno may be a stale one
                traits.rename_replaces = False
            log.debug("the server does not rename %r over %r: %s", source, target, nak)
            return False
        traits.rename_replaces = True
        return True

    async def _move_aside(self, target: bytes, old: bytes) -> bool:
        """Return whether there was something to move."""
        traits = self._context.writer.traits
        try:
            await self._sure.rename(target, old)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT and await self._sure.entry(target) is None:
                return False
            stale = nak.code == _FILE_EXISTS  # nothing has our aside's name
            renames = traits.rename_works or (traits.rename_replaces is False and not stale)
            if renames or errno_for(nak) in _HONEST:
                raise
            traits.rename_works, traits.rename_replaces = False, None
            raise NotSupported("this server cannot rename") from nak
        except Armed:
            raise  # before it was sent
        except BaseException:
            self.tear(target, old)
            raise
        if traits.rename_replaces is None:
            traits.rename_replaces = False  # it renames, but did not replace a moment ago
        return True

    async def _finish_rename(self, source: bytes, target: bytes, places: Places, *, old: bool) -> None:
        try:
            await self._sure.rename(source, target, completes=old)
        except FtpNak:
            if old:
                await self._undo(places.old, target)
            raise
        except BaseException:
            if old:
                self.tear(target, places.old)
            raise
        self._context.torn.pop(target, None)

    async def _undo(self, place: bytes, path: bytes) -> None:
        try:
            await self._sure.rename(place, path, completes=True)
        except MavftpfsError as error:
            log.debug("%r did not get its file back: %s", path, error)
            self.tear(path, place)
        else:
            self._context.torn.pop(path, None)


class _Bytes(UploadSource):
    """A few bytes to upload."""

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
        """See UploadSource: all again, it is at most one path."""
        self._at = min(self._at, offset)

    def on_checkpoint(self) -> None:
        """See UploadSource."""

    def on_rollback(self, everything: bool) -> None:
        """See UploadSource."""
        self._at = 0
