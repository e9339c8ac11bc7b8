"""`mavftpfs ls`: entries of directories as lines. Layer: cli."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from mavftpfs.client.fetch import known_time
from mavftpfs.client.names import Entry, Listing
from mavftpfs.shared.readable import printable, readable_size

_LOGS = (".ulg", ".bin", ".tlog", ".log")


class NameLine(NamedTuple):
    """A line with a name in it, and the name's style on a terminal."""

    before: str = ""
    name: str = ""
    after: str = ""
    style: str = ""


def show(listings: Sequence[Listing], *, detailed: bool, units: bool) -> None:
    """Print entries. On a terminal directories and logs are highlighted, and control characters in names
    become `?`. Elsewhere names are printed byte for byte.

    detailed: with size and time; units: sizes as 1.2 MB.
    """
    found = lines(listings, detailed=detailed, units=units)
    if not sys.stdout.isatty():
        for line in found:
            text = f"{line.before}{line.name}{line.after}\n"
            sys.stdout.buffer.write(text.encode("utf-8", "surrogateescape"))
        sys.stdout.flush()
        return
    from mavftpfs.cli.drawing import print_styled

    print_styled((line.before, printable(line.name), line.style, line.after) for line in found)


def lines(listings: Sequence[Listing], *, detailed: bool, units: bool) -> Iterator[NameLine]:
    """Yield the lines of several paths as ls prints them: paths of files, then directories with headings."""
    files = [entry for directory, entries in listings if directory is None for entry in entries]
    yield from (_line(entry, entry["path"], detailed, units) for entry in files)
    apart = bool(files)
    for directory, entries in listings:
        if directory is None:
            continue
        if len(listings) > 1:
            if apart:
                yield NameLine()
            yield NameLine(name=directory, after=":")
        yield from (_line(entry, entry["name"], detailed, units) for entry in entries)
        apart = True


def _line(entry: Entry, called: str, detailed: bool, units: bool) -> NameLine:
    size = readable_size(entry["size"]) if units else str(entry["size"])
    before = f"{size:>12} {_when(entry['mtime'])} " if detailed else ""
    if entry["kind"] == "directory":
        return NameLine(before, called, "/", "bold blue")
    return NameLine(before, called, "", "green" if called.lower().endswith(_LOGS) else "")


def _when(mtime: int) -> str:
    """Return a time in UTC, or a dash for an unknown one."""
    if known_time(mtime) is None:
        return f"{'-':<16}"
    return datetime.fromtimestamp(mtime, UTC).strftime("%Y-%m-%d %H:%M")
