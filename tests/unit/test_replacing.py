"""Renames over files: what a refusal teaches, and what is left when a step fails."""

from __future__ import annotations

import errno
from collections.abc import AsyncIterator
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, RequestTimeout, VehicleLost
from mavftpfs.shared.model import split
from tests.support.fake_writer import KINDS, FakeWriter, list_all, litter, make_writable, write_file

pytestmark = pytest.mark.holds("promise 3")

OLD = bytes(range(256)) * 4
NEW = b"new content " * 100
FILE = b"/card/dir/file.txt"
OTHER = b"/card/dir/other"
LONG = b"/card/" + b"f" * 150


@pytest.fixture
async def store(nursery: trio.Nursery, autojump_clock: object) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS["posix"], nursery)
    store.add(FILE, OLD)
    store.add(OTHER, NEW)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


def renames(store: FakeWriter) -> int:
    return sum(entry[0] == "rename" for entry in store.log)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
async def test_a_refusal_for_another_reason_says_nothing_of_replacing(
    store: FakeWriter, tree: Tree, number: int
) -> None:
    store.fail_at[1] = FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, number)
    with pytest.raises(FtpNak):
        await tree.rename(OTHER, FILE)
    assert renames(store) == 1, "nothing was moved aside"
    assert store.traits.rename_replaces is None
    assert store.traits.rename_works is not False
    await tree.rename(OTHER, FILE)
    assert store.files[FILE].data == NEW


async def test_a_server_that_says_no_by_an_odd_error_is_learnt_too(store: FakeWriter, tree: Tree) -> None:
    """LittleFS-like refusals that are not "file exists"."""

    def refuse(*request: object) -> None:
        if request[0] == "rename" and request[2] in store.files:
            raise FtpNak(Opcode.RENAME, NakCode.FAIL)

    store.before_request = refuse
    await write_file(tree, FILE, NEW)
    await write_file(tree, FILE, OLD)
    assert store.files[FILE].data == OLD


@pytest.mark.parametrize("verify", ["auto", "size", "none", "crc"])
@pytest.mark.parametrize("target_too", [False, True])
async def test_a_temporary_that_vanished_is_not_taken_for_success(
    autojump_clock: object, store: FakeWriter, target_too: bool, verify: str
) -> None:
    """While the link was lost between the verification and the rename, somebody tidied up."""
    tree = make_writable(store, verify=verify)
    store.add(FILE, NEW[::-1])  # of the same size
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)

    def vanish(*request: object) -> None:
        if request[0] == "rename":
            store.before_request = None
            store.lost = True

    store.before_request = vanish
    with pytest.raises(VehicleLost):
        await file.fsync()
    store.lost = False
    for path in list(store.files):
        if is_reserved(split(path)[1]) or (target_too and path == FILE):
            del store.files[path]
    await file.release()
    assert store.files[FILE].data == NEW


@pytest.mark.parametrize("path", [FILE, LONG])
async def test_what_could_not_be_removed_brings_nothing_back(
    autojump_clock: object, store: FakeWriter, tree: Tree, path: bytes
) -> None:
    store.traits.rename_replaces = False
    store.kind = KINDS["fat"]
    store.add(path, OLD)
    left = 1

    def keep(*request: object) -> None:
        nonlocal left
        if request[0] == "remove" and left:
            left -= 1
            raise RequestTimeout("silence")

    store.before_request = keep
    await write_file(tree, path, NEW)
    assert left == 0
    await tree.unlink(path)
    await list_all(store, tree)
    assert set(store.files) == {OTHER, FILE} - {path}


@pytest.mark.parametrize("kind", ["posix", "fat"])
@pytest.mark.parametrize("refused", [1, 2])
async def test_what_is_refused_a_name_again_and_again_does_not_fill_the_card(
    autojump_clock: object, nursery: trio.Nursery, kind: str, refused: int
) -> None:
    """No listing is made that would show it."""
    store = FakeWriter(KINDS[kind], nursery)
    store.add(FILE, OLD)
    for number in range(10):  # so many that sizes are asked otherwise
        store.add(b"/card/dir/%d" % number, b"x")
    tree = make_writable(store)
    await tree.list(b"/card/dir")
    renames_left = 0

    def refuse(what: str, *_: object) -> None:
        nonlocal renames_left
        renames_left -= what == "rename"
        if what == "rename" and not renames_left:
            store.fail_at[store.requests + 1] = FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.EACCES)

    store.before_request = refuse
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    for _ in range(5):
        renames_left = refused
        with suppress(FtpNak):
            await file.flush()
        assert litter(store) == []
        if not tree.undelivered():
            await file.write(0, b"x")
    store.before_request = None
    await file.release()
    assert store.files[FILE].data in (NEW, b"x" + NEW[1:])
    assert store.crimes == []
    nursery.cancel_scope.cancel()
