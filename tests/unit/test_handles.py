"""mount.handles: inode numbers, lookup counts, renames."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from mavftpfs.mount import handles
from mavftpfs.mount.handles import ROOT_INO, InodeTable


def test_a_path_keeps_its_number_over_forget_and_mounts() -> None:
    table = InodeTable()
    first = table.lookup(b"/log/1.ulg")
    table.forget(first.ino, 1)
    assert table.known(b"/log/1.ulg") is None
    assert len(table) == 1
    again = table.lookup(b"/log/1.ulg")
    assert again.ino == first.ino
    assert InodeTable().lookup(b"/log/1.ulg").ino == first.ino


def test_a_taken_number_is_stepped_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handles, "_INO_MASK", 3)
    table = InodeTable()
    numbers = {table.lookup(path).ino for path in (b"/a", b"/b")}
    assert numbers == {2, 3}


def test_rename_moves_a_subtree_and_keeps_numbers() -> None:
    table = InodeTable()
    paths = [b"/d", b"/d/x", b"/d/e/y", b"/dx"]
    numbers = {path: table.lookup(path).ino for path in paths}
    table.rename(b"/d", b"/n/m")
    assert table.known(b"/n/m") == numbers[b"/d"]
    assert table.known(b"/n/m/x") == numbers[b"/d/x"]
    assert table.known(b"/n/m/e/y") == numbers[b"/d/e/y"]
    assert table.known(b"/dx") == numbers[b"/dx"], "a common prefix is not a parent"
    assert table.known(b"/d/x") is None
    table.check_invariants()


NAMES = st.lists(st.sampled_from([b"a", b"b", b"ab"]), min_size=1, max_size=3)
PATHS = NAMES.map(lambda parts: b"/" + b"/".join(parts))


class Kernel(RuleBasedStateMachine):
    """A kernel that counts the answers it got, and forgets them in any portions."""

    def __init__(self) -> None:
        super().__init__()
        self.table = InodeTable()
        self.counts: dict[int, int] = {}

    @rule(path=PATHS)
    def lookup(self, path: bytes) -> None:
        inode = self.table.lookup(path)
        assert inode.path == path
        self.counts[inode.ino] = self.counts.get(inode.ino, 0) + 1

    @rule(path=PATHS)
    def reject(self, path: bytes) -> None:
        self.table.discard(self.table.reserve(path))

    @precondition(lambda self: self.counts)
    @rule(data=st.data())
    def forget(self, data: st.DataObject) -> None:
        ino = data.draw(st.sampled_from(sorted(self.counts)))
        count = data.draw(st.integers(1, self.counts[ino]))
        self.table.forget(ino, count)
        self.counts[ino] -= count
        if not self.counts[ino]:
            del self.counts[ino]
            assert self.table.get(ino) is None

    @rule(path=PATHS)
    def unlink(self, path: bytes) -> None:
        self.table.unlink(path)
        assert self.table.known(path) is None

    @rule(old=PATHS, new=PATHS)
    def rename(self, old: bytes, new: bytes) -> None:
        if not (old + b"/").startswith(new + b"/") and not (new + b"/").startswith(old + b"/"):
            before = self.table.known(old)
            self.table.rename(old, new)
            assert self.table.known(new) == before

    @invariant()
    def agrees(self) -> None:
        self.table.check_invariants()
        assert len(self.table) == len(self.counts) + 1
        for ino, count in self.counts.items():
            inode = self.table.get(ino)
            assert inode is not None
            assert inode.lookups == count


TestKernel = Kernel.TestCase
TestKernel.settings = settings(max_examples=40, stateful_step_count=40)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 4))))
def test_wild_forgets_never_break_the_table(forgets: list[tuple[int, int]]) -> None:
    table = InodeTable()
    numbers = [table.lookup(b"/%d" % index).ino for index in range(4)] + [ROOT_INO, 12345]
    for index, count in forgets:
        table.forget(numbers[index], count)
        assert all(inode is None or inode.lookups >= 0 for inode in map(table.get, numbers))
