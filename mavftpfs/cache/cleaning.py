"""Mends what interrupted replacements left, whenever a listing shows it. Layer: cache.

What is to be done is decided by `asides.repair` from names alone; here it is done. Names of another mount
are touched only after they were seen unchanged for a long while.
"""

from __future__ import annotations

import errno
import logging

from mavftpfs.cache.asides import (
    RENAME_ROOM,
    Group,
    Kind,
    Staleness,
    is_reserved,
    leftovers,
    parse,
    repair,
)
from mavftpfs.cache.base import open_base
from mavftpfs.cache.context import Context
from mavftpfs.cache.dentries import Directory
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, LocalProtocolError, MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import DirEntry, join, normalise, split

log = logging.getLogger("mavftpfs.cache")

MAX_GROUPS = 64
"""Interrupted replacements mended per listing."""


class Cleaner:
    """Looks at every listing."""

    def __init__(self, context: Context, sure: Sure, dead_owners: frozenset[bytes]) -> None:
        """`dead_owners`: mounts that are known to have ended."""
        self._context = context
        self._sure = sure
        self._dead_owners = dead_owners | {context.namer.owner}
        self._staleness = Staleness()
        self._busy: set[bytes] = set()
        self.mended = 0

    async def on_swept(self, path: bytes, directory: Directory) -> None:
        """A directory was listed. Raises nothing of ours: the listing is right without us."""
        reserved = [entry for name, entry in directory.entries.items() if is_reserved(name)]
        blocked = self._context.armed and not self._context.options.write_armed
        if not reserved or blocked or path in self._busy:
            return
        self._busy.add(path)
        try:
            for group in leftovers(path, reserved, self._is_dead)[:MAX_GROUPS]:
                await self._mend(path, group)
        except MavftpfsError as error:
            log.info("%r is cleaned up at a later listing: %s", path, error)
        finally:
            self._busy.discard(path)

    async def purge(self, path: bytes) -> None:
        """A path is about to lose its name: have nothing of an earlier replacement bring it back.

        Raises:
            As Sure.remove: then the name has to stay.
        """
        parent, name = split(path)
        directory = self._context.dentries.known(parent)
        doomed = [aside for aside, target in self._context.garbage.items() if target == path]
        for entry in [] if directory is None else list(directory.entries):
            reserved, aside = parse(entry), join(parent, entry)
            ours = reserved is not None and reserved.target == name and reserved.owner in self._dead_owners
            if ours and aside not in self._context.live and aside not in doomed:
                doomed.append(aside)
        for aside in doomed:
            try:
                await self._sure.remove(aside)
            except FtpNak as nak:
                if errno_for(nak) != errno.ENOENT:
                    raise
            self._context.garbage.pop(aside, None)

    def _is_dead(self, path: bytes, owner: bytes, entry: DirEntry) -> bool:
        if path in self._context.live:
            return False
        if owner in self._dead_owners:
            return True
        return self._staleness.is_stale(path, entry.size, self._context.clock())

    async def _mend(self, directory: bytes, group: Group) -> None:
        sidecar = group.paths.get(Kind.SIDECAR)
        if group.target is None and sidecar is not None:
            target = await self._read_sidecar(directory, sidecar)
            group = Group(group.paths, group.serial, target)
        exists = group.target is not None and await self._exists(group.target)
        if group.target is not None and not exists and self._context.nodes.get(group.target) is not None:
            return  # it is about to be written here: a later listing shows what came of it
        for action in repair(group, target_exists=exists):
            self._staleness.forget(action.path)
            if action.to is None:
                await self._sure.remove(action.path)
                self._context.garbage.pop(action.path, None)
            else:
                log.warning("%r was left by an interruption: renaming it to %r", action.path, action.to)
                await self._sure.rename(action.path, action.to)
                self._context.on_changed(action.to)
        self.mended += 1

    async def _exists(self, path: bytes) -> bool:
        try:
            await self._context.directories.find(path)
        except (NotFound, NotADirectory):
            return False
        return True

    async def _read_sidecar(self, directory: bytes, path: bytes) -> bytes | None:
        """Return the target a sidecar names, None if it does not name one below its directory."""
        try:
            handle = await open_base(self._context, path)
        except NotFound:
            return None
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return None
            raise  # it may say something another time; without it the only copy could count as litter
        try:
            text = bytes(await handle.read(0, min(handle.size, RENAME_ROOM)))
            plausible = normalise(text) == text and text.startswith(join(directory, b""))
        except LocalProtocolError:
            return None
        finally:
            handle.close()
        return text if plausible and parse(split(text)[1]) is None else None
