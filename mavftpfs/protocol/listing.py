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
    hidden = 0
    texts = [text for text in data.split(b"\0") if text]
    for text in texts:
        entry = _parse_entry(text, with_time=with_time)
        if entry is not None and usable_name(entry.name):
            entries.append(entry)
        elif not _is_silent(text):
            hidden += 1
    return Page(entries, len(texts), hidden)


def _is_silent(text: bytes) -> bool:
    """Whether an entry is left out without loss: a skip mark, or the directory itself and its parent."""
    return text[:1] == b"S" or text[1:].split(b"\t", 1)[0] in (b".", b"..")


def _parse_entry(text: bytes, *, with_time: bool) -> DirEntry | None:
    kind = _KINDS.get(text[:1])
    if kind is None:
        return None
    # A tab in a name (MAVSDK lists those) shows as a field that is no number: such a name is not believed.
    name, *fields = text[1:].split(b"\t")
    if not all(_is_number(field) for field in fields):
        return None
    is_file = kind is EntryKind.FILE
    size = int(fields[0]) if fields and is_file else None
    mtime = int(fields[1]) if with_time and len(fields) > 1 else 0
    return DirEntry(name, kind, size, mtime or None)


def _is_number(field: bytes) -> bool:
    return field.isdigit() and len(field) <= _MAX_DIGITS
