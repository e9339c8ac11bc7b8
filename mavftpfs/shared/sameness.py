"""Revalidation: is it still the same file? Layer: shared; pure.

A version of a file is its size, and its modification time where listings report one. The vehicle shows a file
in three ways: the reply to an open has a size; a listing has a size and perhaps a time; and there is the
CRC32. `compare` compares an observation with the known version. The decision is made here, for readers as
well as for pending changes and their uploads. The callers decide about the consequences.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavftpfs.shared.model import DirEntry, EntryKind


class Sameness(Enum):
    """An answer of `compare`."""

    SAME = "same"
    """All reported facts agree."""
    GREW = "grew"
    """The file is the same, and bytes were appended to it, as to a log."""
    UNDECIDED = "undecided"
    """Nothing contradicts, but nothing proves it. The caller asks for more, or trusts the version known so
    far."""
    OTHER = "other"
    """Another file has the name, or no file has it."""


@dataclass(frozen=True, slots=True)
class Known:
    """The known version of a file: a validator.

    size: in bytes. mtime: in seconds UTC, None if the vehicle reported none for that size. crc32: None if
    unknown. restarted: the vehicle restarted since the last proof. After a restart no program continues
    writing an old file. at_open: a program is opening the file. Then equal sizes prove nothing if the vehicle
    reports no times.
    """

    size: int
    mtime: int | None = None
    crc32: int | None = None
    restarted: bool = False
    at_open: bool = False


@dataclass(frozen=True, slots=True)
class Opened:
    """The size in a reply to an open."""

    size: int


@dataclass(frozen=True, slots=True)
class Listed:
    """The file in a listing, None if the name is absent. complete: the listing has all names."""

    entry: DirEntry | None
    complete: bool = True


@dataclass(frozen=True, slots=True)
class Summed:
    """The CRC32 that the vehicle reported."""

    crc32: int


Seen = Opened | Listed | Summed


def compare(known: Known, seen: Seen) -> Sameness:
    """Return whether an observed file matches the known version."""
    match seen:
        case Opened():
            return _by_open(known, seen)
        case Listed():
            return _by_listing(known, seen)
        case Summed():
            return _by_crc32(known, seen)


def _by_open(known: Known, seen: Opened) -> Sameness:
    if seen.size < known.size:
        return Sameness.OTHER
    if known.restarted or known.mtime is not None:
        return Sameness.UNDECIDED  # a listing says more
    return Sameness.SAME if seen.size == known.size else Sameness.GREW


def _by_listing(known: Known, seen: Listed) -> Sameness:
    entry = seen.entry
    if entry is None:
        return Sameness.OTHER if seen.complete else Sameness.UNDECIDED
    if entry.kind is not EntryKind.FILE or entry.size < known.size:
        return Sameness.OTHER
    if entry.size > known.size:
        return Sameness.OTHER if known.restarted else Sameness.GREW
    timed = known.mtime is not None and entry.mtime is not None
    if timed and known.mtime != entry.mtime:
        return Sameness.OTHER
    if known.at_open and not timed:
        return Sameness.UNDECIDED
    return Sameness.SAME


def _by_crc32(known: Known, seen: Summed) -> Sameness:
    if known.crc32 is None:
        return Sameness.UNDECIDED
    if known.crc32 != seen.crc32:
        return Sameness.OTHER
    # A CRC32 starts with 0, so zeros before the first other byte do not change it (docs/servers.md 10).
    return Sameness.SAME if seen.crc32 else Sameness.UNDECIDED
