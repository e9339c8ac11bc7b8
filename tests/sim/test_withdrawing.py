"""A program that withdraws a file: nothing of it is sent later, and the program learns what the card has."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import MavftpfsError, NotFound
from tests.support.rigs import KINDS, Rig, card, open_to_copy, read_file
from tests.support.transfers import content

pytestmark = pytest.mark.holds("promise 2", "promise 3")

OLD = content(3_000)
NEW = content(20_000)
FILE, FRESH = b"/d/file", b"/d/fresh"
DEADLINE = 5.0
LONG = 300.0
"""Seconds after which everything that is tried by itself was tried."""

here = card({FILE: OLD}, profiles=KINDS, options=ConnectOptions(op_deadline=DEADLINE))


@pytest.fixture
async def tree(here: Rig) -> Tree:
    tree = here.mount(op_deadline=DEADLINE)
    await tree.list(b"/d")
    return tree


@pytest.mark.parametrize("after", [0, 30])
@pytest.mark.parametrize("path", [FILE, FRESH])
async def test_what_could_not_be_delivered_never_comes(
    here: Rig, tree: Tree, path: bytes, after: int
) -> None:
    """The link is cut before, or while, the mount sends the file."""
    file = await open_to_copy(tree, path)
    here.faults.cut_after(after)
    await file.write(0, NEW)
    with pytest.raises(MavftpfsError):
        await file.fsync()
    there = await file.take_back()
    here.faults.cut_after(None)
    await trio.sleep(LONG)
    await tree.list(b"/d")
    assert tree.undelivered() == []
    if here.renames or path == FILE:
        assert (there, here.files(), here.litter()) == (False, {FILE: OLD}, [])
    else:  # only such a card has parts of a file under its name
        assert there is None or FRESH not in here.files()
        assert here.files().get(FRESH, NEW) in (b"", *(NEW[:end] for end in range(0, len(NEW) + 1)))


@pytest.mark.parametrize("path", [FILE, FRESH])
async def test_an_interrupted_name_is_looked_at(here: Rig, tree: Tree, path: bytes) -> None:
    """The vehicle does not answer the rename that gives the file its name."""
    if not here.renames:
        return
    file = await open_to_copy(tree, path)
    await file.write(0, NEW)
    here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0))
    with pytest.raises(MavftpfsError):
        await file.fsync()
    here.faults.cut_after(None)
    there = await file.take_back()
    await trio.sleep(LONG)
    await tree.list(b"/d")
    assert there is (here.files().get(path) == NEW)
    assert here.files().get(FILE) in (OLD, NEW)
    assert here.litter() == []


async def test_it_is_what_it_was_for_everybody(here: Rig, tree: Tree) -> None:
    file, fresh = await open_to_copy(tree, FILE), await open_to_copy(tree, FRESH)
    reader = await tree.open(FILE)
    await file.write(0, NEW)
    await fresh.write(0, NEW)
    assert await file.take_back() is False
    assert await fresh.take_back() is False
    assert await read_file(tree, FILE) == OLD
    with pytest.raises(NotFound):
        await tree.stat(FRESH)
    assert await reader.read(0, len(OLD)) == NEW[: len(OLD)]  # of a file that lost its name
    await reader.release()


async def test_what_is_there_is_there(here: Rig, tree: Tree) -> None:
    file = await open_to_copy(tree, FRESH)
    await file.write(0, NEW)
    await file.fsync()
    assert await file.take_back() is True
    assert here.data(FRESH) == NEW


async def test_what_others_write_too_is_theirs(here: Rig, tree: Tree) -> None:
    file = await open_to_copy(tree, FRESH)
    other = await tree.open(FRESH, write=True)
    await file.write(0, b"ours")
    await other.write(4, b"theirs")
    assert await file.take_back() is None
    await other.release()
    assert here.data(FRESH) == b"ourstheirs"


async def test_a_listing_does_not_wait_because_its_requests_came_late(here: Rig, tree: Tree) -> None:
    """Names are in quarantine after late duplicates, for up to ten seconds, but not a temporary name that is
    only removed. (ArduPilot refuses the listing for 3 s: one of these requests opened a file.)"""
    handle, held = here.server.handle, []
    here.faults.orphans = True
    here.server.handle = lambda *request: held.append(request)  # type: ignore[method-assign]
    file = await open_to_copy(tree, FRESH)
    await file.write(0, NEW)
    with pytest.raises(MavftpfsError):
        await file.fsync()
    await file.take_back()
    here.server.handle = handle  # type: ignore[method-assign]
    for wire, source, _ in held:
        handle(wire, source, trio.current_time())
    here.link.kick()
    await trio.sleep(0.1)
    began = trio.current_time()
    await tree.list(b"/d")
    assert trio.current_time() - began < 4.0
