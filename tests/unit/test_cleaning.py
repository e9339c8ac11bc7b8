"""When what an interruption left is mended, and when it has to wait."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.directories import Directory
from mavftpfs.cache.repair import Cleaner
from mavftpfs.cache.reserved import Kind, Reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.model import DirEntry, EntryKind
from tests.support.fake_writer import KINDS, FakeWriter

OLD = bytes(range(256)) * 4
DIRECTORY = b"/card/dir"
FILE = DIRECTORY + b"/file.txt"


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["fat"], nursery)
    store.add_directory(DIRECTORY)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


def parts(tree: Tree) -> tuple[Context, Cleaner]:
    assert tree._writing is not None
    return tree._writing._context, tree._writing._cleaner


def reserved(tree: Tree, kind: Kind, target: bytes | None = b"file.txt") -> bytes:
    """A name that this mount left behind."""
    return Reserved(parts(tree)[0].own.owner, kind, b"sss", target).name


async def test_only_a_listing_that_counts_proves_a_torn_name_whole(store: FakeWriter, tree: Tree) -> None:
    """One that began before the name was torn shows it because we said so."""
    context, cleaner = parts(tree)
    place = DIRECTORY + b"/" + reserved(tree, Kind.OLD)
    context.own.torn[FILE] = place
    now = trio.current_time()
    shown = Directory({b"file.txt": DirEntry(b"file.txt", EntryKind.FILE, 3)}, now, now, now + 20, True)
    await cleaner.on_swept(DIRECTORY, shown)
    assert context.own.torn == {FILE: place}
    store.add(FILE, OLD)
    await tree.list(DIRECTORY)
    assert context.own.torn == {}
