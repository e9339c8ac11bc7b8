"""Paths and directory entries, as programs give and get them. Layer: api."""

from __future__ import annotations

import os
from dataclasses import dataclass

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.fetch import known_time
from mavftpfs.shared.model import EntryKind, normalise, split

PathLike = str | bytes | os.PathLike[str]
"""A path on the vehicle. A relative one begins at the root."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A file or directory. size: bytes; mtime: seconds since 1970 UTC, None if the vehicle reports no
    times."""

    name: str
    path: str
    size: int
    mtime: float | None
    kind: EntryKind

    def is_dir(self) -> bool:
        """Return whether the entry is a directory."""
        return self.kind is EntryKind.DIRECTORY

    def is_file(self) -> bool:
        """Return whether the entry is a file."""
        return self.kind is EntryKind.FILE


def remote(path: PathLike) -> bytes:
    """Return a path as the client takes it.

    Raises:
        LocalProtocolError: the path contains `..` or NUL.
    """
    return normalise(b"/" + os.fsencode(path))


def names_directory(path: PathLike) -> bool:
    """Return whether a path ends in a slash."""
    return os.fsencode(path).endswith(b"/")


def entry(path: bytes, stat: Stat) -> Entry:
    """Return what a program gets for a path."""
    mtime = None if known_time(stat.mtime) is None else stat.mtime_ns / 1e9
    name = split(path)[1]
    return Entry(os.fsdecode(name), os.fsdecode(path), stat.size, mtime, stat.kind)
