"""One page of a ListDirectory reply. Layer: protocol; pure.

Entries are NUL-terminated: `F<name>\\t<size>`, `D<name>`, `S` (skip), with opcode 16 also a third
field of decimal seconds UTC. Servers vary (servers.md 6): double NULs, files without size, bare
directories, `.` and `..`, sizes of 64 bits. The parser takes any bytes and never raises.
"""

from __future__ import annotations

from typing import NamedTuple

from mavftpfs.shared.model import DirEntry, EntryKind, usable_name

_KINDS = {b"F": EntryKind.FILE, b"D": EntryKind.DIRECTORY}
_MAX_DIGITS = 20


class Page(NamedTuple):
    """What one page holds.

    strings: number of its non-empty strings, by which the next page's offset grows (servers.md 14.28).
    hidden: how many of them name something that cannot be shown.
    """

    entries: list[DirEntry]
    strings: int
    hidden: int


def parse_page(data: bytes, *, with_time: bool = False) -> Page:
    """Return what the `data` of one listing ACK holds; never raises.

    A last string without NUL counts: a server that fills all 239 bytes may have cut the NUL only.
    """
    entries: list[DirEntry] = []
    strings = hidden = 0
    for text in data.split(b"\0"):
        if not text:
            continue
        strings += 1
        kind, (name, *fields) = _KINDS.get(text[:1]), text[1:].split(b"\t")
        # A tab in a name (MAVSDK lists those) shows as a field that is no number: it is hidden.
        understood = kind is not None and usable_name(name)
        for field in fields:
            understood = understood and field.isdigit() and len(field) <= _MAX_DIGITS
        if kind is not None and understood:
            size = int(fields[0]) if fields and kind is EntryKind.FILE else None
            mtime = int(fields[1]) if with_time and len(fields) > 1 else 0
            entries.append(DirEntry(name, kind, size, mtime or None))
        elif text[:1] != b"S" and name not in (b".", b".."):
            hidden += 1  # neither a skip mark, nor the directory itself or its parent
    return Page(entries, strings, hidden)
