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
        missing = self._missing(path, directory)
        if path in self._busy or not (reserved or missing):
            return
        blocked = self._context.armed and not self._context.options.write_armed
        self._busy.add(path)
        try:
            for group in leftovers(path, reserved, self._is_dead)[:MAX_GROUPS]:
                if not blocked or self._is_torn(group):
                    await self._mend(path, group)
            torn = self._context.torn
            for place in {split(torn[name])[0] for name in missing if name in torn} - {path}:
                await self._context.directories.ask(place)
        except MavftpfsError as error:
            log.info("%r is cleaned up at a later listing: %s", path, error)
        finally:
            self._busy.discard(path)

    async def mend_torn(self) -> None:
        """The vehicle is heard again: give names that may lack their files what belongs to them."""
        places = {split(place)[0] for place in self._context.torn.values() if place not in self._context.live}
        for directory in places:
            try:
                await self._context.directories.ask(directory)
            except MavftpfsError as error:
                log.info("%r is mended at a later listing: %s", directory, error)

    def _missing(self, path: bytes, directory: Directory) -> list[bytes]:
        """Return the torn names that a listing just made does not show; those it shows are whole again."""
        missing = []
        for name in [name for name in self._context.torn if split(name)[0] == path]:
            if split(name)[1] not in directory.entries:
                missing.append(name)
            elif directory is self._context.dentries.known(path):
                del self._context.torn[name]
        return missing

    def _is_torn(self, group: Group) -> bool:
        return not set(self._context.torn.values()).isdisjoint(group.paths.values())

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
        self._context.torn.pop(path, None)

    def _is_dead(self, path: bytes, owner: bytes, entry: DirEntry) -> bool:
        if path in self._context.live:
            return False
        if owner in self._dead_owners:
            return True
        return self._staleness.is_stale(path, entry.size, self._context.clock())

    async def _mend(self, directory: bytes, group: Group) -> None:
        sidecar = group.paths.get(Kind.SIDECAR)
        if group.target is None and sidecar is not None:
            group = await self._read_sidecar(directory, sidecar, group)
        exists = group.target is not None and await self._exists(group.target)
        node = None if group.target is None else self._context.nodes.get(group.target)
        if node is None or exists:
            await self._repair(group, target_exists=exists)
        elif self._is_torn(group) and not node.lock.locked():
            async with node.lock:  # its delivery could have the same wish
                await self._repair(group, target_exists=exists)
        # else it is about to be written here: a later listing shows what came of it

    async def _repair(self, group: Group, *, target_exists: bool) -> None:
        context, torn = self._context, self._is_torn(group)
        for action in repair(group, target_exists=target_exists):
            self._staleness.forget(action.path)
            if action.to is None:
                await self._sure.remove(action.path)
                context.garbage.pop(action.path, None)
                continue
            log.warning("%r was left by an interruption: renaming it to %r", action.path, action.to)
            await self._sure.rename(action.path, action.to, completes=torn)
            if action.to == group.target and action.path != group.paths.get(Kind.OLD):
                context.files.on_written(action.to)
            context.on_changed(action.to)
            for name in [name for name, place in context.torn.items() if place in group.paths.values()]:
                del context.torn[name]
        self.mended += 1

    async def _exists(self, path: bytes) -> bool:
        try:
            await self._context.directories.find(path)
        except (NotFound, NotADirectory):
            return False
        return True

    async def _read_sidecar(self, directory: bytes, path: bytes, group: Group) -> Group:
        """Return the group with what its sidecar tells, as far as that is plausible."""
        try:
            handle = await open_base(self._context, path)
        except NotFound:
            return group
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return group
            raise  # it may say something another time; without it the only copy could count as litter
        try:
            text = bytes(await handle.read(0, min(handle.size, 2 * RENAME_ROOM)))
        finally:
            handle.close()
        target, _, source = text.partition(b"\0")
        if not _plausible(target) or not target.startswith(join(directory, b"")):
            return group
        ours = _plausible(source) and source.startswith(join(self._context.options.root, b""))
        free = ours and not await self._exists(source)
        return Group(group.paths, group.serial, target, source if free else None)


def _plausible(path: bytes) -> bool:
    """Return whether a sidecar may name this path."""
    try:
        return normalise(path) == path and parse(split(path)[1]) is None
    except LocalProtocolError:
        return False
