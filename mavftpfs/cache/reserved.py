"""Our own names on the card. Layer: cache; pure.

A reserved name is `.mavftpfs-OOOOkSSS` or `.mavftpfs-OOOOkSSS-NAME`: OOOO is the token of the mount that made
it, SSS counts, and the kind k is
  n  the content of a file that is new, perhaps incomplete;
  t  the new content of NAME, which exists, perhaps incomplete;
  o  the old NAME, moved aside only after the new content was verified;
  d  a file that was unlinked while somebody has it open.
They lie beside the file they belong to. n and d have the short form; t and o have it where NAME does not fit:
a rename carries both paths in one request of 238 bytes.

`repair` says what becomes of those that an interruption left.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from random import Random

from mavftpfs.shared.errors import NotSupported, PathTooLong
from mavftpfs.shared.model import (
    MAX_WIRE_PATH,
    RENAME_ROOM,
    join,
    rename_keys,
    renamed,
    split,
    wire_path,
)

PREFIX = b".mavftpfs-"
MAX_NAME = 255
"""Bytes of a name that every card takes."""

_ALPHABET = b"abcdefghijklmnopqrstuvwxyz234567"  # one spelling on cards that fold case
_RESERVED = re.compile(rb"\.mavftpfs-([a-z2-7]{4})([ntod])([a-z2-7]{3})(?:-(.+))?", re.DOTALL)
_SERIALS = 32**3
_OWNER_LENGTH = 4


class Kind(Enum):
    """What a reserved name stands for."""

    FRESH = b"n"
    NEW = b"t"
    OLD = b"o"
    DELETED = b"d"


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
    """The reserved paths of one delivery.

    new: what is sent. old: the file that is replaced, moved aside; None for a new file.
    """

    new: bytes
    old: bytes | None = None

    @property
    def all(self) -> set[bytes]:
        """Every path of it."""
        return {self.new, self.old or self.new}


def is_reserved(name: bytes) -> bool:
    """Return whether a name is hidden from programs."""
    return _RESERVED.fullmatch(name) is not None


def require_not_ours(path: bytes) -> None:
    """Raise NotSupported for a path whose name is reserved."""
    if is_reserved(split(path)[1]):
        raise NotSupported(f"names that begin like {path!r} are for replacing files")


def require_writable(path: bytes) -> None:
    """Raise NotSupported for a reserved name, PathTooLong where none fits beside the path."""
    require_not_ours(path)
    shortest = Reserved(b"oooo", Kind.NEW, b"sss").name
    if not fits_rename(join(split(path)[0], shortest), path):
        raise PathTooLong(f"{path!r} is too long for a temporary name beside it")


def parse(name: bytes) -> Reserved | None:
    """Return the parts of a reserved name, None for any other name."""
    match = _RESERVED.fullmatch(name)
    if match is None:
        return None
    owner, kind, serial, target = match.groups()
    return Reserved(owner, Kind(kind), serial, target)


def new_owner(rng: Random) -> bytes:
    """Return a token for a mount."""
    return bytes(rng.choices(_ALPHABET, k=_OWNER_LENGTH))


def fits_rename(old: bytes, new: bytes) -> bool:
    """Return whether one request carries both paths."""
    return len(wire_path(old)) + 1 + len(wire_path(new)) <= RENAME_ROOM


class OwnNames:
    """The reserved names of this mount. None repeats before it made 32,768 of them.

    Attributes:
        owner: the mount's token.
        live: names in use, so no listing's repair touches them.
        torn: paths that may lack their file on the vehicle though nobody removed them -> where it lies. What
            became of a draft is another question: its state says that.
    """

    def __init__(self, owner: bytes, rng: Random) -> None:
        self.owner = owner
        self.live: set[bytes] = set()
        self.torn: dict[bytes, bytes] = {}
        self._serial = rng.randrange(_SERIALS)

    def beside(self, target: bytes, kind: Kind) -> bytes:
        """Return a path in the target's directory that does not tell its name. Raises PathTooLong."""
        path = join(split(target)[0], Reserved(self.owner, kind, self._next_serial()).name)
        if not fits_rename(path, target):
            raise PathTooLong(f"{target!r} is too long for a temporary name beside it")
        return path

    def places(self, target: bytes) -> Places:
        """Return where to keep what replaces `target`. Raises PathTooLong."""
        serial, (parent, name) = self._next_serial(), split(target)
        for told in (name, None):
            ours = Reserved(self.owner, Kind.NEW, serial, told).name
            new, old = join(parent, ours), join(parent, Reserved(self.owner, Kind.OLD, serial, told).name)
            if len(ours) <= MAX_NAME and len(new) <= MAX_WIRE_PATH and fits_rename(new, target):
                return Places(new, old)
        raise PathTooLong(f"{target!r} is too long for temporary names beside it")

    def mended(self, places: Iterable[bytes]) -> None:
        """What lay there has its name again."""
        where = set(places)
        self.torn = {path: place for path, place in self.torn.items() if place not in where}

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """A directory has another name."""
        rename_keys(self.torn, old, new)
        for path, place in self.torn.items():
            self.torn[path] = renamed(place, old, new)
        for path in list(self.live):
            self.live.remove(path)
            self.live.add(renamed(path, old, new))

    def _next_serial(self) -> bytes:
        number = self._serial = (self._serial + 1) % _SERIALS
        return bytes((_ALPHABET[number >> 10], _ALPHABET[number >> 5 & 31], _ALPHABET[number & 31]))
