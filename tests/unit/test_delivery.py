"""Delivering drafts: plans on every kind of server, verification, errors, and interruption anywhere."""

from __future__ import annotations

import errno
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    Armed,
    FileTooLarge,
    FtpNak,
    NotSupported,
    RequestTimeout,
    VehicleLost,
    VerificationFailed,
)
from tests.support.fake_store import read_file
from tests.support.fake_writer import CHUNK, KINDS, FakeWriter, card, litter, make_writable, write_file

OLD = bytes(range(256)) * 4
NEW = b"new content " * 100
FILE = b"/card/dir/file.txt"


store = card({FILE: OLD})


any_store = card({FILE: OLD}, kinds=sorted(KINDS))


async def change(tree: Tree, path: bytes, offset: int, data: bytes) -> None:
    """Overwrite a part, as `dd conv=notrunc` does."""
    file = await tree.open(path, write=True)
    try:
        await file.write(offset, data)
        await file.flush()
        await file.release()
    finally:
        file.close()


# --- each kind of server


@pytest.mark.parametrize("data", [NEW, b""])
async def test_a_new_file_gets_its_name_when_it_is_whole(any_store: FakeWriter, data: bytes) -> None:
    tree = make_writable(any_store)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.write(0, data)
    assert any_store.requests == 0
    await file.release()
    assert any_store.files[b"/card/new"].data == data
    made = [entry[1] for entry in any_store.log if "create" in entry]
    assert (str(b"/card/new") in made) == (not any_store.kind.renames)
    assert any_store.count("crc") == bool(data)
    assert await read_file(tree, b"/card/new") == data
    assert litter(any_store) == []


async def test_whether_the_card_can_rename_is_found_out_once(any_store: FakeWriter) -> None:
    any_store.traits.rename_works = None
    tree = make_writable(any_store)
    await write_file(tree, b"/card/new", NEW)
    assert any_store.traits.rename_works == any_store.kind.renames
    renames = any_store.kind.renames
    assert sum(entry[0] == "create" for entry in any_store.log) == (not renames)
    any_store.log.clear()
    await write_file(tree, b"/card/newer", NEW)
    assert sum(entry[0] == "rename" for entry in any_store.log) == renames
    assert sum(entry[0] == "create" for entry in any_store.log) == 0


async def test_a_refusal_of_that_moment_is_not_taken_for_a_card_that_cannot_rename(store: FakeWriter) -> None:
    tree = make_writable(store)
    store.traits.rename_works = None

    def refuse(what: object, *_: object) -> None:
        if what == "rename":
            store.before_request = None
            raise FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.EIO)

    store.before_request = refuse
    await write_file(tree, FILE, NEW)
    assert store.before_request is None
    assert store.files[FILE].data == NEW
    assert store.traits.rename_works


@pytest.mark.holds("rule 14.22")
async def test_a_file_is_replaced_whole(any_store: FakeWriter) -> None:
    tree = make_writable(any_store)
    if any_store.kind.renames:
        await write_file(tree, FILE, NEW)
        assert any_store.files[FILE].data == NEW
    else:
        with pytest.raises(NotSupported):
            await write_file(tree, FILE, NEW)
        assert any_store.files[FILE].data == OLD
        assert await read_file(tree, FILE) == NEW, "what was accepted is kept and shown"
    assert litter(any_store) == []


@pytest.mark.holds("rule 14.25")
async def test_truncating(any_store: FakeWriter) -> None:
    tree = make_writable(any_store)
    for size in (700, 300, 1100, 0):
        before = any_store.files[FILE].data
        if any_store.kind.renames:
            await tree.truncate(FILE, size)
            assert any_store.files[FILE].data == before[:size].ljust(size, b"\0")
        else:
            with pytest.raises(NotSupported):
                await tree.truncate(FILE, size)
            assert any_store.files[FILE].data == before
        assert (await tree.stat(FILE)).size == len(any_store.files[FILE].data)
        assert await read_file(tree, FILE) == any_store.files[FILE].data
    assert tree.undelivered() == []


async def test_a_partial_change_of_a_large_file_is_refused_where_it_would_be_sent_whole(
    nursery: trio.Nursery,
) -> None:
    store = FakeWriter(KINDS["mavsdk"], nursery)
    store.add(FILE, OLD)
    tree = make_writable(store, rmw_max=1000)
    with pytest.raises(FileTooLarge):
        await change(tree, FILE, 5, b"x")
    assert store.files[FILE].data == OLD


async def test_overwriting_in_place_needs_no_room_for_both_files(nursery: trio.Nursery) -> None:
    """Whether the card can rename is found out on an empty file then, before the card is full."""
    store = FakeWriter(KINDS["littlefs"], nursery)
    store.add(FILE, OLD)
    store.traits.rename_works, store.capacity = None, len(NEW)
    await write_file(make_writable(store, inplace=True), FILE, NEW)
    assert store.files == {FILE: store.files[FILE]}
    assert store.files[FILE].data == NEW


# --- verification


@pytest.mark.holds("promise 2", "rule 14.23")
async def test_a_mismatch_is_sent_once_more(any_store: FakeWriter) -> None:
    any_store.spoil_uploads = 1
    tree = make_writable(any_store)
    await write_file(tree, b"/card/new", NEW)
    assert any_store.files[b"/card/new"].data == NEW
    assert any_store.count("crc") == 2


async def test_a_second_mismatch_is_an_error_and_the_old_file_stays(
    autojump_clock: object, store: FakeWriter
) -> None:
    store.spoil_uploads = 1000
    tree = make_writable(store)
    with pytest.raises(VerificationFailed):
        await write_file(tree, FILE, NEW)
    assert store.files[FILE].data == OLD
    assert litter(store) == []
    store.spoil_uploads = 0
    assert await tree.drain(10) == []
    assert store.files[FILE].data == NEW


@pytest.mark.holds("promise 2")
async def test_an_unanswered_checksum_counts_as_verified_by_size(store: FakeWriter) -> None:
    store.fail["crc", b"*"] = [RequestTimeout("silence")]
    tree = make_writable(store)
    await write_file(tree, b"/card/new", NEW)
    assert tree.status()["checksums_unanswered"] == 1
    assert tree.status()["verified_by_size"] == 1


@pytest.mark.holds("promise 2")
async def test_verify_crc_demands_an_answer(autojump_clock: object, store: FakeWriter) -> None:
    store.fail["crc", b"*"] = [RequestTimeout("silence")] * 2
    tree = make_writable(store, verify="crc")
    with pytest.raises(VerificationFailed):
        await write_file(tree, b"/card/new", NEW)
    await tree.drain(10)
    assert store.files[b"/card/new"].data == NEW


@pytest.mark.parametrize(("verify", "asked"), [("size", 0), ("none", 0), ("auto", 0), ("crc", 1)])
async def test_what_is_too_large_or_not_wanted_is_not_summed(
    store: FakeWriter, verify: str, asked: int
) -> None:
    tree = make_writable(store, verify=verify, verify_max=100)
    await write_file(tree, b"/card/new", NEW)
    assert store.count("crc") == asked


# --- errors


@pytest.mark.holds("promise 3")
async def test_an_error_is_told_at_every_close_until_the_bytes_are_there(
    autojump_clock: object, store: FakeWriter
) -> None:
    tree = make_writable(store)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.write(0, NEW)
    store.lost = True
    for ask in (file.flush, file.fsync, file.flush):
        with pytest.raises(VehicleLost):
            await ask()
    assert tree.undelivered() == [b"/card/new"]
    assert tree.status()["errors"] == {"/card/new": "no heartbeat"}
    assert tree.status()["bytes_undelivered"] == len(NEW)
    reader = await tree.open(b"/card/new")
    await reader.flush()
    await reader.release()
    with pytest.raises(VehicleLost):
        await file.flush()
    store.lost = False
    await file.flush()
    await file.release()
    assert store.files[b"/card/new"].data == NEW
    assert tree.undelivered() == []
    assert tree.status()["errors"] == {}
    assert tree.status()["bytes_held"] == 0


async def test_a_full_card_leaves_the_old_file(autojump_clock: object, store: FakeWriter) -> None:
    store.capacity = len(OLD) + 500
    tree = make_writable(store)
    with pytest.raises(FtpNak) as caught:
        await write_file(tree, FILE, NEW)
    assert errno_for(caught.value) == errno.ENOSPC
    assert store.files[FILE].data == OLD
    assert litter(store) == []
    assert tree.undelivered() == [FILE]
    assert await read_file(tree, FILE) == NEW
    await tree.unlink(FILE)
    assert tree.undelivered() == []
    assert FILE not in store.files


async def test_bytes_travel_while_the_program_still_writes(autojump_clock: object, store: FakeWriter) -> None:
    tree = make_writable(store)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.write(0, bytes(100_000))
    await trio.sleep(1)
    [there] = litter(store)
    assert len(store.files[there].data) == 100_000 // CHUNK * CHUNK  # the rest waits to fill a request
    for number in range(3):
        await file.write(50_000, b"again %d" % number)
        await trio.sleep(10)
    await file.release()
    data = store.files[b"/card/new"].data
    assert data == bytes(50_000) + b"again 2" + bytes(49_993)
    assert len(store.uploads) == 2, "who changes what was sent does so again: the rest waits for the close"


async def test_writers_wait_for_a_slow_link(autojump_clock: object, store: FakeWriter) -> None:
    store.write_delay = 0.01
    tree = make_writable(store, dirty_max=100_000)
    file = await tree.create(b"/card/new", exclusive=True)
    most = 0
    for at in range(0, 1_000_000, 50_000):
        await file.write(at, bytes(50_000))
        most = max(most, 50_000 + at - store.used + len(OLD))
    assert most < 250_000
    await file.release()
    assert tree.status()["bytes_held"] == 0


async def write_pieces(file: OpenFile, count: int, size: int) -> None:
    for number in range(count):
        await file.write(number * size, bytes(size))


async def test_a_writer_is_told_why_nothing_moves(autojump_clock: object, store: FakeWriter) -> None:
    tree = make_writable(store, dirty_max=65536)
    file = await tree.create(b"/card/new", exclusive=True)
    store.fail_at[5] = FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, errno.ENOSPC)
    store.capacity = 2000
    with pytest.raises(FtpNak):
        await write_pieces(file, 10, 10**5)
    file.close()


@pytest.mark.holds("promise 9")
async def test_armed_means_an_error_at_once_and_delivery_after(
    autojump_clock: object, store: FakeWriter
) -> None:
    tree = make_writable(store)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.write(0, NEW)
    store.armed = True
    tree.armed_changed(True)
    before = trio.current_time()
    asks: list[Callable[[], Awaitable[object]]] = [
        file.flush,
        file.fsync,
        lambda: file.write(0, b"x"),
        lambda: file.truncate(1),
        lambda: tree.create(b"/card/x", exclusive=False),
        lambda: tree.open(FILE, write=True),
        lambda: tree.open(FILE, write=True, truncate=True),
        lambda: tree.truncate(FILE, 0),
        lambda: tree.mkdir(b"/card/y"),
        lambda: tree.rmdir(b"/card/dir"),
        lambda: tree.unlink(FILE),
        lambda: tree.rename(FILE, b"/card/z"),
    ]
    for ask in asks:
        with pytest.raises(Armed):
            await ask()
    with pytest.raises(Armed):
        await file.release()
    assert trio.current_time() - before < 1
    assert store.requests == 0
    store.armed = False
    tree.armed_changed(False)
    await trio.sleep(1)
    assert store.files[b"/card/new"].data == NEW
    assert tree.undelivered() == []


async def test_when_armed_ok_writes_on(store: FakeWriter) -> None:
    tree = make_writable(store, write_armed=True)
    tree.armed_changed(True)
    await write_file(tree, FILE, NEW)
    assert store.files[FILE].data == NEW


# --- the end of a mount


async def test_what_is_still_open_when_the_mount_ends_is_not_kept(store: FakeWriter, tmp_path: Path) -> None:
    """A kernel that lost its mount closes nothing: the next mount must not offer what was delivered."""
    spool = SpoolDirectory(tmp_path / "spool", Random(1))
    tree = make_writable(store, spool=spool, dirty_max=65536)
    file = await tree.create(b"/card/new", exclusive=True)
    await file.write(0, bytes(300_000))
    assert await tree.drain(10) == []
    spool.discard()
    assert [path.name for path in spool.path.iterdir()] == ["owner"]
    spool.close()


async def test_what_cannot_be_delivered_is_moved_with_its_description(
    autojump_clock: object, store: FakeWriter, tmp_path: Path
) -> None:
    tree = make_writable(store)
    new = await tree.create(b"/card/dir/new", exclusive=True)
    await new.write(0, NEW)
    part = await tree.open(FILE, write=True)
    await part.write(500, b"part")
    store.lost = True
    assert sorted(await tree.drain(5)) == [FILE, b"/card/dir/new"]
    files = tree.recover_to(tmp_path / "rescued")
    contents = {path.name: path.read_bytes() for path in files}
    assert contents["card__dir__new"] == NEW
    assert contents["card__dir__file.txt"][500:504] == b"part"
    whole, changed = (
        json.loads(path.with_name(f"{path.name}.json").read_text())
        for path in sorted(files, key=lambda path: "new" not in path.name)
    )
    assert whole["whole"]
    assert changed["changed"] == [[500, 504]]
    assert not changed["whole"]
