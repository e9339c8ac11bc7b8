"""Mends what interrupted replacements left, whenever a listing shows it. Layer: cache.

What is to be done is decided by `repair` from names alone; here it is done. Names of another mount are
touched only after they were seen unchanged for a long while.
"""

from __future__ import annotations

import errno
import logging

from mavftpfs.cache.context import Context
from mavftpfs.cache.dentries import Directory
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.repair import Group, Staleness, leftovers, repair
from mavftpfs.cache.reserved import RENAME_ROOM, Kind, is_reserved, parse
from mavftpfs.cache.verify import read_small
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, LocalProtocolError, MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import DirEntry, join, normalise, split

log = logging.getLogger("mavftpfs.cache")

MAX_GROUPS = 64
"""Interrupted replacements mended per listing."""


class Cleaner:
    """Looks at every listing."""

    def __init__(self, context: Context, names: Names, dead_owners: frozenset[bytes]) -> None:
        """`dead_owners`: mounts that are known to have ended."""
        self._context = context
        self._names = names
        self._dead_owners = dead_owners | {context.own.owner}
        self._staleness = Staleness()
        self._busy: set[bytes] = set()
        self._delivered: set[Node] = set()
        self.mended = 0

    async def on_swept(self, path: bytes, directory: Directory) -> None:
        """A directory was listed. Raises nothing of ours: the listing is right without us."""
        reserved = [entry for name, entry in directory.entries.items() if is_reserved(name)]
        missing = self._missing(path, directory)
        if path in self._busy or not (reserved or missing):
            return
        self._busy.add(path)
        try:
            for group in leftovers(path, reserved, self._is_dead)[:MAX_GROUPS]:
                if not self._context.blocked or self._is_torn(group):
                    await self._mend(path, group)
            torn = self._context.own.torn
            for place in {split(torn[name])[0] for name in missing if name in torn} - {path}:
                await self._context.directories.ask(place)
        except MavftpfsError as error:
            log.info("%r is cleaned up at a later listing: %s", path, error)
        finally:
            self._busy.discard(path)

    async def mend_torn(self) -> None:
        """The vehicle is heard again: give names that may lack their files what belongs to them."""
        own = self._context.own
        for directory in {split(place)[0] for place in own.torn.values() if place not in own.live}:
            await self._list(directory)

    async def mend(self, node: Node) -> None:
        """Do so for one file, whose lock the caller has."""
        place = self._context.own.torn.get(node.path, node.path)
        self._delivered.add(node)
        try:
            for directory in {split(place)[0], split(node.path)[0]}:
                await self._list(directory)
        finally:
            self._delivered.discard(node)

    # --- inside

    async def _list(self, directory: bytes) -> None:
        try:
            await self._context.directories.ask(directory)
        except MavftpfsError as error:
            log.info("%r is mended at a later listing: %s", directory, error)

    def _missing(self, path: bytes, directory: Directory) -> list[bytes]:
        """Return the torn names that a listing just made does not show; those it shows are whole again."""
        missing, torn = [], self._context.own.torn
        for name in [name for name in torn if split(name)[0] == path]:
            if split(name)[1] not in directory.entries:
                missing.append(name)
            elif directory is self._context.dentries.known(path):
                del torn[name]
        return missing

    def _is_torn(self, group: Group) -> bool:
        return not set(self._context.own.torn.values()).isdisjoint(group.paths.values())

    def _is_dead(self, path: bytes, owner: bytes, entry: DirEntry) -> bool:
        if path in self._context.own.live:
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
        if exists or node is None or not node.lock.locked() or node in self._delivered:
            await self._repair(group, target_exists=exists)
        # else it is being written here: a later listing shows what came of it

    async def _repair(self, group: Group, *, target_exists: bool) -> None:
        context, torn = self._context, self._is_torn(group)
        for action in repair(group, target_exists=target_exists):
            self._staleness.forget(action.path)
            if action.to is None:
                await self._names.remove(action.path)
                context.own.garbage.pop(action.path, None)
                continue
            log.warning("%r was left by an interruption: renaming it to %r", action.path, action.to)
            await self._names.rename(action.path, action.to, completes=torn)
            if action.to == group.target and action.path != group.paths.get(Kind.OLD):
                context.files.on_written(action.to)
            context.own.found(group.paths.values())
        self.mended += 1

    async def _exists(self, path: bytes) -> bool:
        try:
            await self._context.directories.find(path)
        except (NotFound, NotADirectory):
            return False
        return True

    async def _read_sidecar(self, directory: bytes, path: bytes, group: Group) -> Group:
        """Return the group with what its sidecar tells, as far as that is plausible."""
        context = self._context
        patience = context.options.op_deadline
        try:
            text = await read_small(context.store, path, RENAME_ROOM, patience=patience)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:
                return group
            raise  # it may say something another time; without it the only copy could count as litter
        if not _plausible(text) or not text.startswith(join(directory, b"")):
            return group
        return Group(group.paths, group.serial, text)


def _plausible(path: bytes) -> bool:
    """Return whether a sidecar, which anybody may have written, may name this path."""
    try:
        return normalise(path) == path and parse(split(path)[1]) is None
    except LocalProtocolError:
        return False
