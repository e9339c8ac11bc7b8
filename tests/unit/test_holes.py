"""A file that loses its bytes while a part of it is changed in place: never a hole of the right size."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import trio

from mavftpfs.cache.plan import Plan, choose
from mavftpfs.cache.sending import Sending
from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.shared.errors import FileChanged, RequestTimeout
from mavftpfs.shared.traits import WriteTraits
from tests.support.fake_store import read_file
from tests.support.fake_writer import KINDS, FakeWriter, card, make_writable
from tests.unit.test_plan import KEEPS, RULES, draft

OLD = bytes(range(256)) * 4
FILE = b"/card/dir/file.txt"


@pytest.fixture(params=["posix", "fat", "littlefs"])
async def store(
    request: pytest.FixtureRequest, nursery: trio.Nursery, autojump_clock: object
) -> AsyncIterator[FakeWriter]:
    store = FakeWriter(KINDS[request.param], nursery)
    store.traits.wo_truncates = False
    store.traits.rename_works = store.kind.renames
    store.add(FILE, OLD)
    yield store
    assert store.crimes == []
    nursery.cancel_scope.cancel()


posix = card({FILE: OLD})


def shrink_at(store: FakeWriter, number: int, size: int, *, lose: bool = False) -> None:
    """Have the file cut just before the `number`th opening of it for writing."""
    left = number

    def watch(*request: object) -> None:
        nonlocal left
        if request[0] == "open":
            left -= 1
            if left == 0:
                store.files[FILE].data = store.files[FILE].data[:size]
        if lose and request[0] == "write" and left == number - 1:
            raise RequestTimeout("the session is lost")

    store.before_request = watch


@pytest.mark.parametrize("size", [0, 500, len(OLD) - 1])
async def test_a_file_that_shrank_gets_no_hole(store: FakeWriter, tree: Tree, size: int) -> None:
    file = await tree.open(FILE, write=True)
    await file.write(len(OLD), b"appended")
    shrink_at(store, 1, size)
    for _ in range(3):
        with pytest.raises(FileChanged):
            await file.fsync()
    assert store.files[FILE].data == OLD[:size]
    with pytest.raises(FileChanged):
        await file.read(0, len(OLD))
    assert tree.undelivered() == [FILE]
    file.close()


async def cut_to_500(store: FakeWriter, now: bytes) -> OpenFile:
    """Open a file, have the vehicle change it to `now`, and cut it for the program."""
    file = await make_writable(store).open(FILE, write=True)
    store.files[FILE].data = now
    await file.truncate(500)
    return file


@pytest.mark.parametrize("size", [0, 100, 499])
async def test_cutting_a_file_that_shrank_since_does_not_fill_it_up(
    size: int, posix: FakeWriter, autojump_clock: object
) -> None:
    """TruncateFile extends what is shorter: zeros where the program was shown bytes."""
    file = await cut_to_500(posix, OLD[:size])
    for _ in range(2):
        with pytest.raises(FileChanged):
            await file.fsync()
    assert posix.files[FILE].data == OLD[:size]
    file.close()


@pytest.mark.parametrize("now", [OLD + OLD, OLD[:500]])
async def test_cutting_a_file_that_grew_or_was_cut_there_is_no_matter(
    now: bytes, posix: FakeWriter, autojump_clock: object
) -> None:
    file = await cut_to_500(posix, now)
    await file.release()
    assert posix.files[FILE].data == OLD[:500]
    file.close()


async def test_what_is_known_here_is_sent_whole(store: FakeWriter, tree: Tree) -> None:
    """Nothing is left that could be kept, so it is allowed where files cannot be replaced, too."""
    file = await tree.open(FILE, write=True)
    await file.write(0, OLD[::-1] + b"appended")
    shrink_at(store, 1, 0)
    await file.fsync()
    assert store.files[FILE].data == OLD[::-1] + b"appended"
    assert await read_file(tree, FILE) == OLD[::-1] + b"appended"
    assert tree.undelivered() == []
    file.close()


async def test_a_file_that_regained_its_size_is_still_not_trusted(store: FakeWriter, tree: Tree) -> None:
    """Its size is right again, its bytes may be anything."""
    file = await tree.open(FILE, write=True)
    await file.write(len(OLD), b"appended")
    shrink_at(store, 1, 10)
    with pytest.raises(FileChanged):
        await file.fsync()
    store.files[FILE].data = bytes(len(OLD))
    with pytest.raises(FileChanged):
        await file.fsync()
    assert store.files[FILE].data == bytes(len(OLD))
    file.close()


async def test_an_upload_that_began_before_the_close_is_given_up_too(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file = await tree.open(FILE, write=True)
    shrink_at(store, 1, 10)
    await file.write(len(OLD), bytes(range(250)) * 400)
    await trio.sleep(1)  # it went on in the background
    with pytest.raises(FileChanged):
        await file.release()
    assert len(store.files[FILE].data) == 10


async def test_news_of_lost_bytes_beat_an_upload_that_ended_well(store: FakeWriter, tree: Tree) -> None:
    file = await tree.open(FILE, write=True)
    await file.write(len(OLD), b"appended")

    def empty(*request: object) -> None:
        if request[0] == "terminate":
            store.uploads[-1]._source.on_rollback(True)
            store.files[FILE].data = bytes(len(OLD)) + b"appended"

    store.before_request = empty
    for _ in range(2):
        with pytest.raises(FileChanged):
            await file.fsync()
    assert tree.undelivered() == [FILE]
    file.close()


def test_nothing_is_handed_out_for_a_file_that_was_emptied() -> None:
    sending = Sending(lambda start, stop: bytes(stop - start), [(100, 200)], whole=False)
    assert sending.next_chunk(50) is not None
    sending.on_rollback(everything=True)
    assert sending.emptied
    assert sending.next_chunk(50) is None
    assert sending.unacked == 100
    whole = Sending(lambda start, stop: bytes(stop - start), [(0, 200)], whole=True)
    whole.on_rollback(everything=True)
    assert whole.next_chunk(50) == (0, bytes(50))


def test_what_is_chosen_for_a_file_that_was_emptied() -> None:
    known = draft(10, (0, bytes(12)))
    known.begin(whole=False).on_rollback(everything=True)
    assert choose(known, KEEPS, RULES) is Plan.REPLACE
    assert choose(known, WriteTraits(wo_truncates=False, rename_works=False), RULES) is Plan.REWRITE
    known.begin_again()
    assert choose(known, KEEPS, RULES) is Plan.REPLACE
    known.delivered()
    known.write(3, b"x")
    assert choose(known, KEEPS, RULES) is Plan.IN_PLACE
    part = draft(10, (10, b"x"))
    part.begin(whole=False).on_rollback(everything=True)
    with pytest.raises(FileChanged):
        choose(part, KEEPS, RULES)
