"""Our own names on the card. Layer: cache; pure.

A reserved name is `.mavftpfs-OOOOkSSS` or `.mavftpfs-OOOOkSSS-NAME`: OOOO is the token of the mount that made
it, SSS counts, and the kind k is
  n  what is sent of a file, perhaps incomplete;
  o  the old file of NAME, moved aside until the new one has its name.
It lies beside the file that it belongs to. Only o tells its NAME, if that fits: a rename carries both paths
in one request of 238 bytes.

`repair` says what becomes of those that an interruption left.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from random import Random

from mavftpfs.shared.errors import NotSupported, PathTooLong
from mavftpfs.shared.model import (
    MAX_WIRE_PATH,
    RENAME_ROOM,
    join,
    renamed,
    split,
    wire_path,
)

PREFIX = b".mavftpfs-"
MAX_NAME = 255
"""Bytes of a name that every card takes."""

_ALPHABET = b"abcdefghijklmnopqrstuvwxyz234567"  # one spelling on cards that fold case
_RESERVED = re.compile(rb"\.mavftpfs-([a-z2-7]{4})([no])([a-z2-7]{3})(?:-(.+))?", re.DOTALL)
_SERIALS = 32**3
_OWNER_LENGTH = 4


class Kind(Enum):
    """What a reserved name stands for."""

    NEW = b"n"
    OLD = b"o"


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


def is_reserved(name: bytes) -> bool:
    """Return whether a name is reserved, so that no program sees it."""
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
        in_use: names in use, which no repair touches.
    """

    def __init__(self, owner: bytes, rng: Random) -> None:
        self.owner = owner
        self.in_use: set[bytes] = set()
        self._serial = rng.randrange(_SERIALS)

    def beside(self, target: bytes, kind: Kind) -> bytes:
        """Return a path in the target's directory. Raises PathTooLong."""
        number = self._serial = (self._serial + 1) % _SERIALS
        serial = bytes((_ALPHABET[number >> 10], _ALPHABET[number >> 5 & 31], _ALPHABET[number & 31]))
        parent, name = split(target)
        for told in (name, None) if kind is Kind.OLD else (None,):
            ours = Reserved(self.owner, kind, serial, told).name
            path = join(parent, ours)
            if len(ours) <= MAX_NAME and len(path) <= MAX_WIRE_PATH and fits_rename(path, target):
                return path
        raise PathTooLong(f"{target!r} is too long for a temporary name beside it")

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """A directory has another name."""
        for path in list(self.in_use):
            self.in_use.remove(path)
            self.in_use.add(renamed(path, old, new))
