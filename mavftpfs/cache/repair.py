"""What becomes of reserved names that an interruption left on the card. Layer: cache.

`repair` decides from names alone, `Cleaner` does it whenever a listing shows such names.

new, old and target have the same number (see `reserved`):
  fresh (a new file's content)  remove
  deleted                       remove
  target there                  remove new, then old
  target missing, old and new   rename new to target (it was verified before old was moved), remove old
  target missing, old only      rename old to target
  target missing, new only      rename new to `recovered-tSSS-NAME`: somebody else removed the target, and
                                nobody can tell whether new is complete
  target not known, old         rename both to `recovered-...`: it may be the only copy
  target not known, new only    remove: old is moved aside before new is needed
Nothing is touched while its owner may be alive: see STALE_AFTER.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

from mavftpfs.cache.context import Context
from mavftpfs.cache.directories import Directory
from mavftpfs.cache.names import Names
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.reserved import MAX_NAME, Kind, is_reserved, parse
from mavftpfs.shared.errors import MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import MAX_WIRE_PATH, RENAME_ROOM, DirEntry, EntryKind, join, split

log = logging.getLogger("mavftpfs.cache")

MAX_GROUPS = 64
"""Interrupted replacements mended per listing."""

STALE_AFTER = 600.0
"""Seconds a stranger's reserved name must have stayed the same before it counts as left behind."""

MAX_SEEN = 1024
"""Of how many such names it is remembered since when they are the same."""


@dataclass(frozen=True, slots=True)
class Action:
    """One step of a repair: remove a path, or rename it to `to`."""

    path: bytes
    to: bytes | None = None


@dataclass(frozen=True, slots=True)
class Group:
    """What one replacement left in a directory: the paths by kind, and the target's path if known."""

    paths: Mapping[Kind, bytes]
    serial: bytes
    target: bytes | None


def leftovers(
    directory: bytes, entries: Iterable[DirEntry], is_dead: Callable[[bytes, bytes, DirEntry], bool]
) -> list[Group]:
    """Return what interrupted work left in a listing.

    is_dead(path, owner, entry): whether nobody works with that name any more. A group is left alone unless
    all of it is dead. Directories are never ours.
    """
    found: dict[tuple[bytes, bytes], dict[Kind, tuple[bytes, DirEntry, bytes | None]]] = {}
    for entry in entries:
        name = parse(entry.name)
        if name is None or entry.kind is EntryKind.DIRECTORY:
            continue
        group = found.setdefault((name.owner, name.serial), {})
        group[name.kind] = (join(directory, entry.name), entry, name.target)
    groups = []
    for (owner, serial), parts in sorted(found.items()):
        # Every part is asked about, so that each one's age is noted.
        dead = [is_dead(path, owner, entry) for path, entry, _ in parts.values()]
        if not all(dead):
            continue
        targets = {target for _, _, target in parts.values() if target is not None}
        target = join(directory, targets.pop()) if len(targets) == 1 else None
        groups.append(Group({kind: path for kind, (path, _, _) in parts.items()}, serial, target))
    return groups


def repair(group: Group, *, target_exists: bool) -> list[Action]:
    """Return the steps that undo or complete an interrupted replacement; any may be the last one done.

    `target_exists` is asked for groups with a target.
    """
    order = (Kind.DELETED, Kind.FRESH, Kind.NEW, Kind.OLD)
    paths = [group.paths[kind] for kind in order if kind in group.paths]
    new, old = group.paths.get(Kind.NEW), group.paths.get(Kind.OLD)
    if target_exists or (old is None and (new is None or group.target is None)):
        return [Action(path) for path in paths]
    if group.target is None or old is None:
        return [Action(path, _recovered(group, path)) for path in (old, new) if path is not None]
    if new is None:
        return [Action(old, group.target)]
    return [Action(new, group.target), Action(old)]


def _recovered(group: Group, path: bytes) -> bytes:
    name = parse(split(path)[1])
    assert name is not None
    target = b"" if group.target is None else b"-" + split(group.target)[1]
    tail = name.kind.value + group.serial + target
    directory = split(path)[0]
    room = min(MAX_NAME, MAX_WIRE_PATH - len(directory) - 1, RENAME_ROOM - len(path) - len(directory) - 2)
    return join(directory, (b"recovered-" + tail)[: max(room, 14)])


class Cleaner:
    """Looks at every listing."""

    def __init__(self, context: Context, names: Names, dead_owners: frozenset[bytes]) -> None:
        """`dead_owners`: mounts that are known to have ended."""
        self._context = context
        self._names = names
        self._dead_owners = dead_owners | {context.own.owner}
        self._seen: dict[bytes, tuple[int | None, float]] = {}
        self._busy: set[bytes] = set()
        self._being_delivered: set[Node] = set()
        self.mended = 0

    async def on_swept(self, path: bytes, directory: Directory) -> None:
        """A directory was listed. Raises nothing of ours: the listing is right without us."""
        reserved, own = [], self._context.own
        for name, entry in directory.entries.items():
            if is_reserved(name):
                reserved.append(entry)
        if directory is self._context.directories.known(path):
            for torn in list(own.torn):
                parent, name = split(torn)
                if parent == path and name in directory.entries:
                    del own.torn[torn]  # it is whole again
        if path in self._busy or not reserved:
            return
        self._busy.add(path)
        try:
            for group in leftovers(path, reserved, self._is_dead)[:MAX_GROUPS]:
                if not self._context.blocked or self._is_torn(group):
                    await self._mend(group)
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
        self._being_delivered.add(node)
        try:
            await self._list(split(node.path)[0])
        finally:
            self._being_delivered.discard(node)

    # --- inside

    async def _list(self, directory: bytes) -> None:
        try:
            await self._context.directories.ask(directory)
        except MavftpfsError as error:
            log.info("%r is mended at a later listing: %s", directory, error)

    def _is_torn(self, group: Group) -> bool:
        return not set(self._context.own.torn.values()).isdisjoint(group.paths.values())

    def _is_dead(self, path: bytes, owner: bytes, entry: DirEntry) -> bool:
        if path in self._context.own.live:
            return False
        if owner in self._dead_owners:
            return True
        seen, now = self._seen.get(path), self._context.clock()
        if seen is None or seen[0] != entry.size:  # it is new, or it grows
            seen = self._seen[path] = (entry.size, now)
            if len(self._seen) > MAX_SEEN:
                del self._seen[next(iter(self._seen))]
        return now - seen[1] >= STALE_AFTER

    async def _mend(self, group: Group) -> None:
        if group.target is None:
            for path, place in self._context.own.torn.items():
                if place in group.paths.values():
                    group = replace(group, target=path)
        context, torn, exists = self._context, self._is_torn(group), False
        if group.target is not None:
            with suppress(NotFound, NotADirectory):
                await context.directories.find(group.target)
                exists = True
            node = context.nodes.get(group.target)
            if (
                not exists
                and node is not None
                and node.delivery is not None
                and node not in self._being_delivered
            ):
                return  # it is being written here: a later listing shows what came of it
        for action in repair(group, target_exists=exists):
            if action.to is None:
                await self._names.remove(action.path)
                continue
            log.warning("%r was left by an interruption: renaming it to %r", action.path, action.to)
            await self._names.rename(action.path, action.to, completes=torn)
            if action.to == group.target and action.path != group.paths.get(Kind.OLD):
                context.files.on_changed(action.to)
            context.own.mended(group.paths.values())
        self.mended += 1
