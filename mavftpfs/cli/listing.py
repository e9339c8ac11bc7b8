"""`mavftpfs ls`: entries of directories as lines. Layer: cli."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from mavftpfs.client.fetch import known_time
from mavftpfs.client.names import Listing
from mavftpfs.client.status import Facts
from mavftpfs.shared.readable import printable, readable_size


def show(listings: Sequence[Listing], *, detailed: bool, units: bool) -> None:
    """Print the entries of several paths as ls does: paths of files, then directories with headings. On a
    terminal control characters in names become `?`. Elsewhere names are printed byte for byte.

    detailed: with size and time; units: sizes as 1.2 MB.
    """
    for line in _lines(listings, detailed, units):
        text = printable(line) if sys.stdout.isatty() else line
        sys.stdout.buffer.write(f"{text}\n".encode("utf-8", "surrogateescape"))
    sys.stdout.flush()


def _lines(listings: Sequence[Listing], detailed: bool, units: bool) -> Iterator[str]:
    files = [entry for directory, entries in listings if directory is None for entry in entries]
    yield from (_line(entry, entry["path"], detailed, units) for entry in files)
    apart = bool(files)
    for directory, entries in listings:
        if directory is None:
            continue
        if len(listings) > 1:
            if apart:
                yield ""
            yield f"{directory}:"
        yield from (_line(entry, entry["name"], detailed, units) for entry in entries)
        apart = True


def _line(entry: Facts, called: str, detailed: bool, units: bool) -> str:
    size = readable_size(entry["size"]) if units else str(entry["size"])
    before = f"{size:>12} {_when(entry['mtime'])} " if detailed else ""
    return f"{before}{called}{'/' if entry['kind'] == 'directory' else ''}"


def _when(mtime: int) -> str:
    """Return a time in UTC, or a dash for an unknown one."""
    if known_time(mtime) is None:
        return f"{'-':<16}"
    return datetime.fromtimestamp(mtime, UTC).strftime("%Y-%m-%d %H:%M")
