"""Files that appear on the vehicle under a name that is about to be made: none of them is emptied."""

from __future__ import annotations

import errno
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.background import START_AT
from mavftpfs.cache.remote import FREE_FOR
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import AlreadyExists, FtpNak, MavftpfsError, RequestTimeout, SessionBusy
from tests.support.fake_store import FakeFile
from tests.support.fake_writer import FakeWriter, card, make_writable, write_file

NEW = b"/card/new"
THEIRS = b"the vehicle's own log"


store = card({}, directories=[b"/card"], kinds=["posix", "fat", "mavsdk"])
posix = card({}, directories=[b"/card"])
fat = card({}, directories=[b"/card"], kinds=["fat"])


@pytest.mark.parametrize("content", [b"", b"ours"])
@pytest.mark.parametrize("exclusive", [False, True])
async def test_a_file_that_appeared_is_not_emptied(
    autojump_clock: object, store: FakeWriter, tree: Tree, exclusive: bool, content: bytes
) -> None:
    file = await tree.create(NEW, exclusive=exclusive)
    await file.write(0, content)
    store.add(NEW, THEIRS)
    await trio.sleep(FREE_FOR + 0.1)
    for ask in (file.fsync, file.fsync, file.release):
        with pytest.raises(AlreadyExists) as told:
            await ask()
        assert errno_for(told.value) == errno.EEXIST
    assert store.files[NEW].data == THEIRS
    assert tree.undelivered() == [NEW]
    await trio.sleep(100)
    assert store.files[NEW].data == THEIRS, "nor by what is tried in the background"
    del store.files[NEW]
    assert await tree.drain(10) == []
    assert store.files[NEW].data == content


async def test_a_fresh_listing_that_shows_the_name_does_not_free_it(store: FakeWriter, tree: Tree) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    store.add(NEW, THEIRS)
    tree.forget_caches()
    await tree.list(b"/card")
    with pytest.raises(AlreadyExists):
        await file.release()
    assert store.files[NEW].data == THEIRS


async def test_a_listing_that_was_cut_short_frees_no_name(store: FakeWriter, tree: Tree) -> None:
    store.incomplete.add(b"/card")
    store.unlisted.add(NEW)
    store.add(NEW, THEIRS)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    with pytest.raises(AlreadyExists):
        await file.release()
    assert store.files[NEW].data == THEIRS


async def test_another_spelling_that_appeared_is_not_emptied(autojump_clock: object, fat: FakeWriter) -> None:
    tree = make_writable(fat)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    fat.add(b"/card/NEW", THEIRS)
    await trio.sleep(FREE_FOR + 0.1)
    with pytest.raises(AlreadyExists):
        await file.release()
    assert fat.files[b"/card/NEW"].data == THEIRS


async def test_two_spellings_of_a_new_name_are_not_one_file(autojump_clock: object, fat: FakeWriter) -> None:
    """Both are made before either is on a card that folds case; the listing shows neither."""
    tree = make_writable(fat)
    files = [await tree.create(path, exclusive=True) for path in (NEW, b"/card/NEW")]
    for number, file in enumerate(files):
        await file.write(0, b"%d" % number)
    await files[0].release()
    with pytest.raises(AlreadyExists):
        await files[1].release()
    assert fat.files[NEW].data == b"0"
    assert tree.undelivered() == [b"/card/NEW"]


async def test_removing_ours_does_not_remove_what_appeared(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    store.add(NEW, THEIRS)
    await trio.sleep(FREE_FOR + 0.1)
    with pytest.raises(AlreadyExists):
        await file.release()
    await tree.unlink(NEW)
    assert (tree.undelivered(), store.files[NEW].data) == ([], THEIRS)
    assert (await tree.stat(NEW)).size == len(THEIRS)
    await tree.unlink(NEW)
    assert NEW not in store.files


@pytest.mark.parametrize("later", [0.0, FREE_FOR + 0.1])
async def test_removing_what_may_be_ours(
    autojump_clock: object, store: FakeWriter, tree: Tree, later: float
) -> None:
    """The reply to CreateFile was lost: an empty file is ours, one with content is not."""
    for theirs in (b"", THEIRS):
        file = await tree.create(NEW, exclusive=True)
        store.lose_reply_at = {store.requests + 1}
        with pytest.raises(RequestTimeout):
            await file.release()
        assert store.files[NEW].data == b""
        store.add(NEW, theirs)
        await trio.sleep(later)
        await tree.unlink(NEW)
        assert (NEW in store.files) == bool(theirs)


async def test_what_we_made_ourselves_is_gone_on_with(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    """A first attempt made the file and failed; the next one may empty it."""
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    store.fail_at[2] = FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, errno.EIO)
    with pytest.raises(MavftpfsError):
        await file.fsync()
    assert store.files[NEW].data == b""
    await trio.sleep(100)
    await file.release()
    assert store.files[NEW].data == b"ours"


async def test_what_may_be_ours_is_not_taken_for_anothers(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    """The reply to CreateFile was lost."""
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"ours")
    store.fail_at[1] = RequestTimeout("silence")
    store.before_request = lambda what, path, *_: store.files.setdefault(path, FakeFile(b"from us"))
    with pytest.raises(RequestTimeout):
        await file.fsync()
    await trio.sleep(100)
    await file.release()
    assert store.files[NEW].data == b"ours"


UNCLOSED = FtpNak(Opcode.TERMINATE_SESSION, NakCode.FAIL_ERRNO, errno.EIO)


@pytest.mark.parametrize("error", [None, UNCLOSED, SessionBusy("refused, since it was open")])
async def test_an_empty_file_is_ours_though_making_it_did_not_end_well(
    monkeypatch: pytest.MonkeyPatch,
    autojump_clock: object,
    store: FakeWriter,
    tree: Tree,
    error: MavftpfsError | None,
) -> None:
    """Who waited for it gave up (None), or an answer after the one to CreateFile was bad."""
    make = store.create_empty

    async def make_badly(path: bytes, *, free_at: float | None = None) -> None:
        await make(path, free_at=free_at)
        if error is not None:
            raise error
        await trio.sleep(60)

    file = await tree.create(NEW, exclusive=True)
    with monkeypatch.context() as patch:
        patch.setattr(store, "create_empty", make_badly)
        with suppress(FtpNak, SessionBusy), trio.move_on_after(1):
            await file.fsync()
    assert tree.undelivered() == [NEW]
    await trio.sleep(100)
    await file.release()
    assert tree.undelivered() == []


@pytest.mark.parametrize("content", [b"", b"ours"])
@pytest.mark.parametrize("theirs", [b"", THEIRS])
async def test_an_empty_file_that_may_be_ours(
    autojump_clock: object, store: FakeWriter, tree: Tree, content: bytes, theirs: bytes
) -> None:
    """The reply to its CreateFile was lost: an empty file is ours, one with content is not."""
    file = await tree.create(NEW, exclusive=True)
    store.lose_reply_at = {1}
    with pytest.raises(RequestTimeout):
        await file.fsync()
    await file.write(0, content)
    await trio.sleep(100)
    store.add(NEW, theirs)
    if theirs:
        with pytest.raises(AlreadyExists):
            await file.release()
    else:
        await file.release()
    assert store.files[NEW].data == (theirs or content)


async def test_a_move_into_the_mount_does_not_remove_what_appeared(
    autojump_clock: object, posix: FakeWriter
) -> None:
    """A failed attempt is cleaned up only if it may have made something."""
    tree = make_writable(posix)
    await tree.list(b"/card")
    local = await tree.create(b"/card/.new.swp", exclusive=True)
    await local.write(0, b"ours")
    await local.release()
    await trio.sleep(FREE_FOR + 0.1)
    posix.add(NEW, THEIRS)
    with pytest.raises(AlreadyExists):
        await tree.rename(b"/card/.new.swp", NEW)
    assert posix.files[NEW].data == THEIRS


async def test_a_copy_of_small_files_lists_once(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    for number in range(10):  # so many that sizes are asked otherwise
        store.add(b"/card/there%d" % number, b"x")
    await tree.list(b"/card")
    listings = store.count("list", b"/card")
    for number in range(10):
        await write_file(tree, b"/card/small%d" % number, b"content")
    assert store.count("list", b"/card") == listings
    assert store.looks == 0
    await trio.sleep(FREE_FOR + 0.1)
    await write_file(tree, b"/card/late", b"content")
    assert store.looks == 1


async def test_a_listing_of_before_it_was_made_does_not_leave_it_there(
    autojump_clock: object, store: FakeWriter, tree: Tree
) -> None:
    """Its delivery had begun, but it came to the vehicle only after that."""
    store.write_delay = 0.5
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, bytes(START_AT))
    await trio.sleep(0.1)
    tree.forget_caches()
    assert [name for name, _ in await tree.list(b"/card")] == [b"new"]
    await trio.sleep(1.0)
    assert NEW in store.files
    await tree.unlink(NEW)
    await file.release()
    assert NEW not in store.files
    assert await tree.list(b"/card") == []
