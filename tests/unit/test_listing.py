"""Listing pages of every server, and of none."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.operations import parse_page
from mavftpfs.shared.model import DirEntry, EntryKind

F, D = EntryKind.FILE, EntryKind.DIRECTORY


@pytest.mark.parametrize(
    ("data", "entries"),
    [
        (b"", []),
        (b"Fa.txt\t12\0", [DirEntry(b"a.txt", F, 12)]),
        (b"Fa.txt\t12", [DirEntry(b"a.txt", F, 12)]),
        (b"Fa\0", [DirEntry(b"a", F, 0)]),
        (b"Dsub\0", [DirEntry(b"sub", D)]),
        (b"Dsub\t4096\0", [DirEntry(b"sub", D)]),
        (b"Fa\t1\0\0Db\0\0", [DirEntry(b"a", F, 1), DirEntry(b"b", D)]),
        (b"F\xff\xfe \xc3\xa4\t0\0", [DirEntry(b"\xff\xfe \xc3\xa4", F, 0)]),
        (b"Fbig\t12345678901\0", [DirEntry(b"big", F, 12345678901)]),
        (b"Fa\t5\t1700000000\0", [DirEntry(b"a", F, 5)]),
    ],
)
def test_forms(data: bytes, entries: list[DirEntry]) -> None:
    page = parse_page(data)
    assert page.entries == entries
    assert page.unshown == 0


@pytest.mark.parametrize(
    ("data", "entries"),
    [
        (b"Fa\t5\t1700000000\0", [DirEntry(b"a", F, 5, 1700000000)]),
        (b"Fa\t5\t0\0", [DirEntry(b"a", F, 5, None)]),
        (b"Fa\t5\0", [DirEntry(b"a", F, 5, None)]),
        (b"Dd\t0\t1700000001\0", [DirEntry(b"d", D, 0, 1700000001)]),
        (b"Dd\0", [DirEntry(b"d", D)]),
        (b"Fa\t5\t17\t9\0", [DirEntry(b"a", F, 5, 17)]),
    ],
)
def test_forms_with_time(data: bytes, entries: list[DirEntry]) -> None:
    assert parse_page(data, with_time=True).entries == entries


@pytest.mark.holds("fault odd listing")
def test_strings_count_but_empty_ones_do_not() -> None:
    page = parse_page(b"S\0S\0\0Fa\t1\0\0X?\0Dd\0")
    assert page.strings == 5
    assert page.unshown == 1


@pytest.mark.parametrize("name", [b".", b".."])
def test_dots_are_dropped_in_silence(name: bytes) -> None:
    page = parse_page(b"D" + name + b"\0F" + name + b"\t1\0S" + name + b"\0")
    assert (page.entries, page.strings, page.unshown) == ([], 3, 0)


@pytest.mark.parametrize(
    "text",
    [
        b"Fa/b\t1",
        b"F\t1",
        b"D",
        b"Fa\tb\t1",
        b"Da\tb",
        b"Fa\t-1",
        b"Fa\tx",
        b"Fa\t" + b"9" * 21,
        b"Fa\t",
        b"?",
    ],
)
def test_unusable_names_are_hidden_and_counted(text: bytes) -> None:
    page = parse_page(text + b"\0Fok\t1\0")
    assert page.entries == [DirEntry(b"ok", F, 1)]
    assert (page.strings, page.unshown) == (2, 1)
