"""Open files: the bytes that readers get, files that lose their name, and files that others replaced.

A vehicle that replaces a file between two sessions of its server: test_replaced.
"""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.throttle import STALL
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.session.scheduler import ReadMode
from mavftpfs.shared.errors import (
    AlreadyExists,
    FileBusy,
    FileChanged,
    FileTooLarge,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    NotSupported,
    ReadOnly,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import KINDS, RENAMING, Rig, card, rig, write_file
from tests.support.transfers import content

DATA = bytes(range(256)) * 300
FILE, NEW, OTHER = b"/d/file.bin", b"/d/new", b"/d/other"

here = card({FILE: DATA})


@pytest.fixture
def tree(here: Rig) -> Tree:
    """A mount with the defaults."""
    return here.mount()


# --- readers that go


@pytest.mark.parametrize(("mode", "on_its_way"), [("window", 6000), ("burst", 40_000)])
@pytest.mark.parametrize("how", ["interrupted", "closed"])
async def test_nothing_more_is_fetched_once_nobody_reads(how: str, mode: ReadMode, on_its_way: int) -> None:
    """Over a radio of 15 kB/s, a program gives up in the middle of the bytes that it asked for.

    on_its_way: bytes; a burst has up to 38 kB.
    """
    link, size = LinkSettings(rate=15_000.0, delay=0.03), 400_000
    async with rig("px4", {FILE: content(size)}, link=link, options=ConnectOptions(read_mode=mode)) as here:
        tree = here.mount()
        file = await tree.open(FILE)
        if how == "closed":  # what is read ahead is still to come
            assert len(await file.read(0, 4096)) == 4096
            assert len(await file.read(4096, 4096)) == 4096
        with trio.move_on_after(5.0):
            await file.read(8192, 256 * 1024)
        stats, came = here.connection.engine.stats, here.connection.link.stats.received_bytes
        asked = stats.requests
        if how == "closed":
            file.close()
        await trio.sleep(30.0)
        assert stats.requests - asked <= 2, "reads, and a Terminate"
        assert here.connection.link.stats.received_bytes - came < 30 * 60 + on_its_way, "30 heartbeats"
        if how == "interrupted":
            assert await file.read(8192, 30_000) == content(size)[8192:38192]
            file.close()


async def test_one_interrupted_read_leaves_others_theirs() -> None:
    link, size = LinkSettings(rate=15_000.0, delay=0.03), 400_000
    async with rig("px4", {FILE: content(size)}, link=link) as here:
        tree = here.mount()
        file, got = await tree.open(FILE), []

        async def read_on() -> None:
            got.append(bytes(await file.read(100_000, 100_000)))

        async with trio.open_nursery() as nursery:
            nursery.start_soon(read_on)
            with trio.move_on_after(3.0):
                await file.read(0, 150_000)
        assert got == [content(size)[100_000:200_000]]
        assert trio.current_time() < 15.0
        file.close()


# --- opening and writing


async def test_the_shells_redirection_is_one_delivery(here: Rig, tree: Tree) -> None:
    """open(O_TRUNC), dup2, close, write, close: flush comes before the first byte."""
    file = await tree.open(FILE, write=True, truncate=True)
    await file.flush()
    assert here.count(Opcode.CREATE_FILE) == 0
    assert file.size == (await tree.stat(FILE)).size == 0
    await file.write(0, b"echo\n")
    await file.flush()
    asked = len(here.faults.requests)
    await file.release()
    assert len(here.faults.requests) == asked
    assert here.count(Opcode.RENAME) == 1
    assert here.data(FILE) == b"echo\n"


async def test_creating(here: Rig, tree: Tree) -> None:
    for path, exclusive, error in (
        (FILE, True, AlreadyExists),
        (b"/none/x", False, NotFound),
        (FILE + b"/x", False, NotADirectory),
        (b"/d", False, IsADirectory),
        (b"/d/.mavftpfs-abcdnabc", False, NotSupported),
    ):
        with pytest.raises(error):
            await tree.create(path, exclusive=exclusive)
    file = await tree.create(FILE, exclusive=False)
    assert file.size == len(DATA)
    await file.release()
    assert here.count(Opcode.CREATE_FILE, Opcode.REMOVE_FILE, Opcode.RENAME) == 0


async def test_a_write_waits_while_the_file_is_being_delivered() -> None:
    async with rig(link=LinkSettings(delay=0.5)) as here:
        tree = here.mount()
        one = await tree.create(b"/new", exclusive=True)
        two = await tree.open(b"/new", write=True)
        await one.write(0, b"one")
        async with trio.open_nursery() as both:
            both.start_soon(one.release)
            await trio.sleep(0.5)
            await two.write(0, b"ONE")
            assert here.data(b"/new") == b"one"
        await two.release()
        assert here.data(b"/new") == b"ONE"


async def test_handles_are_closed_once(tree: Tree) -> None:
    file, reader = await tree.open(FILE, write=True), await tree.open(FILE)
    for handle in (file, reader):
        await handle.release()
        await handle.release()
        handle.close()
    for use in (file.write(0, b"x"), file.read(0, 1), reader.write(0, b"x")):
        with pytest.raises(LocalProtocolError):
            await use


@pytest.mark.holds("rule 14.27")
async def test_no_file_is_larger_than_the_protocol_can_say(tree: Tree) -> None:
    file = await tree.create(NEW, exclusive=True)
    for change in (file.write(2**32 - 1, b"x"), file.truncate(2**32)):
        with pytest.raises(FileTooLarge):
            await change
    await file.release()


async def test_read_only_and_virtual_trees_refuse_changes(here: Rig, tree: Tree) -> None:
    reading = here.mount(read_only=True)
    for change in (
        reading.mkdir(b"/x"),
        reading.open(FILE, write=True),
        reading.unlink(FILE),
        tree.create(b"/@SYS/x", exclusive=False),
        tree.rename(FILE, b"/@SYS/x"),
    ):
        with pytest.raises(ReadOnly):
            await change


@pytest.mark.holds("promise 6")
async def test_a_growing_file_is_busy(here: Rig) -> None:
    tree = here.mount(dir_timeout=1)
    await tree.stat(FILE)
    here.put(FILE, DATA + b"more")
    await trio.sleep(2)
    await tree.stat(FILE)
    for ask in (
        tree.open(FILE, write=True),
        tree.open(FILE, write=True, truncate=True),
        tree.unlink(FILE),
        tree.rename(FILE, b"/d/x"),
        tree.truncate(FILE, 0),
    ):
        with pytest.raises(FileBusy):
            await ask
    reader = await tree.open(FILE)
    with pytest.raises(FileBusy):
        await tree.unlink(FILE)
    await reader.release()
    await trio.sleep(60)
    await tree.truncate(FILE, 0)
    assert here.data(FILE) == b""


@pytest.mark.holds("promise 6")
async def test_growth_shows_when_a_file_is_opened_too(here: Rig, tree: Tree) -> None:
    await tree.stat(FILE)
    here.put(FILE, DATA + b"more")
    with pytest.raises(FileBusy):
        await tree.open(FILE, write=True)


# --- files that lose their name: on the card


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize(
    ("how", "profile"), [("unlink", each) for each in KINDS] + [("rename over", each) for each in RENAMING]
)
async def test_a_file_that_lost_its_name_reads_no_other_file(how: str, profile: str) -> None:
    """The card no longer has its bytes. The file that has the name now has as many."""
    async with rig(profile, {FILE: DATA * 5, OTHER: DATA[::-1] * 5}, link=LinkSettings(delay=0.05)) as here:
        tree = here.mount()
        reader, writer = await tree.open(FILE), await tree.open(FILE, write=True)
        assert await reader.read(0, 10) == DATA[:10]
        await writer.write(3, b"here")
        if how == "unlink":
            await tree.unlink(FILE)
            with pytest.raises(NotFound):
                await tree.stat(FILE)
        else:
            await tree.rename(OTHER, FILE, noreplace=False)
        assert here.litter() == []
        assert await writer.read(3, 4) == b"here"
        for handle in (reader, writer):
            with pytest.raises(FileChanged):
                await handle.read(100_000, 10)
            await handle.release()
        assert tree.status()["bytes_held"] == 0


async def test_open_files_below_a_renamed_directory_follow(here: Rig, tree: Tree) -> None:
    writer = await tree.create(NEW, exclusive=True)
    await writer.write(0, b"abc")
    reader = await tree.open(FILE)
    await tree.rename(b"/d", b"/there")
    assert await reader.read(0, len(DATA)) == DATA
    await writer.write(3, b"def")
    await writer.release()
    await reader.release()
    assert here.files() == {b"/there/new": b"abcdef", b"/there/file.bin": DATA}
    assert (await tree.stat(b"/there/new")).size == 6
    with pytest.raises(NotFound):
        await tree.stat(NEW)


# --- files that lose their name: only here

KIB = 1024
PIECES, PIECE = 48, 32 * KIB


async def fill(file: OpenFile) -> None:
    for number in range(PIECES):
        await file.write(number * PIECE, content(PIECE, number))


async def assert_filled(file: OpenFile) -> None:
    for number in range(PIECES):
        assert await file.read(number * PIECE, PIECE) == content(PIECE, number)


@pytest.mark.parametrize("over", [False, True])
async def test_a_file_without_a_name_waits_for_no_vehicle(here: Rig, over: bool) -> None:
    """Another writer does not wait for it either."""
    tree = here.mount()
    nameless = await tree.create(NEW, exclusive=True)
    if over:
        await write_file(tree, OTHER, b"it")
        await tree.rename(OTHER, NEW, noreplace=False)
    else:
        await tree.unlink(NEW)
    there = here.files()
    with trio.fail_after(STALL):
        await fill(nameless)
    assert tree.status()["bytes_held"] >= PIECES * PIECE  # type: ignore[operator]
    await nameless.fsync()
    await write_file(tree, b"/d/another", bytes(300 * KIB), step=PIECE)
    await assert_filled(nameless)
    await nameless.release()
    assert here.files() == there | {b"/d/another": bytes(300 * KIB)}
    assert (tree.undelivered(), tree.status()["bytes_held"]) == ([], 0)


async def test_a_writer_that_waits_goes_on_when_its_file_is_removed() -> None:
    link = LinkSettings(rate=4_000.0, delay=0.02)
    async with rig("px4", {OTHER: DATA}, link=link) as here:
        tree = here.mount()
        file, done = await tree.create(NEW, exclusive=True), trio.Event()

        async def fill() -> None:
            for number in range(40):
                await file.write(number * PIECE, content(PIECE))
            done.set()

        here.nursery.start_soon(fill)
        await trio.sleep(30)
        assert not done.is_set()
        await tree.unlink(NEW)
        with trio.fail_after(0.5):
            await done.wait()
        file.close()


async def test_zeros_that_a_program_made_are_not_fetched(here: Rig, tree: Tree) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.truncate(100_000)
    await file.write(100_000, b"end")
    await file.fsync()
    assert bytes(await file.read(0, 1000)) == bytes(1000)
    await file.write(100_000, b"END")
    await file.release()
    assert here.data(NEW) == bytes(100_000) + b"END"
    assert here.count(Opcode.READ_FILE, Opcode.BURST_READ_FILE) == 0


# --- a file that was replaced while it was open gives ESTALE for good

OLD, LATER = b"old" * 300, b"NEW" * 300
"""As long as one another: only the times differ."""
THEN = 1_700_000_000

timed = card({FILE: b""}, profiles=["ardupilot5", "mavsdk"], link=LinkSettings(delay=0.01))


@pytest.fixture
def there(timed: Rig) -> Rig:
    """A card whose listings tell times."""
    timed.put(FILE, OLD, THEN)
    return timed


async def opened(tree: Tree, *, write: bool = False) -> OpenFile:
    """Return an open file that got bytes of the old one."""
    file = await tree.open(FILE, write=write)
    assert bytes(await file.read(0, 9)) == OLD[:9]
    return file


async def require_lost(reader: OpenFile) -> None:
    for _ in range(2):
        with pytest.raises(FileChanged):
            await reader.read(9, 9)


@pytest.mark.holds("promise 5")
async def test_all_older_versions_are_lost(there: Rig) -> None:
    """The version that a program opened before the file grew is lost, too."""
    tree = there.mount()
    first = await opened(tree)
    there.put(FILE, OLD + OLD, THEN + 200)
    tree.forget_caches()
    second = await tree.open(FILE)
    assert bytes(await first.read(0, 900)) == OLD
    assert bytes(await second.read(0, 9)) == OLD[:9]
    there.put(FILE, LATER + LATER, THEN + 300)
    tree.forget_caches()
    third = await tree.open(FILE)
    assert bytes(await third.read(0, 1800)) == LATER + LATER
    await require_lost(second)
    await require_lost(first)
    for file in (first, second, third):
        await file.release()


@pytest.mark.holds("promise 5")
@pytest.mark.parametrize("look", ["stat", "read", "write", "empty", "make"])
async def test_a_new_file_is_opened_though_a_writer_has_the_lost_one(there: Rig, look: str) -> None:
    """The writer changed nothing of the lost file, and can no longer; no program is told that it was
    delivered."""
    tree = there.mount()
    writer = await opened(tree, write=True)
    there.put(FILE, LATER[:-100], THEN + 200)
    await there.reboot()
    await require_lost(writer)
    expected = LATER[:-100]
    if look == "stat":
        assert (await tree.stat(FILE)).size == len(expected)
    elif look == "make":
        assert (await tree.create(FILE, exclusive=False)).size == len(expected)
    else:
        file = await tree.open(FILE, write=look != "read", truncate=look == "empty")
        expected = b"" if look == "empty" else expected
        assert bytes(await file.read(0, 2000)) == expected
        await file.release()
    await require_lost(writer)
    for change in (writer.write(0, b"mid"), writer.truncate(0)):
        with pytest.raises(FileChanged):
            await change
    await writer.fsync()
    await writer.release()
    assert there.data(FILE) == expected
    assert tree.undelivered() == []


@pytest.mark.holds("promise 5")
async def test_who_has_a_file_open_that_others_removed_does_not_get_the_next_one(there: Rig) -> None:
    tree = there.mount()
    reader = await opened(tree)
    there.take(FILE)
    tree.forget_caches()
    writer = await tree.create(FILE, exclusive=True)
    await writer.write(0, LATER)
    await require_lost(reader)
    await writer.fsync()
    await require_lost(reader)
    assert bytes(await writer.read(0, 900)) == LATER
    for file in (writer, reader):
        await file.release()
    assert there.data(FILE) == LATER


@pytest.mark.parametrize("smaller", [False, True])
async def test_what_is_held_of_a_lost_file_does_not_get_among_the_pages_of_the_new_one(
    there: Rig, smaller: bool
) -> None:
    """The kernel caches pages by name, for all programs."""
    tree = there.mount()
    writer = await tree.open(FILE, write=True)
    await writer.write(0, b"mid")
    await writer.fsync()
    held = b"mid" + OLD[3:]
    if not smaller:
        await trio.sleep(30.0)
        await tree.list(b"/d")
    assert bytes(await writer.read(0, 900)) == held
    new = LATER[:-100] if smaller else LATER
    there.put(FILE, new, THEN + 600)
    await trio.sleep(30.0)
    await tree.list(b"/d")
    assert (await tree.stat(FILE)).size == len(new)
    assert FILE in there.invalidated
    reader = await tree.open(FILE)
    await require_lost(writer)
    with pytest.raises(FileChanged):
        await writer.write(0, b"more")
    assert bytes(await reader.read(0, 900)) == new
    beside = await tree.open(FILE, write=True)
    assert [file.has_name for file in (reader, beside, writer)] == [True, True, False]
    for file in (beside, writer, reader):
        await file.release()


async def test_a_file_that_grew_after_it_was_written_stays_who_wrote_it_has_open(there: Rig) -> None:
    tree = there.mount()
    writer = await tree.open(FILE, write=True)
    await writer.write(0, b"mid")
    await writer.fsync()
    for _ in range(2):
        await trio.sleep(30.0)
        there.put(FILE, there.data(FILE) + b"more")
        await tree.list(b"/d")
    assert bytes(await writer.read(0, 900)) == b"mid" + OLD[3:]
    await writer.release()


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_while_another_file_gets_its_name_in_three_steps_the_name_is_not_opened(profile: str) -> None:
    """A read that waits would be answered from the other file, which has the same size."""
    async with rig(profile, {FILE: DATA, OTHER: DATA[::-1]}, link=LinkSettings(delay=0.05)) as here:
        tree = here.mount()
        file = await tree.open(FILE)
        assert await file.read(0, 10) == DATA[:10]
        here.faults.ignore(Opcode.READ_FILE)

        async def read() -> None:
            with pytest.raises(FileChanged):
                await file.read(40_000, 1000)

        async with trio.open_nursery() as nursery:
            nursery.start_soon(read)
            await trio.sleep(0.01)
            await tree.rename(OTHER, FILE)
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        await file.release()
