"""Is it still the same file? Layer: shared; pure.

A version of a file is its size, and its modification time where listings tell one. The vehicle shows a file
in three ways: the reply to an open has a size; a listing has a size and perhaps a time; and there is the
CRC32. `compare` compares what was seen with what is known. Whether that is the same file is decided here for
readers, and for drafts and their deliveries. What follows is the callers' business.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavftpfs.shared.model import DirEntry, EntryKind


class Sameness(Enum):
    """An answer of `compare`."""

    SAME = "same"
    """All that was told agrees."""
    GREW = "grew"
    """It is the same file, and bytes were appended to it: logs grow."""
    UNDECIDED = "undecided"
    """Nothing contradicts, but nothing proves it. The caller asks for more, or trusts what it knew before."""
    OTHER = "other"
    """Another file has the name, or none has it."""


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a file.

    size: in bytes. mtime: in seconds UTC, None if none was told of that size. crc32: None if it is not known.
    restarted: the vehicle restarted since the last proof. After a restart no program goes on writing an old
    file.
    at_open: a program opens it now. Then equal sizes are no proof where no time is told.
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
    """What a listing shows under the name, None if nothing. complete: the listing came to its end."""

    entry: DirEntry | None
    complete: bool = True


@dataclass(frozen=True, slots=True)
class Summed:
    """The CRC32 that the vehicle told."""

    crc32: int


Seen = Opened | Listed | Summed


def compare(known: Known, seen: Seen) -> Sameness:
    """Return whether what was seen is still the file that is known."""
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
        return Sameness.UNDECIDED  # a listing tells more
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
