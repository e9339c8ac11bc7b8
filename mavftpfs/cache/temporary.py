"""The names of temporary files on the card. Layer: cache; pure.

A temporary name is `.mavftpfs-OOOOOOOkSSS` or `.mavftpfs-OOOOOOOkSSS-NAME`: OOOOOOO is the token of the mount
that made it (35 random bits; mounts before version 0.3 have four characters), SSS counts, and the kind k is
  n  a file that is being sent, perhaps incomplete;
  o  the old file of NAME, moved aside until the new one has its name.
It lies beside the file that it belongs to. Only o tells its NAME, if that fits: a rename carries both paths
in one request of 238 bytes. No temporary name is used twice, so a duplicate of a request that arrives late
harms none.

`repair` removes or renames temporary files that an interruption left.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from math import inf
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
_TEMPORARY = re.compile(rb"\.mavftpfs-([a-z2-7]{7}|[a-z2-7]{4})([no])([a-z2-7]{3})(?:-(.+))?", re.DOTALL)
_SERIALS = 32**3
_OWNER_LENGTH = 7


class Kind(Enum):
    """The meaning of a temporary file's name."""

    NEW = b"n"
    OLD = b"o"


@dataclass(frozen=True, slots=True)
class TemporaryName:
    """A temporary name's parts; target: the name it belongs to, None where the name does not tell it."""

    owner: bytes
    kind: Kind
    serial: bytes
    target: bytes | None = None

    @property
    def name(self) -> bytes:
        """The directory entry's name."""
        short = PREFIX + self.owner + self.kind.value + self.serial
        return short if self.target is None else short + b"-" + self.target


def is_temporary(name: bytes) -> bool:
    """Return whether a name is temporary, so that no program sees it."""
    return _TEMPORARY.fullmatch(name) is not None


def require_not_ours(path: bytes) -> None:
    """Raise NotSupported for a path whose name is temporary."""
    if is_temporary(split(path)[1]):
        raise NotSupported(f"names that begin like {path!r} are for replacing files")


def require_writable(path: bytes) -> None:
    """Raise NotSupported for a temporary name, PathTooLong where none fits beside the path."""
    require_not_ours(path)
    shortest = TemporaryName(b"o" * _OWNER_LENGTH, Kind.NEW, b"sss").name
    if not fits_rename(join(split(path)[0], shortest), path):
        raise PathTooLong(f"{path!r} is too long for a temporary name beside it")


def parse(name: bytes) -> TemporaryName | None:
    """Return the parts of a temporary name, None for any other name."""
    match = _TEMPORARY.fullmatch(name)
    if match is None:
        return None
    owner, kind, serial, target = match.groups()
    return TemporaryName(owner, Kind(kind), serial, target)


def new_owner(rng: Random) -> bytes:
    """Return a token for a mount."""
    return bytes(rng.choices(_ALPHABET, k=_OWNER_LENGTH))


def fits_rename(old: bytes, new: bytes) -> bool:
    """Return whether one request carries both paths."""
    return len(wire_path(old)) + 1 + len(wire_path(new)) <= RENAME_ROOM


class TemporaryNames:
    """The temporary names of this mount. None repeats before it made 32,768 of them.

    Attributes:
        owner: the mount's token.
        needed: names that repair leaves alone, each with the time until which it does; infinite as long as
            somebody needs it, or repairs it just now. targets: of old files, the path of which each one is.
    """

    def __init__(self, owner: bytes, rng: Random) -> None:
        self.owner = owner
        self.needed: dict[bytes, float] = {}
        self.targets: dict[bytes, bytes] = {}
        self._serial = rng.randrange(_SERIALS)

    def need(self, target: bytes, kind: Kind) -> bytes:
        """Return a new path in the target's directory, needed until `release`. Raises PathTooLong."""
        path = self._beside(target, kind)
        self.needed[path] = inf
        if kind is Kind.OLD:
            self.targets[path] = target
        return path

    def release(self, path: bytes) -> None:
        """Leave a name to repair from now on; what has it may be gone already."""
        self.needed.pop(path, None)

    def is_needed(self, path: bytes, now: float) -> bool:
        """Return whether repair is to leave a name alone."""
        return self.needed.get(path, -inf) > now

    def target_of(self, path: bytes, name: TemporaryName) -> bytes | None:
        """Return the path of which an old file is, None if that is not known."""
        if path in self.targets:
            return self.targets[path]
        return None if name.target is None else join(split(path)[0], name.target)

    def on_gone(self, path: bytes) -> None:
        """Note that no file has the name."""
        self.needed.pop(path, None)
        self.targets.pop(path, None)

    def _beside(self, target: bytes, kind: Kind) -> bytes:
        number = self._serial = (self._serial + 1) % _SERIALS
        serial = bytes((_ALPHABET[number >> 10], _ALPHABET[number >> 5 & 31], _ALPHABET[number & 31]))
        parent, name = split(target)
        for told in (name, None) if kind is Kind.OLD else (None,):
            ours = TemporaryName(self.owner, kind, serial, told).name
            path = join(parent, ours)
            if len(ours) <= MAX_NAME and len(path) <= MAX_WIRE_PATH and fits_rename(path, target):
                return path
        raise PathTooLong(f"{target!r} is too long for a temporary name beside it")

    def follow_rename(self, old: bytes, new: bytes) -> set[bytes]:
        """Note that a directory has another name; return the directories at and below it that have old files
        of this mount."""
        self.needed = {renamed(path, old, new): until for path, until in self.needed.items()}
        self.targets = {
            renamed(path, old, new): renamed(target, old, new) for path, target in self.targets.items()
        }
        return {split(path)[0] for path in self.targets if path.startswith(new + b"/")}
