"""Names that a replacement leaves on the card while it is under way, and how to clean up. Layer: cache; pure.

A reserved name is `.mavftpfs-OOOOkSSS` or `.mavftpfs-OOOOkSSS-NAME`: OOOO is the token of the mount that made
it, SSS counts, and the kind k is
  t  new content for NAME, perhaps incomplete;
  o  the old NAME, moved aside only after the new content was verified;
  m  NAME itself, on its way to another spelling; never removed;
  d  a file that was unlinked while somebody read it;
  p  a *sidecar*: a small file whose content is the path that t, o or m of the same number belong to, and,
     behind a NUL, the one that m had before. It is
     written first and removed last, and only where NAME does not fit: rename carries both paths in one
     request of 238 bytes, so long paths use the short form, in the nearest directory above that fits.
One more, `MVF~OOOO`, shows what the card does to names of at most eight characters; it is removed like d.

What an interruption leaves, and what `repair` does with it (new, old and target have the same number):
  target there                  remove new, then old, then the sidecar
  target missing, old and new   rename new to target (it was verified before old was moved), remove old
  target missing, old only      rename old to target
  target missing, new only      rename new to `recovered-tSSS-NAME`: a power cut inside a server that
                                unlinks before it renames leaves that (NuttX), and nobody can tell whether it
                                is complete
  target missing, moved         rename it to target, then remove old
  target there, moved           rename it to where it came from, if a sidecar tells that and nothing is there
                                by now: the move never happened. Else `recovered-mSSS-NAME`
  sidecar alone, deleted        remove
Nothing is touched while its owner may be alive: see `Staleness`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from random import Random

from mavftpfs.shared.errors import PathTooLong
from mavftpfs.shared.model import (
    MAX_WIRE_PATH,
    ROOT,
    DirEntry,
    EntryKind,
    join,
    split,
    storage_of,
    wire_path,
)

PREFIX = b".mavftpfs-"
SHORT_PREFIX = b"MVF~"
RENAME_ROOM = 238
"""Bytes of both paths of a rename and the NUL between them (servers.md 9)."""

MAX_NAME = 255
STALE_AFTER = 600.0
"""Seconds a stranger's reserved name must have stayed the same before it counts as left behind."""

DELETED_AFTER = 24 * 3600.0
"""The same for an unlinked file that is read: it stays the same as long as its reader lives."""

_ALPHABET = b"abcdefghijklmnopqrstuvwxyz234567"  # one spelling on cards that fold case
_RESERVED = re.compile(rb"\.mavftpfs-([a-z2-7]{4})([tomdp])([a-z2-7]{3})(?:-(.+))?", re.DOTALL)
_SHORT_PROBE = re.compile(rb"MVF~([A-Z2-7]{4})")
_SERIALS = 32**3
_OWNER_LENGTH, _SERIAL_LENGTH = 4, 3


class Kind(Enum):
    """What a reserved name stands for."""

    NEW = b"t"
    OLD = b"o"
    MOVED = b"m"
    DELETED = b"d"
    SIDECAR = b"p"


@dataclass(frozen=True, slots=True)
class Reserved:
    """A reserved name's parts; target: the name it belongs to, None in the short form; serial: empty in the
    name of eight characters."""

    owner: bytes
    kind: Kind
    serial: bytes
    target: bytes | None = None

    @property
    def name(self) -> bytes:
        """The directory entry's name."""
        if not self.serial:
            return SHORT_PREFIX + self.owner.upper()
        short = PREFIX + self.owner + self.kind.value + self.serial
        return short if self.target is None else short + b"-" + self.target


@dataclass(frozen=True, slots=True)
class Places:
    """Where one replacement keeps its files; sidecar: only where the names do not say the target."""

    new: bytes
    old: bytes
    moved: bytes
    sidecar: bytes | None = None


@dataclass(frozen=True, slots=True)
class Action:
    """One step of a repair, on names of the listed directory or whole paths: remove, or rename to `to`."""

    path: bytes
    to: bytes | None = None


def is_reserved(name: bytes) -> bool:
    """Return whether a name is hidden from programs."""
    return name.startswith(PREFIX) or _SHORT_PROBE.fullmatch(name) is not None


def parse(name: bytes) -> Reserved | None:
    """Return the parts of a reserved name, None for any other name."""
    probe = _SHORT_PROBE.fullmatch(name)
    if probe is not None:
        return Reserved(probe[1].lower(), Kind.DELETED, b"")
    match = _RESERVED.fullmatch(name)
    if match is None:
        return None
    owner, kind, serial, target = match.groups()
    return Reserved(owner, Kind(kind), serial, target)


def new_owner(rng: Random) -> bytes:
    """Return a token for a mount."""
    return _spell(rng.randrange(32**_OWNER_LENGTH), _OWNER_LENGTH)


def fits_rename(old: bytes, new: bytes) -> bool:
    """Return whether one request carries both paths."""
    return len(wire_path(old)) + 1 + len(wire_path(new)) <= RENAME_ROOM


class Namer:
    """Makes reserved names of one mount that never repeat in its life."""

    def __init__(self, owner: bytes, root: bytes, rng: Random) -> None:
        """`root`: nothing is put above this directory."""
        self.owner = owner
        self._root = root
        self._serial = rng.randrange(_SERIALS)

    def places(self, target: bytes, source: bytes | None = None) -> Places:
        """Return where to keep what replaces `target`, or what is moved there from `source`.

        Raises:
            PathTooLong: no directory above is short enough, or the target itself does not fit a request.
        """
        wire_path(target)
        serial = self._next_serial()
        parent, name = split(target)
        ends = (target,) if source is None else (target, source)
        named = self._places(parent, serial, name)
        if len(split(named.new)[1]) <= MAX_NAME and _all_fit(named, ends):
            return named
        while True:
            short = self._places(parent, serial, None)
            if _all_fit(short, ends):
                return short
            parent = self._above(parent, target)

    def probes(self, path: bytes) -> tuple[bytes, bytes]:
        """Return two names for finding out what the server does to files like the one at `path`.

        Raises:
            PathTooLong.
        """
        parent = split(path)[0]
        while True:
            first, second = self._unlinked(parent), self._unlinked(parent)
            if len(first) <= MAX_WIRE_PATH:
                return first, second
            parent = self._above(parent, path)

    def short_probe(self, path: bytes) -> bytes:
        """Return a name that FAT keeps without a long one, to find out what becomes of those like `path`'s.

        Of capitals, which are short whatever a card does to small letters. It is always the same.

        Raises:
            PathTooLong.
        """
        parent, name = split(path)[0], Reserved(self.owner, Kind.DELETED, b"").name
        while len(own := join(parent, name)) >= MAX_WIRE_PATH:  # one byte is left for a dot behind it
            parent = self._above(parent, path)
        return own

    def hidden(self, path: bytes) -> bytes:
        """Return a name for a file that is unlinked while it is read.

        Raises:
            PathTooLong.
        """
        places = self.places(path)
        directory, name = split(places.moved)
        reserved = parse(name)
        assert reserved is not None
        return join(directory, Reserved(reserved.owner, Kind.DELETED, reserved.serial).name)

    def _next_serial(self) -> bytes:
        self._serial = (self._serial + 1) % _SERIALS
        return _spell(self._serial, _SERIAL_LENGTH)

    def _unlinked(self, directory: bytes) -> bytes:
        """Return a name of the kind that is removed wherever it is found left behind."""
        return join(directory, Reserved(self.owner, Kind.DELETED, self._next_serial()).name)

    def _above(self, directory: bytes, target: bytes) -> bytes:
        """Return the next directory above, on the same storage and within the mount's root."""
        if directory in (ROOT, self._root, storage_of(directory)):
            raise PathTooLong(f"{target!r} is too long for temporary names beside it")
        return split(directory)[0]

    def _places(self, directory: bytes, serial: bytes, name: bytes | None) -> Places:
        def place(kind: Kind) -> bytes:
            target = None if kind is Kind.SIDECAR else name
            return join(directory, Reserved(self.owner, kind, serial, target).name)

        sidecar = place(Kind.SIDECAR) if name is None else None
        return Places(place(Kind.NEW), place(Kind.OLD), place(Kind.MOVED), sidecar)


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


@dataclass(frozen=True, slots=True)
class Group:
    """What one replacement left in a directory: the paths by kind, and the target's path if known.

    source: the path that `moved` had, if it is known and free.
    """

    paths: Mapping[Kind, bytes]
    serial: bytes
    target: bytes | None
    source: bytes | None = None


def leftovers(
    directory: bytes, entries: Iterable[DirEntry], is_dead: Callable[[bytes, bytes, DirEntry], bool]
) -> list[Group]:
    """Return what interrupted work left in a listing.

    is_dead(path, owner, entry): whether nobody works with that name any more. A group is left alone unless
    all of it is dead. Directories are ours only as `m`.
    """
    found: dict[tuple[bytes, bytes], dict[Kind, tuple[bytes, DirEntry, bytes | None]]] = {}
    for entry in entries:
        name = parse(entry.name)
        if name is None or (entry.kind is EntryKind.DIRECTORY and name.kind is not Kind.MOVED):
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
    sidecar, deleted = paths.pop(Kind.SIDECAR, None), paths.pop(Kind.DELETED, None)
    actions = [] if deleted is None else [Action(deleted)]
    new, old, moved = (paths.get(kind) for kind in (Kind.NEW, Kind.OLD, Kind.MOVED))
    if moved is not None:
        missing = group.target is not None and not target_exists
        home = group.target if missing else group.source
        actions.append(Action(moved, home or _recovered(group, moved)))
        target_exists = target_exists or missing  # from now on, so `old` must not take its place
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


def _all_fit(places: Places, ends: Collection[bytes]) -> bool:
    """Return whether every rename between the places and the ends fits a request."""
    inner = (places.new, places.old, places.moved)
    if max(len(path) for path in inner) > MAX_WIRE_PATH:
        return False
    return all(fits_rename(path, end) for path in inner for end in ends)


def _spell(number: int, length: int) -> bytes:
    letters = bytearray()
    for _ in range(length):
        number, digit = divmod(number, len(_ALPHABET))
        letters.append(_ALPHABET[digit])
    return bytes(letters)
