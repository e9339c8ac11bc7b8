"""fuse.handles: numbers of open things."""

from __future__ import annotations

from mavftpfs.fuse.handles import HandleTable


def test_a_number_is_never_used_twice() -> None:
    table: HandleTable[str] = HandleTable()
    first = table.add("a")
    assert table.get(first) == "a"
    assert table.remove(first) == "a"
    assert table.get(first) is None
    assert table.add("b") != first


def test_removing_twice_is_harmless() -> None:
    table: HandleTable[str] = HandleTable()
    number = table.add("a")
    table.add("b")
    assert len(table) == 2
    assert list(table) == ["a", "b"]
    table.remove(number)
    assert table.remove(number) is None
    assert list(table) == ["b"]
