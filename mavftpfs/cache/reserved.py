"""Our own names on the card. Layer: cache; pure.

A reserved name is `.mavftpfs-OOOOkSSS` or `.mavftpfs-OOOOkSSS-NAME`: OOOO is the token of the mount that made
it, SSS counts, and the kind k is
  n  the content of a file that is new, perhaps incomplete;
  t  the new content of NAME, which exists, perhaps incomplete;
  o  the old NAME, moved aside only after the new content was verified;
  d  a file that was unlinked while somebody has it open;
  p  a *sidecar*: a small file whose content is the path that t and o of the same number belong to. It is
     written first and removed last, and only where NAME does not fit: rename carries both paths in one
     request of 238 bytes, so long paths use the short form, in the nearest directory above that fits;

`repair` says what becomes of those that an interruption left.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from random import Random

from mavftpfs.shared.errors import PathTooLong
from mavftpfs.shared.model import MAX_WIRE_PATH, ROOT, join, split, storage_of, wire_path

PREFIX = b".mavftpfs-"
RENAME_ROOM = 238
"""Bytes of both paths of a rename and the NUL between them (servers.md 9)."""

MAX_NAME = 255
"""Bytes of a name that every card takes."""

_ALPHABET = b"abcdefghijklmnopqrstuvwxyz234567"  # one spelling on cards that fold case
_RESERVED = re.compile(rb"\.mavftpfs-([a-z2-7]{4})([ntodp])([a-z2-7]{3})(?:-(.+))?", re.DOTALL)
_SERIALS = 32**3
_OWNER_LENGTH, _SERIAL_LENGTH = 4, 3


class Kind(Enum):
    """What a reserved name stands for."""

    FRESH = b"n"
    NEW = b"t"
    OLD = b"o"
    DELETED = b"d"
    SIDECAR = b"p"


@dataclass(frozen=True, slots=True)
class Reserved:
    """A reserved name's parts; target: the name it belongs to, None where the name does not tell it."""

    owner: bytes
    kind: Kind
    serial: bytes
    target: bytes | None = None

    @property
    def name(self) -> bytes:
        """The directory entry's name."""
        short = PREFIX + self.owner + self.kind.value + self.serial
        return short if self.target is None else short + b"-" + self.target


@dataclass(frozen=True, slots=True)
class Places:
    """Where one replacement keeps its files; sidecar: only where the names do not tell the target."""

    new: bytes
    old: bytes
    sidecar: bytes | None = None

    @property
    def all(self) -> set[bytes]:
        """Every path of it."""
        return {self.new, self.old} if self.sidecar is None else {self.new, self.old, self.sidecar}


def is_reserved(name: bytes) -> bool:
    """Return whether a name is hidden from programs."""
    return _RESERVED.fullmatch(name) is not None


def parse(name: bytes) -> Reserved | None:
    """Return the parts of a reserved name, None for any other name."""
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
    """Makes reserved names of one mount that do not repeat before it made 32,768 of them."""

    def __init__(self, owner: bytes, root: bytes, rng: Random) -> None:
        """`root`: nothing is put above this directory."""
        self.owner = owner
        self._root = root
        self._serial = rng.randrange(_SERIALS)

    def fresh(self, target: bytes) -> bytes:
        """Return a name for the content of a new file.

        Raises:
            PathTooLong: no directory at or above the target's is short enough, or the target does not fit.
        """
        return self._short(target, Kind.FRESH)

    def hidden(self, path: bytes) -> bytes:
        """Return a name for a file that is unlinked while it is open. Raises PathTooLong."""
        return self._short(path, Kind.DELETED)

    def pair(self, path: bytes) -> tuple[bytes, bytes]:
        """Return two names in one directory, for renaming one to the other. Raises PathTooLong."""
        first, second = (Reserved(self.owner, Kind.FRESH, self._next_serial()).name for _ in range(2))
        directory = self._nearest(path, lambda above: _path_fits(join(above, first), join(above, second)))
        return join(directory, first), join(directory, second)

    def places(self, target: bytes) -> Places:
        """Return where to keep what replaces `target`. Raises PathTooLong."""
        wire_path(target)
        serial = self._next_serial()
        parent, name = split(target)
        named = self._places(parent, serial, name)
        if len(split(named.new)[1]) <= MAX_NAME and _fit(named, target):
            return named
        short: list[Places] = []

        def fits(directory: bytes) -> bool:
            short[:] = [self._places(directory, serial, None)]
            return _fit(short[0], target)

        self._nearest(target, fits)
        return short[0]

    # --- inside

    def _short(self, target: bytes, kind: Kind) -> bytes:
        wire_path(target)
        name = Reserved(self.owner, kind, self._next_serial()).name
        directory = self._nearest(target, lambda above: _path_fits(join(above, name), target))
        return join(directory, name)

    def _next_serial(self) -> bytes:
        self._serial = (self._serial + 1) % _SERIALS
        return _spell(self._serial, _SERIAL_LENGTH)

    def _nearest(self, target: bytes, fits: Callable[[bytes], bool]) -> bytes:
        """Return the first directory that fits, from the target's upwards, on the same storage."""
        directory = split(target)[0]
        while not fits(directory):
            if directory in (ROOT, self._root, storage_of(directory)):
                raise PathTooLong(f"{target!r} is too long for temporary names beside it")
            directory = split(directory)[0]
        return directory

    def _places(self, directory: bytes, serial: bytes, name: bytes | None) -> Places:
        def place(kind: Kind) -> bytes:
            target = None if kind is Kind.SIDECAR else name
            return join(directory, Reserved(self.owner, kind, serial, target).name)

        return Places(place(Kind.NEW), place(Kind.OLD), place(Kind.SIDECAR) if name is None else None)


def _fit(places: Places, target: bytes) -> bool:
    return _path_fits(places.new, target) and _path_fits(places.old, target)


def _path_fits(path: bytes, target: bytes) -> bool:
    """Return whether a path fits a request, and a rename between it and the target does."""
    return len(path) <= MAX_WIRE_PATH and fits_rename(path, target)


def _spell(number: int, length: int) -> bytes:
    letters = bytearray()
    for _ in range(length):
        number, digit = divmod(number, len(_ALPHABET))
        letters.append(_ALPHABET[digit])
    return bytes(letters)


class OwnNames:
    """The reserved names that this mount uses, and those it left behind.

    Attributes:
        live: in use, so no listing's repair touches them.
        torn: paths that may lack their file on the vehicle though nobody removed them -> where it lies.
        garbage: reserved paths that could not be removed yet -> the path they belong to.
    """

    def __init__(self) -> None:
        self.live: set[bytes] = set()
        self.torn: dict[bytes, bytes] = {}
        self.garbage: dict[bytes, bytes] = {}

    def leave(self, paths: Iterable[bytes], target: bytes) -> None:
        """These could not be removed: who removes the target has to remove them first."""
        self.garbage.update(dict.fromkeys(paths, target))

    def belonging_to(self, target: bytes) -> list[bytes]:
        """Return what could bring back a name that is removed."""
        return [path for path, owner in self.garbage.items() if owner == target]

    def found(self, places: Iterable[bytes]) -> None:
        """What lay there has its name again."""
        where = set(places)
        self.torn = {path: place for path, place in self.torn.items() if place not in where}

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """A directory has another name."""

        def moved(path: bytes) -> bytes:
            return new + path[len(old) :] if path.startswith(old + b"/") else path

        self.live = {moved(path) for path in self.live}
        self.torn = {moved(path): moved(place) for path, place in self.torn.items()}
        self.garbage = {moved(path): moved(target) for path, target in self.garbage.items()}
