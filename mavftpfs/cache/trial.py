"""Whether the card can rename, as an empty file of ours shows. Layer: cache.

The refusal of another file's rename does not tell: its error number proves nothing (servers.md 12), and the
card may refuse only that name. An ACK does not tell either: the file has to be there under its new name. So
the empty file is removed under its new name. If that works, the rename worked.

There are three steps, so that a delivery can send its file in between: `begin`, `rename` and `end`.
"""

from __future__ import annotations

import logging
from contextlib import suppress

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.reserved import Kind, OwnNames
from mavftpfs.shared.errors import FtpNak, MavftpfsError, PathTooLong
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")


class RenameTrial:
    """Fills `Traits.rename_works`; it stays None if nothing could be seen."""

    def __init__(self, store: VehicleStore, directories: Directories, own: OwnNames, near: bytes) -> None:
        """near: a path in whose directory it is tried."""
        self._store = store
        self._directories = directories
        self._own = own
        self._near = near
        self._first = self._second = b""
        self._place: bytes | None = None  # where the empty file lies

    async def begin(self) -> None:
        """Make the empty file.

        Raises:
            As VehicleStore, but FtpNak.
        """
        own = self._own
        try:
            self._first = own.beside(self._near, Kind.NEW)
            self._second = own.beside(self._first, Kind.NEW)
        except PathTooLong:
            return
        own.in_use |= {self._first, self._second}
        try:
            await self._store.create_empty(self._first)
            self._place = self._first
        except FtpNak as nak:
            log.debug("no file to be renamed could be made: %s", nak)
        finally:
            if self._place is None:
                self.leave()

    async def rename(self) -> bool:
        """Rename it, if that was not done yet. Returns False if the card refuses."""
        if self._place == self._first and self._place is not None:
            try:
                await self._store.rename(self._first, self._second)
                self._place = self._second
            except FtpNak:
                self._store.traits.rename_works = False
            except BaseException as error:
                self.leave()
                if not isinstance(error, MavftpfsError):
                    raise
                log.debug("whether the card can rename is not known: %s", error)
        return self._store.traits.rename_works is not False

    async def end(self) -> None:
        """Remove the file; if it is where it was renamed to, the card can rename."""
        place = self._place
        if place is None:
            return
        try:
            await self._store.remove(place)
            if place == self._second:
                self._store.traits.rename_works = True
        except FtpNak:
            with suppress(MavftpfsError):
                if place == self._second and not await self._is_there(place):
                    self._store.traits.rename_works = False
        except MavftpfsError as error:
            log.debug("%r stays until its directory is listed again: %s", place, error)
        finally:
            self.leave()

    def leave(self) -> None:
        """End the trial. The next listing cleans up what is left."""
        self._place = None
        self._own.in_use -= {self._first, self._second}
        self._directories.expire(split(self._near)[0])

    # --- inside

    async def _is_there(self, path: bytes) -> bool:
        parent, name = split(path)
        return name in (await self._directories.ask(parent)).entries
