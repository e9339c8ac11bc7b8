"""Names that no listing can show: refused before anything is sent, or they could never be removed."""

from __future__ import annotations

import errno
from collections.abc import Awaitable, Callable

import pytest

from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError
from tests.support.fake_store import read_file
from tests.support.fake_writer import FakeWriter, card, make_writable, write_file

pytestmark = pytest.mark.holds("rule 14.33")

SEEN = b"/d/seen"
BAD = [b"/d/ta\tb", b"/d/\tx", b"/d/x\t", b"/d/7\t8"]
SWAP = b"/d/.ta\tb.swp"


store = card({SEEN: b"it"})


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    return make_writable(store, local=("*.swp",))


async def create(tree: Tree, path: bytes) -> None:
    await write_file(tree, path, b"new")


async def make_directory(tree: Tree, path: bytes) -> None:
    await tree.mkdir(path)


async def rename(tree: Tree, path: bytes) -> None:
    await tree.rename(SEEN, path)


@pytest.mark.parametrize("path", BAD)
@pytest.mark.parametrize("act", [create, make_directory, rename])
async def test_such_a_name_is_refused_and_nothing_is_sent(
    store: FakeWriter, tree: Tree, act: Callable[[Tree, bytes], Awaitable[None]], path: bytes
) -> None:
    with pytest.raises(MavftpfsError) as told:
        await act(tree, path)
    assert errno_for(told.value) == errno.EINVAL
    assert store.log == []
    assert tree.undelivered() == []
    assert await read_file(tree, SEEN) == b"it"


@pytest.mark.parametrize("path", [b"/d/new\nline", b"/d/ x ", b"/d/\xff\x01", b"/d/-F", b"/d/S"])
async def test_odd_names_that_are_listed_are_not_refused(store: FakeWriter, tree: Tree, path: bytes) -> None:
    await create(tree, path)
    assert store.files[path].data == b"new"
    await tree.unlink(path)
    await make_directory(tree, path)
    await tree.rmdir(path)
    await rename(tree, path)
    assert store.files[path].data == b"it"


async def test_names_that_never_reach_the_vehicle_may_be_any(store: FakeWriter, tree: Tree) -> None:
    await create(tree, SWAP)
    assert await read_file(tree, SWAP) == b"new"
    await tree.unlink(SWAP)
    assert store.log == []
