"""What `ls` lists, and how its lines look. Layer: top; prints nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from mavftpfs.cache.attributes import Stat
from mavftpfs.oneshot.files import Files, Session
from mavftpfs.oneshot.plan import known_time
from mavftpfs.shared.model import EntryKind, join, split
from mavftpfs.shared.readable import name_text, printable, readable_size

Entry = dict[str, Any]

Listing = tuple[str | None, list[Entry]]
"""A directory's name and what it holds; None: the path is a file, the only entry."""

_DIRECTORY_STYLE = "\x1b[1;34m"
_LOG_STYLE = "\x1b[32m"
_PLAIN = "\x1b[0m"
_LOGS = (".ulg", ".bin", ".tlog", ".log")


@dataclass(frozen=True, slots=True)
class Look:
    """How names are printed. detailed: with size and time; units: sizes as 1.2 MB; terminal: without what a
    terminal would obey; colours: directories and logs stand out."""

    detailed: bool = False
    units: bool = False
    terminal: bool = False
    colours: bool = False


async def list_paths(
    session: Session, paths: Sequence[bytes], *, recursive: bool = False, by_time: bool = False
) -> list[Listing]:
    """Return the entries of directories, and files themselves, as JSON-able facts.

    by_time: the newest first, what has no time last; else by name.
    """
    return [
        listing for path in paths for listing in await _list_path(session.files, path, recursive, by_time)
    ]


async def _list_path(files: Files, path: bytes, recursive: bool, by_time: bool) -> list[Listing]:
    found = await files.stat(path)
    if found.kind is EntryKind.FILE:
        return [(None, [_entry(path, split(path)[1], found)])]
    listings: list[Listing] = []
    pending = [path]
    while pending:
        here = pending.pop()
        below = sorted(await files.list(here), key=lambda entry: entry[0])
        if by_time:
            below.sort(key=lambda entry: known_time(entry[1].mtime) or 0, reverse=True)
        listings.append((name_text(here), [_entry(join(here, name), name, stat) for name, stat in below]))
        if recursive:
            inner = [join(here, name) for name, stat in below if stat.kind is EntryKind.DIRECTORY]
            pending += reversed(inner)
    return listings


def _entry(path: bytes, name: bytes, found: Stat) -> Entry:
    return {
        "path": path.decode("utf-8", "surrogateescape"),
        "name": name.decode("utf-8", "surrogateescape"),
        "kind": found.kind.name.lower(),
        "size": found.size,
        "mtime": found.mtime,
    }


def lines(listings: Sequence[Listing], look: Look) -> Iterator[str]:
    """Yield the lines of several paths as ls prints them: files first, then directories with headings."""
    files = [entry for directory, entries in listings if directory is None for entry in entries]
    yield from (_line(entry, look) for entry in files)
    apart = bool(files)
    for directory, entries in listings:
        if directory is None:
            continue
        if len(listings) > 1:
            if apart:
                yield ""
            yield f"{_shown(directory, look)}:"
        yield from (_line(entry, look) for entry in entries)
        apart = True


def _line(entry: Entry, look: Look) -> str:
    name = _shown(entry["name"], look)
    if look.colours:
        name = _coloured(name, entry)
    if entry["kind"] == "directory":
        name += "/"
    if not look.detailed:
        return name
    size = readable_size(entry["size"]) if look.units else str(entry["size"])
    return f"{size:>12} {when(entry['mtime'])} {name}"


def when(mtime: int) -> str:
    """Return a time in UTC, or a dash where nothing tells it."""
    if known_time(mtime) is None:
        return f"{'-':<16}"
    return datetime.fromtimestamp(mtime, UTC).strftime("%Y-%m-%d %H:%M")


def _coloured(name: str, entry: Entry) -> str:
    if entry["kind"] == "directory":
        return f"{_DIRECTORY_STYLE}{name}{_PLAIN}"
    return f"{_LOG_STYLE}{name}{_PLAIN}" if name.lower().endswith(_LOGS) else name


def _shown(name: str, look: Look) -> str:
    return printable(name) if look.terminal else name
