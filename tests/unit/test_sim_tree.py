"""The trees that simulated servers serve: one suite for both, and what only one can do."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mavftpfs.sim.tree import DirectoryTree, Kind, MemoryTree, Tree


@pytest.fixture(params=["memory", "directory"])
def tree(request: pytest.FixtureRequest, tmp_path: Path) -> Tree:
    made: Tree = MemoryTree() if request.param == "memory" else DirectoryTree(tmp_path)
    made.mkdir(b"/dir")
    put(made, b"/file", b"0123456789")
    put(made, b"/dir/inner", b"x")
    return made


def put(tree: Tree, path: bytes, data: bytes) -> None:
    opened = tree.open(path, write=True, create=True, truncate=True)
    opened.write(0, data)
    opened.close()


def get(tree: Tree, path: bytes) -> bytes:
    opened = tree.open(path)
    try:
        return opened.read(0, opened.size())
    finally:
        opened.close()


def failure(action: Callable[[], object]) -> int | None:
    try:
        action()
    except OSError as exc:
        return exc.errno
    pytest.fail("no OSError")


@pytest.mark.parametrize("path", [b"file", b"/file", b"//./file", b"/dir/../file", b"/../../file"])
def test_paths_are_forgiving_but_stay_below_the_root(tree: Tree, path: bytes) -> None:
    assert get(tree, path) == b"0123456789"


@pytest.mark.parametrize(
    ("call", "number"),
    [
        (lambda tree: tree.entries(b"/file"), errno.ENOTDIR),
        (lambda tree: tree.entries(b"/none"), errno.ENOENT),
        (lambda tree: tree.stat(b"/none"), errno.ENOENT),
        (lambda tree: tree.stat(b"/file/x"), errno.ENOTDIR),
        (lambda tree: tree.open(b"/none"), errno.ENOENT),
        (lambda tree: tree.open(b"/dir"), errno.EISDIR),
        (lambda tree: tree.open(b"/none/x", write=True, create=True), errno.ENOENT),
        (lambda tree: tree.remove(b"/dir"), errno.EISDIR),
        (lambda tree: tree.remove(b"/none"), errno.ENOENT),
        (lambda tree: tree.rmdir(b"/file"), errno.ENOTDIR),
        (lambda tree: tree.rmdir(b"/dir"), errno.ENOTEMPTY),
        (lambda tree: tree.rmdir(b"/"), errno.EBUSY),
        (lambda tree: tree.mkdir(b"/dir"), errno.EEXIST),
        (lambda tree: tree.mkdir(b"/file"), errno.EEXIST),
        (lambda tree: tree.mkdir(b"/"), errno.EEXIST),
        (lambda tree: tree.mkdir(b"/none/x"), errno.ENOENT),
        (lambda tree: tree.rename(b"/none", b"/x"), errno.ENOENT),
        (lambda tree: tree.rename(b"/file", b"/dir"), errno.EISDIR),
        (lambda tree: tree.rename(b"/dir", b"/file"), errno.ENOTDIR),
        (lambda tree: tree.rename(b"/dir", b"/dir/sub"), errno.EINVAL),
        (lambda tree: tree.stat(b"/" + b"n" * 256), errno.ENAMETOOLONG),
        (lambda tree: tree.stat(b"/a\0b"), errno.EINVAL),
        (lambda tree: tree.open(b"/file").write(0, b"x"), errno.EBADF),
    ],
)
def test_failures_carry_the_real_errno(tree: Tree, call: Callable[[Tree], object], number: int) -> None:
    assert failure(lambda: call(tree)) == number


def test_directory_tree_refuses_ways_out(tmp_path: Path) -> None:
    (tmp_path / "served").mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    os.symlink(tmp_path / "secret", tmp_path / "served" / "link")
    os.symlink("inside", tmp_path / "served" / "good")
    (tmp_path / "served" / "inside").write_bytes(b"inside")
    tree = DirectoryTree(tmp_path / "served")
    assert failure(lambda: tree.open(b"/link")) == errno.EACCES
    assert failure(lambda: tree.stat(b"/../secret")) == errno.ENOENT
    assert get(tree, b"/good") == b"inside"
    kinds = {entry.name: entry.stat.kind for entry in tree.entries(b"/")}
    assert kinds[b"link"] is Kind.SYMLINK
    tree.remove(b"/link")
    assert (tmp_path / "secret").exists()


def test_directory_tree_does_not_block_on_a_fifo(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    assert failure(lambda: DirectoryTree(tmp_path).open(b"/fifo")) == errno.ENXIO


def test_memory_tree_capacity_is_shared_and_given_back() -> None:
    tree = MemoryTree(capacity=10)
    tree.add(b"/a", b"123456")
    opened = tree.open(b"/b", write=True, create=True)
    assert opened.write(0, b"xxxxxx") == 4
    assert failure(lambda: opened.write(4, b"y")) == errno.ENOSPC
    tree.remove(b"/a")
    assert opened.write(4, b"yyyyyy") == 6
    assert tree.used == 10
    opened.resize(1)
    assert tree.used == 1
