"""What becomes of reserved names that an interruption left on the card. Layer: cache; pure.

new, old and target have the same number (see `reserved`):
  fresh (a new file's content)  remove
  target there                  remove new, then old, then the sidecar
  target missing, old and new   rename new to target (it was verified before old was moved), remove old
  target missing, old only      rename old to target
  target missing, new only      rename new to `recovered-tSSS-NAME`: older versions left that, where a server
                                unlinks before it renames (NuttX); nobody can tell whether it is complete
  sidecar alone, deleted        remove
Nothing is touched while its owner may be alive: see `Staleness`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from mavftpfs.cache.reserved import MAX_NAME, RENAME_ROOM, Kind, parse
from mavftpfs.shared.model import MAX_WIRE_PATH, DirEntry, EntryKind, join, split

STALE_AFTER = 600.0
"""Seconds a stranger's reserved name must have stayed the same before it counts as left behind."""

DELETED_AFTER = 24 * 3600.0
"""The same for an unlinked file that is open: it stays the same as long as its reader lives."""


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


class Staleness:
    """Tells since when a name was seen unchanged; bounded. Times are `now` of any monotonic clock."""

    MAX = 1024

    def __init__(self) -> None:
        self._seen: dict[bytes, tuple[int | None, float]] = {}

    def is_stale(self, path: bytes, size: int | None, now: float) -> bool:
        """Note a sighting; return whether it was the same for as long as its kind demands."""
        known = self._seen.get(path)
        if known is None or known[0] != size:
            self._seen.pop(path, None)
            self._seen[path] = (size, now)
            if len(self._seen) > self.MAX:
                del self._seen[next(iter(self._seen))]
            return False
        name = parse(split(path)[1])
        deleted = name is not None and name.kind is Kind.DELETED
        return now - known[1] >= (DELETED_AFTER if deleted else STALE_AFTER)

    def forget(self, path: bytes) -> None:
        """The name is gone."""
        self._seen.pop(path, None)


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

    `target_exists` is asked for groups with a target. Without one (the sidecar is missing or unreadable) what
    is the only copy of something is renamed to where a person finds it.
    """
    paths = dict(group.paths)
    sidecar = paths.pop(Kind.SIDECAR, None)
    litter = (paths.pop(kind, None) for kind in (Kind.DELETED, Kind.FRESH))
    actions = [Action(path) for path in litter if path is not None]
    new, old = paths.get(Kind.NEW), paths.get(Kind.OLD)
    if group.target is None:
        actions += _without_target(group, new, old)
    elif target_exists:
        actions += [Action(path) for path in (new, old) if path is not None]
    elif old is not None:
        actions.append(Action(old if new is None else new, group.target))
        actions += [] if new is None else [Action(old)]
    elif new is not None:
        actions.append(Action(new, _recovered(group, new)))
    return actions if sidecar is None else [*actions, Action(sidecar)]


def _without_target(group: Group, new: bytes | None, old: bytes | None) -> list[Action]:
    """The short form is used only after its sidecar was written: a `t` alone is litter, an `o` never."""
    if old is not None:
        rest = [] if new is None else [Action(new, _recovered(group, new))]
        return [Action(old, _recovered(group, old)), *rest]
    return [] if new is None else [Action(new)]


def _recovered(group: Group, path: bytes) -> bytes:
    name = parse(split(path)[1])
    assert name is not None
    target = b"" if group.target is None else b"-" + split(group.target)[1]
    tail = name.kind.value + group.serial + target
    directory = split(path)[0]
    room = min(MAX_NAME, MAX_WIRE_PATH - len(directory) - 1, RENAME_ROOM - len(path) - len(directory) - 2)
    return join(directory, (b"recovered-" + tail)[: max(room, 14)])
